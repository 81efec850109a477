"""RANSAC over pairs of points: the rigid motion of equation 7 where some pairs are wrong (section IV-A, step 3)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrf_stereo.rigid import LINE_RATIO, PointNoise, arun, fit_rigid, gauss_newton, width_of
from network_calib.errors import ConvergenceError, DegenerateError, InputError
from network_calib.observations import BoolArray, FloatArray, IntArray

N_POLISHED = 8
MAX_ROUNDS = 10
MAX_ELEMENTS = 4_000_000


@dataclass(frozen=True, slots=True)
class RobustRigid:
    """A rigid motion and the pairs that agree with it.

    Attributes:
        target_from_source: fitted to the inliers.
        is_inlier: (N,).
    """

    target_from_source: RigidTransform
    is_inlier: BoolArray


def fit_rigid_robust(
    source: FloatArray,
    target: FloatArray,
    *,
    rng: np.random.Generator,
    threshold_m: float | None = None,
    noise: PointNoise | None = None,
    threshold_sigma: float = 3.37,
    max_trials: int = 2000,
) -> RobustRigid:
    """RANSAC over triples of pairs: all triples where there are few, else `max_trials` random ones.

    Each triple gives a motion; its cost is the sum of squared distances, capped at the threshold (MSAC). The eight best
    are refitted to their inliers until these settle, and the cheapest wins.

    Args:
        source: (N, 3), N >= 3.
        target: (N, 3).
        rng: draws the triples.
        threshold_m: largest distance of an inlier, where no noise is given.
        noise: covariances; distances are then counted in standard deviations, and inliers weighted.
        threshold_sigma: largest such distance; 3.37 keeps 99 % of Gaussian errors in space.
        max_trials: triples at most.

    Raises:
        InputError: not exactly one of threshold and noise.
        DegenerateError: fewer than three pairs, or inliers on one line.
        ConvergenceError: no motion agrees with a third of the pairs, or with four where there are four.
    """
    if (threshold_m is None) == (noise is None):
        raise InputError("a robust rigid fit needs a threshold in metres or the noise of the points, and not both")
    if len(source) < 3:
        raise DegenerateError(f"a rigid motion needs 3 pairs of points or more, got {len(source)}")
    pairs = _Pairs(source, target, _information(len(source), noise), threshold_m or threshold_sigma)
    triples = _triples(len(source), max_trials, rng)
    rotations, shifts = arun(source[triples], target[triples], np.ones(3))
    best = np.argsort(pairs.costs(rotations, shifts), kind="stable")[:N_POLISHED]
    polished = [_polish(rotations[k], shifts[k], pairs) for k in best]
    rotations, shifts = np.stack([motion[0] for motion in polished]), np.stack([motion[1] for motion in polished])
    winner = int(np.argmin(pairs.costs(rotations, shifts)))
    is_inlier = pairs.is_inlier(rotations[winner], shifts[winner])
    # Any three pairs of equal triangles agree by themselves, so three say nothing where there are more.
    if is_inlier.sum() < max(min(4, len(source)), len(source) / 3):
        raise ConvergenceError(
            f"no rigid motion agrees with a third of the {len(source)} pairs; the best agrees with {is_inlier.sum()}",
            advice="Check that spots and ranges of one instant are paired, and the threshold or noise.",
        )
    inlier_noise = None if noise is None else noise.select(is_inlier)
    return RobustRigid(fit_rigid(source[is_inlier], target[is_inlier], noise=inlier_noise), is_inlier)


@dataclass(frozen=True, slots=True)
class _Pairs:
    """N pairs with the metric of their distances: information (N, 3, 3) and the largest distance of an inlier."""

    source: FloatArray
    target: FloatArray
    information: FloatArray
    limit: float

    def distances(self, rotations: FloatArray, shifts: FloatArray) -> FloatArray:
        """(B, N) distances under B motions: metres, or standard deviations."""
        error = self.target - self.source @ np.swapaxes(rotations, 1, 2) - shifts[:, None]
        return np.sqrt((error * np.einsum("kij,bkj->bki", self.information, error)).sum(axis=2))

    def costs(self, rotations: FloatArray, shifts: FloatArray) -> FloatArray:
        """(B,) sums of squared distances, each capped at the limit; in blocks that bound the memory."""
        cost, block = np.empty(len(rotations)), max(1, MAX_ELEMENTS // len(self.source))
        for k in range(0, len(rotations), block):
            distance = self.distances(rotations[k : k + block], shifts[k : k + block])
            cost[k : k + block] = (np.minimum(distance, self.limit) ** 2).sum(axis=1)
        return cost

    def is_inlier(self, rotation: FloatArray, shift: FloatArray) -> BoolArray:
        """(N,) pairs within the limit of one motion."""
        return self.distances(rotation[None], shift[None])[0] <= self.limit


def _polish(rotation: FloatArray, shift: FloatArray, pairs: _Pairs) -> tuple[FloatArray, FloatArray]:
    """Refit to the inliers until they settle, with a shrinking limit, as three noisy points extrapolate badly."""
    before = np.zeros(len(pairs.source), dtype=bool)
    noise = PointNoise(np.asarray(np.linalg.inv(pairs.information), dtype=np.float64))
    for widening in (3.0, 2.0, 1.5, *np.ones(MAX_ROUNDS)):
        inliers = pairs.distances(rotation[None], shift[None])[0] <= widening * pairs.limit
        is_settled = widening == 1.0 and bool((inliers == before).all())
        if is_settled or inliers.sum() < 4 or width_of(pairs.source[inliers]) < LINE_RATIO:
            break
        fitted = gauss_newton(rotation, shift, pairs.source[inliers], pairs.target[inliers], noise.select(inliers))
        if fitted is None:
            break
        (rotation, shift), before = fitted, inliers
    return rotation, shift


def _information(n: int, noise: PointNoise | None) -> FloatArray:
    """(N, 3, 3) metric of the distances: plain, or inverse covariances.

    The source's covariance enters by its mean over the directions, so that one metric serves every rotation.
    """
    if noise is None:
        return np.broadcast_to(np.eye(3), (n, 3, 3))
    covariance = noise.target_m2
    if noise.source_m2 is not None:
        covariance = covariance + (np.trace(noise.source_m2, axis1=1, axis2=2) / 3)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.inv(covariance), dtype=np.float64)


def _triples(n: int, max_trials: int, rng: np.random.Generator) -> IntArray:
    if comb(n, 3) <= max_trials:
        return np.array(list(combinations(range(n), 3)))
    # Distinct members: each draw skips those before it.
    first, second, third = (rng.integers(0, n - skipped, max_trials) for skipped in range(3))
    second = second + (second >= first)
    low, high = np.minimum(first, second), np.maximum(first, second)
    third = third + (third >= low)
    third = third + (third >= high)
    return np.stack([first, second, third], axis=1)
