"""The two cameras from which a network is grown: their relative pose, and which two to take."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from network_calib.observations import FloatArray
from network_calib.pairs import Pair
from network_calib.triangulate import largest_parallax_rad, triangulate

MIN_SPOTS = 12
SPOTS = 250
MAX_CANDIDATES = 8
# Depth noise falls with the sine of the parallax; beyond 30 degrees other things matter more.
ENOUGH_PARALLAX_RAD = np.radians(30)


@dataclass(frozen=True, slots=True)
class Seed:
    """Two cameras, the first at the origin, their centres one unit apart.

    Attributes:
        a: first camera.
        b: second camera.
        b_from_a: (3, 3) rotation.
        centre_b: (3,) unit vector, in the first camera's frame.
        score: higher is better: agreeing spots x parallax x not explained by a plane.
    """

    a: int
    b: int
    b_from_a: FloatArray
    centre_b: FloatArray
    score: float


def find_seed(pair: Pair, ray_a: FloatArray, ray_b: FloatArray, tolerance: float) -> Seed | None:
    """Relative pose of two cameras by the five-point method, and how good a seed they make.

    Args:
        pair: the two.
        ray_a: (N, 2) true rays (focal ratio and bend taken out) of spots that agree.
        ray_b: (N, 2) the same spots.
        tolerance: in true ray units.

    Returns:
        None where no pose puts half of the spots in front of both cameras.
    """
    if len(ray_a) < MIN_SPOTS:
        return None
    essential, _ = cv2.findEssentialMat(ray_a, ray_b, np.eye(3), cv2.USAC_ACCURATE, 0.999, tolerance)
    if essential is None or essential.shape[0] < 3:
        return None
    best: Seed | None = None
    for b_from_a, shift in _poses(np.asarray(essential[:3], dtype=np.float64)):
        seed = _judge(pair, ray_a, ray_b, tolerance, b_from_a, -b_from_a.T @ shift)
        if seed is not None and (best is None or seed.score > best.score):
            best = seed
    return best


def _poses(essential: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    first, second, shift = cv2.decomposeEssentialMat(essential)
    unit = np.asarray(shift, dtype=np.float64).ravel()
    return [(np.asarray(turn, dtype=np.float64), sign * unit) for turn in (first, second) for sign in (1.0, -1.0)]


def _judge(
    pair: Pair, ray_a: FloatArray, ray_b: FloatArray, tolerance: float, b_from_a: FloatArray, centre_b: FloatArray
) -> Seed | None:
    n = len(ray_a)
    camera, point = np.tile([0, 1], n), np.repeat(np.arange(n), 2)
    ray = np.stack([ray_a, ray_b], axis=1).reshape(-1, 2)
    rotations, centres = np.stack([np.eye(3), b_from_a]), np.stack([np.zeros(3), centre_b])
    _, is_valid = triangulate(camera, point, ray, rotations, centres, n)
    if is_valid.mean() < 0.5:
        return None
    parallax = largest_parallax_rad(camera, point, ray, rotations, n)
    # sin: rays that face each other tell as little of the depth as parallel ones.
    strength = np.median(np.minimum(np.sin(parallax[is_valid]), np.sin(ENOUGH_PARALLAX_RAD)))
    score = is_valid.sum() * strength * (1.05 - _share_on_plane(ray_a, ray_b, tolerance))
    return Seed(pair.a, pair.b, b_from_a, centre_b, float(score))


def _share_on_plane(ray_a: FloatArray, ray_b: FloatArray, tolerance: float) -> float:
    """Part of the spots that one homography explains: then the pose has a twin."""
    _, is_inlier = cv2.findHomography(ray_a, ray_b, cv2.USAC_FAST, tolerance, maxIters=200, confidence=0.99)
    return 0.0 if is_inlier is None else float(is_inlier.mean())
