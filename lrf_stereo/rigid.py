"""Equations 7 and 8: the rigid motion between two point sets, plain and weighted by covariance.

Arun, Huang, Blostein 1987 with the determinant fix of Umeyama. The fix is not optional here: the points of one scan lie
in a plane, where the plain singular value decomposition gives a reflection as often as a rotation.

Equation 8 weighs all directions alike; a stereo pair's error in depth is tens of times its error across. Where
covariances are given, `fit_rigid` weighs by them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.errors import ConvergenceError, DegenerateError, InputError
from network_calib.observations import BoolArray, FloatArray, IntArray

# Spots in a band this wide for its length are called a line: 5 mm of range noise makes a perfect line of 2 m look
# 0.003 wide already, and across a band of 0.01 the turn about it is known to 5 mm / 20 mm = 14 degrees at best.
LINE_RATIO = 0.01
MAX_STEPS = 50


@dataclass(frozen=True, slots=True)
class PointNoise:
    """Covariances of the two point sets of a rigid fit.

    Attributes:
        target_m2: (N, 3, 3) in the target frame.
        source_m2: (N, 3, 3) in the source frame; none by default.
    """

    target_m2: FloatArray
    source_m2: FloatArray | None = None

    def select(self, rows: IntArray | BoolArray) -> PointNoise:
        """The same noise of some rows."""
        return PointNoise(self.target_m2[rows], None if self.source_m2 is None else self.source_m2[rows])

    def information(self, rotation: FloatArray) -> FloatArray:
        """(N, 3, 3) inverse covariances of target - rotation @ source."""
        if self.source_m2 is None:
            return np.asarray(np.linalg.inv(self.target_m2), dtype=np.float64)
        total = self.target_m2 + rotation @ self.source_m2 @ rotation.T
        return np.asarray(np.linalg.inv(total), dtype=np.float64)


def fit_rigid(
    source: FloatArray, target: FloatArray, *, weights: FloatArray | None = None, noise: PointNoise | None = None
) -> RigidTransform:
    """The motion that minimises equation 8, or its generalised form.

    Args:
        source: (N, 3), N >= 3, not on one line.
        target: (N, 3) the same points in the target frame.
        weights: (N,) of the squared distances; 1 by default.
        noise: covariances; the squared distances are then taken in their metric, by Gauss-Newton from Arun's answer.

    Returns:
        target_from_source.

    Raises:
        InputError: shapes differ, or both weights and noise are given.
        DegenerateError: fewer than three points, or a set on one line.
        ConvergenceError: the weighted iteration does not settle.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise InputError(f"a rigid fit needs two equal sets of 3D points, got {source.shape} and {target.shape}")
    if weights is not None and noise is not None:
        raise InputError("a rigid fit is weighted by numbers or by covariances, not by both")
    weight = np.ones(len(source)) if weights is None else weights
    _refuse_line(source[weight > 0])
    _refuse_line(target[weight > 0])
    rotation, shift = arun(source[None], target[None], weight)
    if noise is None:
        return _motion(rotation[0], shift[0])
    fitted = gauss_newton(rotation[0], shift[0], source, target, noise)
    if fitted is None:
        raise ConvergenceError(f"the weighted rigid fit of {len(source)} pairs did not settle in {MAX_STEPS} steps")
    return _motion(*fitted)


def arun(source: FloatArray, target: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Closed-form minimum of equation 8 for B pairs of sets (B, N, 3) at once, always a rotation.

    Returns:
        (B, 3, 3) rotations and (B, 3) translations target_from_source.
    """
    share = (weight / weight.sum())[:, None]
    source_mean, target_mean = (source * share).sum(axis=1), (target * share).sum(axis=1)
    moment = np.swapaxes((target - target_mean[:, None]) * share, 1, 2) @ (source - source_mean[:, None])
    left, _, right = np.linalg.svd(moment)
    left = left.copy()
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    rotation = left @ right
    return rotation, target_mean - np.einsum("bij,bj->bi", rotation, source_mean)


def gauss_newton(
    rotation: FloatArray, shift: FloatArray, source: FloatArray, target: FloatArray, noise: PointNoise
) -> tuple[FloatArray, FloatArray] | None:
    """Generalised least squares; the covariance follows the rotation. None where the steps do not die out."""
    # Turning about the middle of the points keeps rotation and translation nearly independent.
    middle = source.mean(axis=0)
    arm, place = source - middle, rotation @ middle + shift
    size = float(np.abs(arm).max())
    for _ in range(MAX_STEPS):
        turned = arm @ rotation.T
        jacobian = np.concatenate([-_cross_matrices(turned), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], axis=2)
        weighted = np.swapaxes(jacobian, 1, 2) @ noise.information(rotation)
        hessian = (weighted @ jacobian).sum(axis=0)
        step = np.linalg.solve(hessian, np.einsum("kij,kj->i", weighted, target - turned - place))
        rotation, place = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, place + step[3:]
        if np.linalg.norm(step[:3]) * size + np.linalg.norm(step[3:]) < 1e-11 * size:
            return rotation, place - rotation @ middle
    return None


def _refuse_line(points: FloatArray) -> None:
    if len(points) < 3:
        raise DegenerateError(f"a rigid motion needs 3 pairs of points or more, got {len(points)}")
    if (width := width_of(points)) < LINE_RATIO:
        raise DegenerateError(
            f"the {len(points)} points lie on one line (width {width:.2g} of the length): the turn about it stays free",
            advice="Touch the scan plane at places off one line, near and far, left and right.",
        )


def width_of(points: FloatArray) -> float:
    """Second over first singular value of the centred points: 0 on a line."""
    strength = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(strength[1] / strength[0]) if strength[0] > 0 else 0.0


def _cross_matrices(vectors: FloatArray) -> FloatArray:
    """(N, 3, 3) matrices [v]_x with [v]_x w = v x w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def _motion(rotation: FloatArray, shift: FloatArray) -> RigidTransform:
    return RigidTransform.from_components(shift, Rotation.from_matrix(rotation))
