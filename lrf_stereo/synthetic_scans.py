"""Whole simulated scans: a box room with bodies in it, seen through a wide beam by a noisy scanner.

A beam is a Gaussian cone. It reads a body when most of it falls on the body, what is behind when little does, and in
between it reads something in between: the mixed pixels at edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lrf_stereo.noise import LrfNoise, correlated_noise
from lrf_stereo.scanner import ScanSteps, TiltingScanner
from lrf_stereo.synthetic import BoxRoom, LrfScene
from network_calib.observations import BoolArray, FloatArray, IntArray

# Part of a beam on a body below which the body is not seen, and above which nothing else is.
UNSEEN_PART, FULL_PART = 0.25, 0.75
# Rays across a beam, each way, in standard deviations; the outermost carry a fortieth of the middle's weight.
RAYS = np.linspace(-2.7, 2.7, 9)
CODES = (1, 6, 7, 10)


@dataclass(frozen=True, slots=True)
class Capsule:
    """A body: everything within `radius_m` of a segment; a ball where begin and end agree."""

    begin_in_world: FloatArray
    end_in_world: FloatArray
    radius_m: float

    @classmethod
    def ball(cls, centre_in_world: FloatArray, *, diameter_m: float = 0.04) -> Capsule:
        """The bright spot."""
        return cls(centre_in_world, centre_in_world, diameter_m / 2)


@dataclass(frozen=True, slots=True)
class ScanNoise:
    """How a real scanner departs from a perfect one.

    Attributes:
        lrf: of the ranges; neighbours are correlated.
        beam_rad: standard deviation of the beam's intensity across; an URG-04LX is 10 mrad wide in all.
        dead_share: share of the bearings whose background gives no range, in stretches.
        dropout: probability that any other beam gives none.
        error_codes: probability of an error code other than 0.
    """

    lrf: LrfNoise = field(default_factory=LrfNoise)
    beam_rad: float = 2.5e-3
    dead_share: float = 0.14
    dropout: float = 0.02
    error_codes: float = 0.004


@dataclass(frozen=True, slots=True)
class ScannedRoom:
    """A room with a scanner in it.

    Attributes:
        room: walls.
        scanner: the scanner.
        steps: its steps.
        noise: its faults.
        is_dead: (B,) bearings whose background gives no range.
    """

    room: BoxRoom
    scanner: TiltingScanner
    steps: ScanSteps
    noise: ScanNoise
    is_dead: BoolArray

    @classmethod
    def of(
        cls,
        scene: LrfScene,
        *,
        rng: np.random.Generator,
        steps: ScanSteps | None = None,
        noise: ScanNoise | None = None,
    ) -> ScannedRoom:
        """Scan the room of a scene; `rng` draws the dead bearings, in stretches of about ten steps."""
        steps, noise = steps or ScanSteps(), noise or ScanNoise()
        is_dead = np.zeros(steps.n_measured, dtype=bool)
        while is_dead.mean() < noise.dead_share:
            begin = rng.integers(steps.n_measured)
            is_dead[begin : begin + rng.integers(5, 16)] = True
        return cls(scene.room, scene.scanner, steps, noise, is_dead)

    def true_ranges(self, tilt_rad: float, bodies: Sequence[Capsule] = ()) -> tuple[FloatArray, FloatArray]:
        """(B,) ranges of whole beams without noise, and (B,) the part of each beam that falls on a body."""
        bearings = self.steps.bearings_rad
        behind = self._to_walls(tilt_rad, bearings)
        nearest, part = self._to_bodies(tilt_rad, bearings, bodies, behind)
        blend = np.clip((part - UNSEEN_PART) / (FULL_PART - UNSEEN_PART), 0.0, 1.0)
        blend = np.where(self.is_dead, blend > 0, blend)
        return np.where(blend > 0, blend * nearest + (1 - blend) * behind, behind), part

    def readings_mm(self, tilt_rad: float, bodies: Sequence[Capsule] = (), *, rng: np.random.Generator) -> IntArray:
        """(B,) one scan as the device sends it: whole millimetres, or codes below 20."""
        true, part = self.true_ranges(tilt_rad, bodies)
        noisy = self.scanner.range_scale * true + self.scanner.range_bias_m
        noisy = noisy + self.noise.lrf.range_m(true) * correlated_noise(true.shape, rng=rng)
        out = np.round(1e3 * noisy).astype(np.int64)
        is_lost = (self.is_dead & (part <= UNSEEN_PART)) | (rng.random(len(out)) < self.noise.dropout)
        out[is_lost | ~self.steps.is_range(out)] = 0
        is_code = rng.random(len(out)) < self.noise.error_codes
        out[is_code] = rng.choice(CODES, int(is_code.sum()))
        return out

    def series_mm(
        self,
        tilt_rad: float,
        bodies_at: Callable[[float], Sequence[Capsule]],
        n_scans: int,
        *,
        rng: np.random.Generator,
    ) -> tuple[FloatArray, IntArray]:
        """Scans of moving bodies: (n,) stamps of step 0 in s, and (n, B) readings.

        Bodies stand still within a scan, where they are when the mirror points at the first of them.
        """
        stamps, scans = self.steps.turn_s * np.arange(n_scans, dtype=np.float64), []
        for stamp in stamps:
            first = bodies_at(float(stamp))[:1]
            delay = 0.0
            if first:
                _, bearing, _ = self.scanner.measure(first[0].begin_in_world[None], tilt_rad)
                delay = float(self.steps.time_s(self.steps.step(bearing[0])))
            scans.append(self.readings_mm(tilt_rad, bodies_at(float(stamp) + delay), rng=rng))
        return stamps, np.stack(scans)

    def _to_walls(self, tilt_rad: float, bearings: FloatArray) -> FloatArray:
        """(B,) distances along the middles of the beams to the walls, floor or ceiling."""
        room_from_world = self.room.world_from_room.inv()
        room_from_lrf = room_from_world * self.scanner.world_from_lrf_at(tilt_rad)
        true = bearings - self.scanner.bearing_zero_rad
        ways = room_from_lrf.rotation.apply(np.stack([np.cos(true), np.sin(true), np.zeros_like(true)], axis=1))
        ahead = np.where(ways > 0, self.room.high_m, self.room.low_m) - room_from_lrf.translation
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(ways != 0, ahead / ways, np.inf)
        return distance.min(axis=1)

    def _to_bodies(
        self, tilt_rad: float, bearings: FloatArray, bodies: Sequence[Capsule], behind: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(B,) mean distance of the part of each beam that falls on bodies, NaN where none does, and (B,) that part."""
        lrf_from_world = self.scanner.world_from_lrf_at(tilt_rad).inv()
        nearest = np.full((len(bearings), len(RAYS), len(RAYS)), np.inf)
        true = bearings - self.scanner.bearing_zero_rad
        for body in bodies:
            ends = lrf_from_world.apply(np.stack([body.begin_in_world, body.end_in_world]))
            beams = np.flatnonzero(_may_hit(true, ends, body.radius_m, 3 * self.noise.beam_rad))
            theta = true[beams, None, None] + self.noise.beam_rad * RAYS[:, None]
            rise = self.noise.beam_rad * RAYS
            rays = np.stack(
                np.broadcast_arrays(np.cos(rise) * np.cos(theta), np.cos(rise) * np.sin(theta), np.sin(rise)), axis=-1
            )
            nearest[beams] = np.minimum(nearest[beams], _to_capsule(rays, ends, body.radius_m))
        weight = np.exp(-0.5 * (RAYS[:, None] ** 2 + RAYS**2))
        weight = weight / weight.sum() * (nearest < behind[:, None, None])
        part = weight.sum(axis=(1, 2))
        mean = (weight * np.where(weight > 0, nearest, 0.0)).sum(axis=(1, 2)) / np.where(part > 0, part, 1.0)
        return np.where(part > 0, mean, 0.0), part


def _may_hit(bearings: FloatArray, ends: FloatArray, radius_m: float, margin_rad: float) -> BoolArray:
    """(B,) whether a beam may meet the sphere around a capsule with ends (2, 3) in the LRF frame."""
    middle = ends.mean(axis=0)
    reach = radius_m + float(np.linalg.norm(ends[1] - ends[0])) / 2
    planar = float(np.hypot(middle[0], middle[1]))
    if planar <= reach:
        return np.ones(len(bearings), dtype=bool)
    away = (bearings - np.arctan2(middle[1], middle[0]) + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(np.abs(away) < np.arcsin(reach / planar) + margin_rad)


def _to_capsule(rays: FloatArray, ends: FloatArray, radius_m: float) -> FloatArray:
    """(...) distances from the origin along unit rays (..., 3) to a capsule with ends (2, 3); infinite where missed."""
    distance = np.minimum(_to_sphere(rays, ends[0], radius_m), _to_sphere(rays, ends[1], radius_m))
    axis = ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    if length == 0:
        return distance
    axis = axis / length
    # Across the axis the ray s d and the axis's foot f satisfy |s d' - f'| = r.
    across, foot = rays - (rays @ axis)[..., None] * axis, ends[0] - (ends[0] @ axis) * axis
    a, b, c = (across**2).sum(axis=-1), across @ foot, float(foot @ foot) - radius_m**2
    discriminant = b * b - a * c
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (b - np.sqrt(discriminant)) / a
    along = s * (rays @ axis) - ends[0] @ axis
    is_hit = (discriminant > 0) & (s > 0) & (along > 0) & (along < length)
    return np.where(is_hit, np.minimum(distance, s), distance)


def _to_sphere(rays: FloatArray, centre: FloatArray, radius_m: float) -> FloatArray:
    along = rays @ centre
    discriminant = along**2 - (float(centre @ centre) - radius_m**2)
    with np.errstate(invalid="ignore"):
        s = along - np.sqrt(discriminant)
    return np.where((discriminant > 0) & (s > 0), s, np.inf)
