"""How far candidates of one frame speak for each other: epipolar evidence between all of them, and what to believe.

Evidence of two candidates of different cameras is a log-likelihood ratio: that both show one spot, against that they
have nothing to do with each other. Beliefs are a mean field over these: a candidate is believed as far as the believed
candidates of the other cameras lie on its epipolar lines, and candidates of one camera rival each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.candidates import Candidates
from network_calib.epipolar import sampson, tolerance_at, unbend
from network_calib.observations import FloatArray, IntArray
from network_calib.pairs import PairGraph

# An honest pair of views lies off its epipolar line as one in twenty does: late, smeared, bent lens.
STRAY_SHARE = 0.05
# What no detector beats through a lens that is known only as one bend, px.
LENS_SIGMA_PX = 0.5
# Beyond this many px the two do not belong together, however wide the pair's own scatter is.
AGREEING_PX = 12.0
MAX_SCALE = 6.0
# log-odds of a detection against "none is the spot", before any evidence: one stray view does not overturn it, two do.
PRESUMED = 4.0
MIN_SCORE = 0.02
N_ROUNDS = 8
MAX_ENTRIES = 2_000_000


@dataclass(frozen=True, slots=True)
class Rays:
    """Nominal rays of K candidates, unbent once a graph is known.

    Attributes:
        xy: (K, 2) x/z and y/z in the nominal camera.
        pixel: (K,) size of a pixel in ray units.
        reach: (C,) half the image in pixels: where a spot that has nothing to do with a line may lie around it.
    """

    xy: FloatArray
    pixel: FloatArray
    reach: FloatArray


@dataclass(frozen=True, slots=True)
class Evidence:
    """M pairs of candidates of one frame and different cameras whose epipolar geometry is known.

    Attributes:
        first: (M,) row.
        second: (M,) row.
        log_ratio: (M,) log-likelihood ratio, positive where they agree.
    """

    first: IntArray
    second: IntArray
    log_ratio: FloatArray

    @classmethod
    def of(cls, candidates: Candidates, rays: Rays, graph: PairGraph, rows: IntArray, scale: FloatArray) -> Evidence:
        """Evidence among rows (n,) of whole frames, in the order of the candidates; `scale` (P,) of `pair_scales`."""
        first, second, pair = _meeting(candidates, graph, rows)
        distance = distances(candidates, rays, graph, first, second, pair)
        return cls(first, second, _log_ratio(distance, scale[pair], rays, candidates, first, second))


def pair_scales(candidates: Candidates, rays: Rays, graph: PairGraph, rows: IntArray) -> FloatArray:
    """(P,) scatter of each verified pair about its epipolar lines in the candidates' sigma, at least 1.

    Args:
        candidates: all.
        rays: of them.
        graph: P verified pairs.
        rows: (n,) one of each camera and frame, believed for the moment.
    """
    first, second, pair = _meeting(candidates, graph, rows)
    distance = np.abs(distances(candidates, rays, graph, first, second, pair))
    sigma_px = _sigma_px(candidates)
    is_near = distance * np.maximum(sigma_px[first], sigma_px[second]) <= AGREEING_PX
    scale = np.ones(len(graph.pairs))
    for p in range(len(scale)):
        near = distance[is_near & (pair == p)]
        # 1.4826 median |d| = sigma of a normal distribution.
        scale[p] = np.clip(1.4826 * np.median(near), 1.0, MAX_SCALE) if len(near) else 1.0
    return scale


def distances(
    candidates: Candidates, rays: Rays, graph: PairGraph, first: IntArray, second: IntArray, pair: IntArray
) -> FloatArray:
    """(M,) signed Sampson distances in standard deviations of the candidates themselves."""
    straight = unbend(rays.xy, graph.bend[candidates.camera])
    tolerance = tolerance_at(_sigma_px(candidates) * rays.pixel, rays.xy)
    matrices = np.array([p.fundamental for p in graph.pairs], dtype=np.float64).reshape(-1, 3, 3)
    return sampson(
        matrices[pair], straight[first, None], straight[second, None], tolerance[first, None], tolerance[second, None]
    )[:, 0]


def prior(candidates: Candidates) -> FloatArray:
    """(K,) log-odds against "none", by the detector's score."""
    return PRESUMED + np.log(np.maximum(candidates.score, MIN_SCORE))


def believe(candidates: Candidates, evidence: Evidence, prior_odds: FloatArray) -> FloatArray:
    """(K,) evidence in favour of each candidate by what is believed of the others; 0 where nobody tells.

    Args:
        candidates: all.
        evidence: of some of their rows.
        prior_odds: (K,) log-odds before the evidence.
    """
    n, group = len(candidates), candidates.group
    ends = np.concatenate([evidence.first, evidence.second])
    others = np.concatenate([evidence.second, evidence.first])
    ratio = np.concatenate([evidence.log_ratio, evidence.log_ratio])
    belief = _shares(prior_odds, group)
    support = np.zeros(n)
    for _ in range(N_ROUNDS):
        support = np.bincount(ends, weights=ratio * belief[others], minlength=n).astype(np.float64)
        # Half a step: two frames' worth of rivals that swing against each other settle.
        belief = 0.5 * (belief + _shares(prior_odds + support, group))
    return support


def _shares(log_odds: FloatArray, group: IntArray) -> FloatArray:
    """(K,) probabilities of the candidates of each group, "none" having log-odds 0."""
    n_groups = int(group[-1]) + 1 if len(group) else 0
    top = np.zeros(n_groups)
    np.maximum.at(top, group, log_odds)
    weight = np.exp(log_odds - top[group])
    total = np.bincount(group, weights=weight, minlength=n_groups) + np.exp(-top)
    return weight / total[group]


def _meeting(candidates: Candidates, graph: PairGraph, rows: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """All pairs of the rows within a frame whose cameras are a verified pair: (M,) first, second, pair; a < b."""
    n = candidates.n_cameras
    pair_of = np.full((n, n), -1, dtype=np.int64)
    for number, pair in enumerate(graph.pairs):
        pair_of[pair.a, pair.b] = number
    frame, camera = candidates.frame[rows], candidates.camera[rows]
    firsts, seconds, pairs = [], [], []
    for lag in range(1, len(rows)):
        is_same = frame[lag:] == frame[:-lag]
        if not is_same.any():
            break
        at = np.flatnonzero(is_same)
        number = pair_of[camera[at], camera[at + lag]]
        firsts.append(rows[at[number >= 0]])
        seconds.append(rows[at[number >= 0] + lag])
        pairs.append(number[number >= 0])
    empty = np.zeros(0, dtype=np.int64)
    return (
        np.concatenate([empty, *firsts]),
        np.concatenate([empty, *seconds]),
        np.concatenate([empty, *pairs]),
    )


def _log_ratio(
    distance: FloatArray,
    scale: FloatArray,
    rays: Rays,
    candidates: Candidates,
    first: IntArray,
    second: IntArray,
) -> FloatArray:
    """Normal with a share of strays, over uniform across the image."""
    reach = np.minimum(rays.reach[candidates.camera[first]], rays.reach[candidates.camera[second]])
    sigma_px = _sigma_px(candidates)
    sigma = scale * np.maximum(sigma_px[first], sigma_px[second])
    gain = (1 - STRAY_SHARE) * 2 * reach / (sigma * np.sqrt(2 * np.pi))
    return np.log(gain * np.exp(-0.5 * np.minimum(distance / scale, 30.0) ** 2) + STRAY_SHARE)


def _sigma_px(candidates: Candidates) -> FloatArray:
    return np.hypot(np.nan_to_num(candidates.sigma_px), LENS_SIGMA_PX)
