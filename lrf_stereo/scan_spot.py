"""Equation 9: the bright spot in scans, found as what stands nearer than the background.

The paper compares each beam with the background by one constant. Noise grows with the distance and differs from beam to
beam, a sixth of the readings are no ranges, and the person's arm enters the scan plane too; so a beam's threshold here
is its own, and everything of about the ball's size is kept as a candidate, with a score: the solve decides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from lrf_stereo.noise import LrfNoise, mean_variance_factor
from lrf_stereo.scanner import ScanSteps
from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray

BALL_DIAMETER_M = 0.04
# A beam with fewer ranges than this in all the background's scans has no background: whatever it sees is new.
MIN_RANGES = 5
# But for a wall at the limit of the scanner's reach, which comes and goes over many beams: ranges of so many among so
# many beams to either side are its background.
MIN_RARE, FADING_BEAMS = 3, 8
# By how much a body looks wider than it is, each side and per metre of distance: an URG's beam is 10 mrad wide in all,
# and sees a body that a quarter of it falls on.
BEAM_EDGE_RAD = 1.7e-3
# How far a ball's surface is in front of its centre, in radii. Cut at height h its chord shows pi/4 sqrt(1 - h^2) in
# the mean; the beam falls wholly on the ball for |h| < 0.8, where that is 0.69 with a variance of 0.008. One beam at a
# random place of the chord has a variance of (2/3 - pi^2/16) (1 - h^2) = 0.04 about it.
SURFACE_MEAN, SURFACE_VARIANCE, SURFACE_VARIANCE_PER_BEAM = 0.69, 0.008, 0.04


@dataclass(frozen=True, slots=True)
class Background:
    """What each beam sees without the spot.

    Attributes:
        range_m: (B,) median range; infinite where there was (almost) never one.
        sigma_m: (B,) spread of single readings about it, at least the noise of a beam.
    """

    range_m: FloatArray
    sigma_m: FloatArray

    @classmethod
    def learn(cls, range_m: FloatArray, *, noise: LrfNoise | None = None) -> Background:
        """Learn from T scans (T, B) without the spot, NaN where a reading was no range; twenty scans or more.

        The spread is the largest of three: the noise model's, the median deviation's, and that of the near side (a beam
        on an edge flips between two depths, which the median deviation does not see).

        Raises:
            InputError: fewer than MIN_RANGES scans.
        """
        if len(range_m) < MIN_RANGES:
            raise InputError(f"a background needs {MIN_RANGES} scans or more, got {len(range_m)}")
        is_known = np.isfinite(range_m).sum(axis=0) >= MIN_RANGES
        out, sigma = np.full(range_m.shape[1], np.inf), np.zeros(range_m.shape[1])
        known = range_m[:, is_known]
        median = np.nanmedian(known, axis=0)
        by_median = 1.4826 * np.nanmedian(np.abs(known - median), axis=0)
        by_near_side = (median - np.nanquantile(known, 0.05, axis=0)) / 1.645
        model = (noise or LrfNoise()).range_m(median)
        out[is_known] = median
        sigma[is_known] = np.maximum(model, np.maximum(by_median, by_near_side))
        unknown = np.where(is_known, np.nan, range_m)
        for beam in np.flatnonzero(~is_known):
            around = unknown[:, max(beam - FADING_BEAMS, 0) : beam + FADING_BEAMS + 1]
            rare = around[np.isfinite(around)]
            if np.isfinite(around).any(axis=0).sum() >= MIN_RARE:
                out[beam] = np.median(rare)
                sigma[beam] = max(float((noise or LrfNoise()).range_m(out[beam])), float(np.std(rare)))
        return cls(out, sigma)


class Threshold(Protocol):
    """Which beams show something new."""

    def is_foreground(self, range_m: FloatArray, background: Background) -> BoolArray:
        """(T, B) for ranges (T, B); NaN is never new."""
        ...


@dataclass(frozen=True, slots=True)
class AdaptiveThreshold:
    """Nearer than the background by `n_sigma` standard deviations of the beam and of a reading at its distance."""

    n_sigma: float = 5.0
    noise: LrfNoise = field(default_factory=LrfNoise)

    def is_foreground(self, range_m: FloatArray, background: Background) -> BoolArray:
        """See `Threshold`."""
        sigma = np.hypot(background.sigma_m, self.noise.range_m(range_m))
        return np.asarray(background.range_m - range_m > self.n_sigma * sigma)


@dataclass(frozen=True, slots=True)
class ConstantThreshold:
    """Equation 9 as printed: |l_p - l_p_back| >= U_th, nearer or farther."""

    u_m: float

    def is_foreground(self, range_m: FloatArray, background: Background) -> BoolArray:
        """See `Threshold`."""
        return np.asarray(np.abs(range_m - background.range_m) >= self.u_m)


@dataclass(frozen=True, slots=True)
class SpotCandidates:
    """K clusters of about the ball's size, by scan, then by beam.

    Attributes:
        scan: (K,) index of the scan.
        first_beam: (K,) index of the first beam in the scan.
        n_hits: (K,) beams that hit.
        range_m: (K,) measured range of the ball's centre.
        bearing_rad: (K,) measured bearing of the centre.
        sigma_range_m: (K,) standard deviation; neighbouring beams are not independent.
        sigma_bearing_rad: (K,) standard deviation.
        score: (K,) in (0, 1]: how well the width is that of the ball, halved beside something nearer.
    """

    scan: IntArray
    first_beam: IntArray
    n_hits: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    sigma_range_m: FloatArray
    sigma_bearing_rad: FloatArray
    score: FloatArray

    def __len__(self) -> int:
        return len(self.scan)

    def select(self, is_kept: BoolArray | IntArray) -> SpotCandidates:
        """Some of the rows."""
        return SpotCandidates(
            self.scan[is_kept],
            self.first_beam[is_kept],
            self.n_hits[is_kept],
            self.range_m[is_kept],
            self.bearing_rad[is_kept],
            self.sigma_range_m[is_kept],
            self.sigma_bearing_rad[is_kept],
            self.score[is_kept],
        )


def ranges_m(readings_mm: npt.ArrayLike, *, steps: ScanSteps) -> FloatArray:
    """Readings of any shape as ranges; NaN for error codes and what is outside the device's reach."""
    readings = np.asarray(readings_mm)
    return np.where(steps.is_range(readings), 1e-3 * readings, np.nan)


def find_spots(
    range_m: FloatArray,
    background: Background,
    *,
    steps: ScanSteps,
    threshold: Threshold | None = None,
    noise: LrfNoise | None = None,
    ball_diameter_m: float = BALL_DIAMETER_M,
) -> SpotCandidates:
    """Everything in scans (T, B) that is new and of about the ball's size.

    Foreground beams belong together when they are neighbours (or have one beam without a range between them) and their
    ranges differ by less than the ball's radius and the noise.
    """
    noise = noise or LrfNoise()
    is_new = (threshold or AdaptiveThreshold(noise=noise)).is_foreground(range_m, background)
    scan, beam = np.nonzero(is_new)
    reading = range_m[scan, beam]
    cluster = _clusters(scan, beam, reading, range_m, ball_diameter_m / 2 + 5 * noise.range_m(reading))
    _, first, hits = np.unique(cluster, return_index=True, return_counts=True)
    if not len(first):
        none, nothing = np.empty(0), np.empty(0, dtype=np.int64)
        return SpotCandidates(nothing, nothing, nothing, none, none, none, none, none)
    last = first + hits - 1
    mean = np.add.reduceat(reading, first) / hits
    left, left_var = _edge(range_m, scan[first], beam[first], -1)
    right, right_var = _edge(range_m, scan[first], beam[last], +1)
    width_rad = steps.step_rad * (beam[last] - beam[first] + 1).astype(np.float64)
    radius = ball_diameter_m / 2
    surface_variance = radius**2 * (SURFACE_VARIANCE + SURFACE_VARIANCE_PER_BEAM / hits)
    found = SpotCandidates(
        scan=scan[first],
        first_beam=beam[first],
        n_hits=hits,
        range_m=mean + SURFACE_MEAN * radius,
        bearing_rad=steps.bearing_rad(steps.first_step + (left + right) / 2),
        sigma_range_m=np.sqrt(noise.range_m(mean) ** 2 * mean_variance_factor(hits) + surface_variance),
        sigma_bearing_rad=steps.step_rad * np.sqrt((left_var + right_var) / 4 + np.where(hits == 1, 1 / 24, 0.0)),
        score=_score(width_rad, mean, ball_diameter_m, steps.step_rad)
        * np.where(_is_beside_nearer(range_m, is_new, scan[first], beam[first], beam[last], mean - radius), 0.5, 1.0),
    )
    largest_rad = ball_diameter_m / mean + 2 * BEAM_EDGE_RAD + steps.step_rad
    return found.select(width_rad <= largest_rad)


def _clusters(scan: IntArray, beam: IntArray, reading: FloatArray, range_m: FloatArray, jump_m: FloatArray) -> IntArray:
    """(n,) cluster number of each foreground beam, growing."""
    if not len(scan):
        return np.empty(0, dtype=np.int64)
    gap = np.diff(beam)
    between = np.isnan(range_m[scan[1:], beam[1:] - 1])
    is_near = (gap == 1) | ((gap == 2) & between)
    is_linked = (np.diff(scan) == 0) & is_near & (np.abs(np.diff(reading)) <= jump_m[1:])
    return np.concatenate([[0], np.cumsum(~is_linked)])


def _edge(range_m: FloatArray, scan: IntArray, beam: IntArray, side: int) -> tuple[FloatArray, FloatArray]:
    """Where clusters end, in beams, and the variance of that.

    The edge is anywhere between the last beam that hits and the next, which does not; or, where the next has no range
    and so tells nothing, the one after that.
    """
    n_beams = range_m.shape[1]
    beyond = beam + side
    is_unknown = (beyond >= 0) & (beyond < n_beams) & np.isnan(range_m[scan, np.clip(beyond, 0, n_beams - 1)])
    span = np.where(is_unknown, 2.0, 1.0)
    return beam + side * span / 2, span**2 / 12


def _score(width_rad: FloatArray, range_m: FloatArray, diameter_m: float, step_rad: float) -> FloatArray:
    """How likely a ball, cut at any height, is so wide: a chord is pi/4 of the diameter in the mean."""
    expected = (np.pi / 4 * diameter_m / range_m + 2 * BEAM_EDGE_RAD) / step_rad
    return np.exp(-0.5 * ((width_rad / step_rad - expected) / (0.5 + 0.3 * expected)) ** 2)


def _is_beside_nearer(
    range_m: FloatArray, is_new: BoolArray, scan: IntArray, first: IntArray, last: IntArray, nearer_m: FloatArray
) -> BoolArray:
    """Whether a cluster touches a foreground beam that is nearer: it may be the mixed edge of that body."""
    n_beams = range_m.shape[1]
    out = np.zeros(len(scan), dtype=bool)
    for beyond in (first - 1, last + 1):
        inside = np.clip(beyond, 0, n_beams - 1)
        out |= (inside == beyond) & is_new[scan, inside] & (range_m[scan, inside] < nearer_m)
    return out
