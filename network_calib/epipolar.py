"""Two-view geometry in nominal rays: many fundamental matrices refined together, and their Sampson distances.

Rays still carry the lens distortion, so each camera has one *bend*, shared by all its pairs: the undistorted ray is
x (1 + bend q) with q = r^2 / (1 + r^2), which is the first radial term near the axis and stays bounded for wide rays.
Without it a wide lens shifts honest observations by tens of pixels off their epipolar lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.observations import BoolArray, FloatArray, IntArray

# Annealed scale of the robust loss, in tolerances: wide enough at first for an unmodelled lens, then honest noise.
LOSS_SCALES = (4.0, 2.0, 1.0, 0.5, 0.5, 0.5)
# Standard deviation of a bend before the data: k1 = -0.3 seen through half the nominal focal length bends by 1.2.
BEND_SIGMA = 0.7
MAX_BEND = 2.0
PAIRS_AT_ONCE = 128


@dataclass(frozen=True, slots=True)
class SharedRays:
    """For P pairs of cameras, n places for spots that both see.

    Attributes:
        a: (P,) first camera of each pair.
        b: (P,) second camera.
        ray_a: (P, n, 2) nominal rays of the first camera.
        ray_b: (P, n, 2) of the second.
        is_used: (P, n) False where a pair has fewer spots than places.
    """

    a: IntArray
    b: IntArray
    ray_a: FloatArray
    ray_b: FloatArray
    is_used: BoolArray

    def part(self, which: slice) -> SharedRays:
        return SharedRays(self.a[which], self.b[which], self.ray_a[which], self.ray_b[which], self.is_used[which])


def unbend(ray_xy: FloatArray, bend: FloatArray) -> FloatArray:
    """Rays (..., 2) with the radial bend (...) taken out; see the module."""
    return ray_xy * (1 + bend * _bending(ray_xy))[..., None]


def tolerance_at(tolerance: FloatArray, ray_xy: FloatArray) -> FloatArray:
    """(...) tolerance (...) at rays (..., 2), in ray units.

    A pixel of a lens that sees far off its axis spans d(tan theta) = (1 + r^2) d(theta): beyond 45 degrees the
    tolerance grows by r^2.
    """
    return tolerance * np.maximum(1.0, (ray_xy**2).sum(axis=-1))


def sampson(
    fundamental: FloatArray, ray_a: FloatArray, ray_b: FloatArray, tolerance_a: FloatArray, tolerance_b: FloatArray
) -> FloatArray:
    """Signed Sampson distance in tolerances.

    Args:
        fundamental: (..., 3, 3), x_b^T F x_a = 0.
        ray_a: (..., n, 2) rays of the first camera.
        ray_b: (..., n, 2) rays of the second.
        tolerance_a: (..., n) in ray units; so the two cameras may differ.
        tolerance_b: (..., n).

    Returns:
        (..., n): 1 where the smallest correction that satisfies the epipolar constraint is one tolerance.
    """
    line_b, line_a = _lines(fundamental, ray_a, ray_b)
    error = line_b[..., 0] * ray_b[..., 0] + line_b[..., 1] * ray_b[..., 1] + line_b[..., 2]
    return error / _gradient(line_a, line_b, tolerance_a, tolerance_b)


def refine_fundamentals(
    fundamental: FloatArray, rays: SharedRays, tolerance: FloatArray, is_bend_fixed: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Robust Gauss-Newton on the Sampson distance of all pairs at once, with one bend for each camera.

    The pairs are coupled only through the bends, so each pair's nine entries are eliminated first (an arrow-shaped
    system); F keeps rank 2 and norm 1 by leaving out the two directions that would change them.

    Args:
        fundamental: (P, 3, 3) rough matrices.
        rays: the spots.
        tolerance: (C,) ray units.
        is_bend_fixed: (C,) cameras whose bend stays 0.

    Returns:
        (P, 3, 3) fundamental matrices of rank 2 and Frobenius norm 1, (C,) bends, and (P, 9, 9) the information of
        each matrix's entries, row by row: the inverse of their covariance on that manifold, the noise estimated.
    """
    bend = np.zeros(len(tolerance))
    fundamental = nearest_fundamental(fundamental)
    if not len(fundamental):
        return fundamental, bend, np.zeros((0, 9, 9))
    variance = np.ones(len(fundamental))
    hessian = np.zeros((len(fundamental), 11, 11))
    for scale in LOSS_SCALES:
        blocks = [
            _blocks(fundamental[s], rays.part(s), tolerance, bend, scale)
            for s in (slice(i, i + PAIRS_AT_ONCE) for i in range(0, len(fundamental), PAIRS_AT_ONCE))
        ]
        hessian, gradient, variance = (np.concatenate(part) for part in zip(*blocks, strict=True))
        step, bend_step = _arrow_step(fundamental, hessian, gradient, rays, bend, is_bend_fixed)
        fundamental = nearest_fundamental(fundamental + step)
        bend = np.clip(bend + bend_step, -MAX_BEND, MAX_BEND)
    return fundamental, bend, hessian[:, :9, :9] / variance[:, None, None]


def nearest_fundamental(matrix: FloatArray) -> FloatArray:
    """The rank-2 matrices nearest to (..., 3, 3), with Frobenius norm 1."""
    u, s, vt = np.linalg.svd(matrix)
    s = s * [1.0, 1.0, 0.0]
    s = s / np.maximum(np.linalg.norm(s, axis=-1, keepdims=True), 1e-300)
    return (u * s[..., None, :]) @ vt


def homogeneous(ray_xy: FloatArray) -> FloatArray:
    """(..., 3) rays with z = 1 of (..., 2)."""
    return np.concatenate([ray_xy, np.ones((*ray_xy.shape[:-1], 1))], axis=-1)


def _bending(ray_xy: FloatArray) -> FloatArray:
    r2 = (ray_xy**2).sum(axis=-1)
    return r2 / (1 + r2)


def _lines(fundamental: FloatArray, ray_a: FloatArray, ray_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Epipolar lines F x_a in the second camera and F^T x_b in the first."""
    line_b = ray_a @ np.swapaxes(fundamental[..., :, :2], -1, -2) + fundamental[..., None, :, 2]
    line_a = ray_b @ fundamental[..., :2, :] + fundamental[..., None, 2, :]
    return line_b, line_a


def _gradient(line_a: FloatArray, line_b: FloatArray, tolerance_a: FloatArray, tolerance_b: FloatArray) -> FloatArray:
    squared = tolerance_a**2 * (line_a[..., 0] ** 2 + line_a[..., 1] ** 2)
    squared += tolerance_b**2 * (line_b[..., 0] ** 2 + line_b[..., 1] ** 2)
    return np.sqrt(np.maximum(squared, 1e-30))


def _blocks(
    fundamental: FloatArray, rays: SharedRays, tolerance: FloatArray, bend: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normal equations (P, 11, 11), (P, 11) of [F row by row, bend of a, bend of b] with Geman-McClure weights.

    The third array is the weighted variance (P,) of the residuals, in tolerances squared.
    """
    ray_a = unbend(rays.ray_a, bend[rays.a][:, None])
    ray_b = unbend(rays.ray_b, bend[rays.b][:, None])
    line_b, line_a = _lines(fundamental, ray_a, ray_b)
    size = _gradient(
        line_a,
        line_b,
        tolerance_at(tolerance[rays.a][:, None], rays.ray_a),
        tolerance_at(tolerance[rays.b][:, None], rays.ray_b),
    )
    x_a, x_b = homogeneous(ray_a), homogeneous(ray_b)
    residual = (line_b * x_b).sum(axis=-1) / size
    jacobian = np.empty((*residual.shape, 11))
    jacobian[..., :9] = (x_b[..., :, None] * x_a[..., None, :]).reshape(*residual.shape, 9)
    jacobian[..., 9] = (line_a[..., :2] * rays.ray_a).sum(axis=-1) * _bending(rays.ray_a)
    jacobian[..., 10] = (line_b[..., :2] * rays.ray_b).sum(axis=-1) * _bending(rays.ray_b)
    jacobian /= size[..., None]
    weight = rays.is_used / (1 + (residual / scale) ** 2) ** 2
    weighted = np.swapaxes(jacobian * weight[..., None], -1, -2)
    variance = (weight * residual**2).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0) + 1e-12
    return weighted @ jacobian, (weighted @ residual[..., None])[..., 0], variance


def _arrow_step(
    fundamental: FloatArray,
    hessian: FloatArray,
    gradient: FloatArray,
    rays: SharedRays,
    bend: FloatArray,
    is_bend_fixed: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step (P, 3, 3) of the matrices and (C,) of the bends."""
    n_pairs = len(fundamental)
    u, _, vt = np.linalg.svd(fundamental)
    null = (u[:, :, 2, None] * vt[:, 2, None, :]).reshape(n_pairs, 9, 1)
    own = fundamental.reshape(n_pairs, 9, 1)
    size = np.trace(hessian[:, :9, :9], axis1=1, axis2=2)[:, None, None] + 1e-12
    block = hessian[:, :9, :9] + size * (own @ own.swapaxes(1, 2) + null @ null.swapaxes(1, 2) + 1e-9 * np.eye(9))
    solved = np.linalg.solve(block, np.concatenate([hessian[:, :9, 9:], gradient[:, :9, None]], axis=2))
    reduced = hessian[:, 9:, 9:] - hessian[:, 9:, :9] @ solved[:, :, :2]
    rhs = gradient[:, 9:] - (hessian[:, 9:, :9] @ solved[:, :, 2:])[..., 0]
    ends = np.stack([rays.a, rays.b], axis=1)
    # Residuals are in tolerances, of which an honest standard deviation is about a fifth.
    matrix = np.diag(np.where(is_bend_fixed, 1e12, (0.2 / BEND_SIGMA) ** 2))
    vector = -matrix.diagonal() * bend
    np.add.at(matrix, (ends[:, :, None], ends[:, None, :]), reduced)
    np.add.at(vector, ends, -rhs)
    bend_step = np.linalg.solve(matrix, vector).astype(np.float64)
    step = -solved[:, :, 2] - (solved[:, :, :2] @ bend_step[ends][..., None])[..., 0]
    return step.reshape(n_pairs, 3, 3), bend_step
