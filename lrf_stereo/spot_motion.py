"""How the spot moves where LRFs see it: the beam and the cameras' exposure are not of one instant.

The velocity is the central difference over the spots some 35 ms before and after, as the cameras alone locate them, so
its noise is known: the depth from a stereo pair makes metres a second of it. A clock's offset shows in what velocities
differ by, since what they share shifts the scanner as well; and velocities that differ by nothing but noise would tell
an offset that is not there. So each is taken for what it is worth beside all others of its scanner
(`noisy_vectors.py`), and what is left uncertain adds to the sighting's covariance. A spot without neighbours in time is
taken to move like the others.

The second difference tells in the same way how large accelerations are. They only add to the covariance: one by one
they rest on the spot itself, whose noise they would explain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrf_stereo.noisy_vectors import NoisyVectors
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.spots import SpotViews, located

# Neighbours in time. Of a motion that turns with 5 rad/s the difference over +- 35 ms misses 0.5 %, which no sigma
# tells; nearer ones are noisier, and beyond 0.15 s a hand has turned.
HALF_STEP_S, MAX_STEP_S = 0.035, 0.15
# An acceleration is known the better by the square of the time: these are as far apart as a hand's way is still bent to
# one side.
BEND_HALF_STEP_S = 0.1
# On each axis, where no neighbours tell it: 0.5 m/s in all, along a way that turns with 5 rad/s.
HAND_SPEED_M_S, HAND_ACCELERATION_M_S2 = 0.3, 1.5
# A change of velocity beyond what a hand that hurries does, in sigma of it and of the cameras, is a false detection.
HURRY_M_S2, MAX_JUMP_SIGMA = 5.0, 5.0
# A gap between frames that no camera bridges.
UNBRIDGED_S = 1e6


@dataclass(frozen=True, slots=True)
class SpotMotion:
    """How the spot moves in M sightings, in world.

    Attributes:
        velocity_m_s: (M, 3) what the scanner's other sightings tell where it is not known.
        covariance_m2_s2: (M, 3, 3) of the velocity.
        spread_m_s: (M,) standard deviation on each axis by which the velocities of the scanner's sightings differ.
        acceleration_m_s2: (M,) standard deviation of their accelerations on each axis.
        is_known: (M,) whether neighbours in time tell the velocity.
    """

    velocity_m_s: FloatArray
    covariance_m2_s2: FloatArray
    spread_m_s: FloatArray
    acceleration_m_s2: FloatArray
    is_known: BoolArray

    @classmethod
    def still(cls, n: int) -> SpotMotion:
        """Spots that do not move, or whose sightings are of the cameras' instants."""
        return cls(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool))

    @property
    def is_still(self) -> bool:
        """Whether no spot moves."""
        return not (self.velocity_m_s.any() or self.covariance_m2_s2.any() or self.acceleration_m_s2.any())

    def put(self, rows: IntArray, part: SpotMotion) -> None:
        """Write some of the sightings, in place."""
        for name in self.__slots__:
            getattr(self, name)[rows] = getattr(part, name)

    def displacement_m(self, delay_s: FloatArray) -> FloatArray:
        """(M, 3) from the exposure to delays (M,) after it."""
        return self.velocity_m_s * delay_s[:, None]

    def displacement_covariance_m2(self, delay_s: FloatArray) -> FloatArray:
        """(M, 3, 3) of the displacement: of the velocity, and of the acceleration a in a delay^2 / 2."""
        bend_m = self.acceleration_m_s2 * delay_s**2 / 2
        return (delay_s**2)[:, None, None] * self.covariance_m2_s2 + (bend_m**2)[:, None, None] * np.eye(3)


def frame_times_s(views: SpotViews, frame_period_s: float | None) -> FloatArray | None:
    """(F,) times of the points' frames, from any zero; None where nothing tells them.

    Each step is the mean over the cameras that saw both frames, so that the cameras' clocks need not agree.
    """
    stamp_ns = views.observations.stamp_ns
    if stamp_ns is None:
        number = (views.frames - views.frames[:1]).astype(np.float64)
        return None if frame_period_s is None else number * frame_period_s
    order = np.lexsort((views.point, views.camera))
    point, camera, stamp = views.point[order], views.camera[order], stamp_ns[order]
    is_step = (np.diff(camera) == 0) & (np.diff(point) == 1)
    first, step_s = point[:-1][is_step], np.diff(stamp)[is_step] * 1e-9
    n_steps = max(views.n_points - 1, 0)
    count = np.bincount(first, minlength=n_steps)
    mean_s = np.bincount(first, step_s, minlength=n_steps) / np.maximum(count, 1)
    return np.concatenate([[0.0], np.cumsum(np.where((count > 0) & (mean_s > 0), mean_s, UNBRIDGED_S))])


def motion_of(positions: FloatArray, spread: FloatArray, times_s: FloatArray | None, point: IntArray) -> SpotMotion:
    """How spots move.

    Args:
        positions: (F, 3) spots in the order of time, NaN where not located.
        spread: (F, 3, 3) their covariances, each on its own.
        times_s: (F,) growing; None where unknown.
        point: (M,) the spots that are asked for, -1 for none: those of one scanner.
    """
    unknown = UNBRIDGED_S * np.arange(len(positions), dtype=np.float64)
    times_s = unknown if times_s is None else times_s
    near, far = (_Around.of(positions, spread, times_s, point, step) for step in (HALF_STEP_S, BEND_HALF_STEP_S))
    slopes, bends = NoisyVectors.of(*near.difference(near.slope)), NoisyVectors.of(*far.difference(far.bend))
    usual = slopes.usual(HAND_SPEED_M_S**2)
    n = len(point)
    velocity = np.tile(usual.mean, (n, 1))
    covariance = np.tile(usual.variance * np.eye(3) + usual.mean_covariance, (n, 1, 1))
    velocity[near.rows], covariance[near.rows] = slopes.expected(usual)
    is_known = np.zeros(n, dtype=bool)
    is_known[near.rows] = True
    acceleration2 = bends.size2() if len(far.rows) else HAND_ACCELERATION_M_S2**2
    return SpotMotion(
        velocity, covariance, np.full(n, np.sqrt(usual.variance)), np.full(n, np.sqrt(acceleration2)), is_known
    )


@dataclass(frozen=True, slots=True)
class _Around:
    """n spots with the ones before and after them in time.

    Attributes:
        rows: (n,) which of the spots asked for, growing.
        behind_s: (n,) time since the spot before.
        ahead_s: (n,) time to the spot after.
        positions: (n, 3, 3) before, at, after.
        spread: (n, 3, 3, 3) their covariances.
    """

    rows: IntArray
    behind_s: FloatArray
    ahead_s: FloatArray
    positions: FloatArray
    spread: FloatArray

    @classmethod
    def of(
        cls, positions: FloatArray, spread: FloatArray, times_s: FloatArray, point: IntArray, half_step_s: float
    ) -> _Around:
        """Those that have a located spot on either side in time, about so far away, and a smooth way between them."""
        usable = np.flatnonzero(located(positions))
        times = times_s[usable]
        place = np.searchsorted(usable, point)
        is_inside = (place > 0) & (place < len(usable) - 1)
        rows = np.flatnonzero(is_inside)
        rows = rows[usable[place[rows]] == point[rows]]
        at = place[rows]
        before = _nearest(times, times[at] - half_step_s, np.zeros_like(at), at - 1)
        after = _nearest(times, times[at] + half_step_s, at + 1, np.full_like(at, len(usable) - 1))
        behind_s, ahead_s = times[at] - times[before], times[after] - times[at]
        is_near = (np.minimum(behind_s, ahead_s) > 0) & (np.maximum(behind_s, ahead_s) <= MAX_STEP_S)
        three = usable[np.stack([before, at, after], axis=1)[is_near]]
        found = cls(rows[is_near], behind_s[is_near], ahead_s[is_near], positions[three], spread[three])
        return found.take(found.is_smooth)

    def take(self, is_kept: BoolArray) -> _Around:
        """Some of them."""
        return _Around(
            self.rows[is_kept],
            self.behind_s[is_kept],
            self.ahead_s[is_kept],
            self.positions[is_kept],
            self.spread[is_kept],
        )

    @property
    def slope(self) -> FloatArray:
        """(n, 3) weights whose sum with the positions is the velocity: the halves' slopes, the shorter for more."""
        behind, ahead = self.behind_s, self.ahead_s
        first, last = -ahead / (behind * (ahead + behind)), behind / (ahead * (ahead + behind))
        return np.stack([first, -(first + last), last], axis=1)

    @property
    def bend(self) -> FloatArray:
        """(n, 3) weights whose sum with the positions is the acceleration: the halves' change of slope over time."""
        first, last = 1 / self.behind_s, 1 / self.ahead_s
        return np.stack([first, -(first + last), last], axis=1) * (2 / (self.behind_s + self.ahead_s))[:, None]

    def difference(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 3) sums of the positions with weights (n, 3), and (n, 3, 3) their covariances."""
        value = np.einsum("nk,nki->ni", weights, self.positions)
        return value, np.einsum("nk,nkij->nij", weights**2, self.spread)

    @property
    def is_smooth(self) -> BoolArray:
        """(n,) whether the acceleration is one of a hand."""
        acceleration, allowed = self.difference(self.bend)
        allowed = allowed + HURRY_M_S2**2 * np.eye(3)
        along = np.linalg.solve(allowed, acceleration[:, :, None])[:, :, 0]
        return np.asarray((acceleration * along).sum(axis=1) <= MAX_JUMP_SIGMA**2)


def _nearest(times: FloatArray, target: FloatArray, low: IntArray, high: IntArray) -> IntArray:
    """Places low..high of growing times that are nearest to targets (n,)."""
    right = np.clip(np.searchsorted(times, target), low, high)
    left = np.clip(right - 1, low, high)
    return np.where(target - times[left] <= times[right] - target, left, right)
