"""Pose and focal ratio of one camera from triangulated spots: a robust search, then robust Gauss-Newton."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from network_calib.observations import BoolArray, FloatArray

MIN_SPOTS = 12
# Factors on the expected ratio, tried in this order until one explains the spots.
RATIO_FACTORS = (1.0, 0.8, 1.25, 0.6, 1.6)
RATIO_LOG_SIGMA = 0.3
# The expected ratio may be off by some percent, which moves the rim of the image by many tolerances.
SEARCH_TOLERANCES = 6.0
LOSS_SCALES = (8.0, 4.0, 2.0, 1.0, 1.0, 1.0, 1.0)
ENOUGH_INLIERS = 0.7


@dataclass(frozen=True, slots=True)
class Resection:
    """One camera found from its spots.

    Attributes:
        rotation: (3, 3) cam_from_world.
        centre: (3,) in world.
        ratio: focal ratio.
        is_inlier: (N,) spots within tolerance.
    """

    rotation: FloatArray
    centre: FloatArray
    ratio: float
    is_inlier: BoolArray


def resect(
    ray_xy: FloatArray, points: FloatArray, tolerance: FloatArray, *, ratio: float, is_ratio_fixed: bool
) -> Resection | None:
    """Find the camera that sees `points` at `ray_xy`.

    Args:
        ray_xy: (N, 2) nominal rays without bend.
        points: (N, 3) in world.
        tolerance: (N,) ray units.
        ratio: expected focal ratio.
        is_ratio_fixed: leave the ratio as it is.

    Returns:
        The best camera of several searches, or None where no search finds one or it explains too few spots.
    """
    if len(ray_xy) < MIN_SPOTS:
        return None
    best: Resection | None = None
    for factor in RATIO_FACTORS[:1] if is_ratio_fixed else RATIO_FACTORS:
        pose = _search(ray_xy / (ratio * factor), points, float(np.median(tolerance)) / (ratio * factor))
        if pose is None:
            continue
        found = refine_camera(ray_xy, points, tolerance, *pose, ratio * factor, is_ratio_fixed=is_ratio_fixed)
        if best is None or found.is_inlier.sum() > best.is_inlier.sum():
            best = found
        if best.is_inlier.mean() >= ENOUGH_INLIERS:
            break
    return best if best is not None and best.is_inlier.sum() >= MIN_SPOTS else None


def refine_camera(
    ray_xy: FloatArray,
    points: FloatArray,
    tolerance: FloatArray,
    rotation: FloatArray,
    centre: FloatArray,
    ratio: float,
    *,
    is_ratio_fixed: bool,
) -> Resection:
    """Robust Gauss-Newton on pose and log(ratio), Geman-McClure weights with a falling scale."""
    log_start = np.log(ratio)
    log_ratio = log_start
    for scale in LOSS_SCALES:
        residual, jacobian = _linearise(ray_xy, points, tolerance, rotation, centre, log_ratio)
        weight = 1 / (1 + (residual**2).sum(axis=1) / scale**2) ** 2
        flat = jacobian.reshape(-1, 7)
        weighted = flat * np.repeat(weight, 2)[:, None]
        hessian, gradient = weighted.T @ flat, weighted.T @ residual.ravel()
        gradient[6] += (log_ratio - log_start) / RATIO_LOG_SIGMA**2
        hessian[6, 6] += 1 / RATIO_LOG_SIGMA**2
        hessian += np.diag(1e-9 * hessian.diagonal() + 1e-12)
        n_free = 6 if is_ratio_fixed else 7
        step = np.zeros(7)
        step[:n_free] = -np.linalg.solve(hessian[:n_free, :n_free], gradient[:n_free])
        if not np.isfinite(step).all():
            break
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        centre, log_ratio = centre + step[3:6], log_ratio + float(np.clip(step[6], -0.5, 0.5))
    residual, _ = _linearise(ray_xy, points, tolerance, rotation, centre, log_ratio)
    is_in_front = (points - centre) @ rotation[2] > 0
    return Resection(rotation, centre, float(np.exp(log_ratio)), is_in_front & (np.hypot(*residual.T) <= 1))


def _linearise(
    ray_xy: FloatArray,
    points: FloatArray,
    tolerance: FloatArray,
    rotation: FloatArray,
    centre: FloatArray,
    log_ratio: float,
) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 2) in tolerances and their Jacobian (N, 2, 7) by turn, centre and log ratio."""
    in_cam = (points - centre) @ rotation.T
    # A spot behind the camera keeps a large residual and so loses its weight.
    inverse_z = 1 / np.maximum(in_cam[:, 2], 1e-3 * np.abs(in_cam).max(axis=1) + 1e-12)
    xy = in_cam[:, :2] * inverse_z[:, None]
    size = np.exp(log_ratio) / tolerance
    residual = size[:, None] * xy - ray_xy / tolerance[:, None]
    x, y, one = xy[:, 0], xy[:, 1], np.ones(len(xy))
    jacobian = np.empty((len(xy), 2, 7))
    jacobian[:, 0, :3] = np.column_stack([-x * y, one + x * x, -y])
    jacobian[:, 1, :3] = np.column_stack([-one - y * y, x * y, x])
    jacobian[:, :, 3:6] = -(rotation[:2] - xy[:, :, None] * rotation[2]) * inverse_z[:, None, None]
    jacobian[:, :, 6] = xy
    return residual, jacobian * size[:, None, None]


def _search(ray_xy: FloatArray, points: FloatArray, tolerance: float) -> tuple[FloatArray, FloatArray] | None:
    """P3P in a MAGSAC search; rays are true ones."""
    params = cv2.UsacParams()
    params.threshold = SEARCH_TOLERANCES * tolerance
    params.confidence = 0.999
    params.maxIterations = 500
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    is_found, _, turn, shift, _ = cv2.solvePnPRansac(points, ray_xy, np.eye(3), np.zeros(4), params=params)
    if not is_found:
        return None
    rotation = Rotation.from_rotvec(np.ravel(turn)).as_matrix()
    centre = -rotation.T @ np.ravel(shift)
    return (rotation, centre) if np.isfinite(centre).all() else None
