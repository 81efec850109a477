"""Figures that say how good a calibration is: errors of each camera, coverage, hold-out, predicted spot uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from network_calib.observations import BoolArray, FloatArray
from network_calib.refine import Refined, fit
from network_calib.result import CameraQuality, ErrorSummary
from network_calib.room_setup import CameraSetup
from network_calib.spots import SpotViews, locate, reprojection_error

COVERAGE_CELLS = (8, 6)
# Long enough that neighbouring frames are not the test of each other, many enough to reach every part of the room.
N_SEGMENTS = 25
# A held-out observation counts up to this many sigma: wide, so that the errors are not trimmed to look good.
HOLDOUT_TOLERANCE_SIGMA = 10.0


@dataclass(frozen=True, slots=True)
class Holdout:
    """Errors of segments that were left out of one extra fit.

    Attributes:
        error_px: (K,) NaN for observations that were fitted or do not agree within the tolerance.
        agreeing_share: of the held-out observations, the share within the tolerance.
    """

    error_px: FloatArray
    agreeing_share: float


@dataclass(frozen=True, slots=True)
class Repeats:
    """The same calibration with other seeds.

    Attributes:
        centre_spread: largest distance of a camera centre from the reported one; world units, NaN without repeats.
        focal_spread_px: largest difference of a focal length.
        n_failed: repeats that did not calibrate.
        n_repeats: how many were tried.
    """

    centre_spread: float
    focal_spread_px: float
    n_failed: int
    n_repeats: int


def hold_out(setups: Sequence[CameraSetup], refined: Refined, views: SpotViews, *, share: float) -> Holdout:
    """Fit without a share of the trajectory, in contiguous segments; triangulate these and measure them."""
    segment = np.arange(views.n_points) * N_SEGMENTS // max(views.n_points, 1)
    every = max(round(1 / share), 2) if share > 0 else 2 * N_SEGMENTS
    is_held = segment % every == every // 2
    error_px = np.full(len(views.point), np.nan)
    if not is_held.any():
        return Holdout(error_px, float("nan"))
    is_fitted = refined.is_inlier & ~is_held[views.point]
    cameras = fit(setups, refined.cameras, views, refined.points, is_fitted, refined.noise)
    held = views.select_points(is_held)
    tolerance = np.maximum(HOLDOUT_TOLERANCE_SIGMA * refined.noise[held.camera] * held.sigma_px, 1.0)
    points, agrees = locate(cameras, held, tolerance)
    error = np.linalg.norm(reprojection_error(cameras, held, points), axis=1)
    error_px[is_held[views.point]] = np.where(agrees, error, np.nan)
    return Holdout(error_px, float(agrees.mean()) if len(agrees) else float("nan"))


def coverage(setup: CameraSetup, px: FloatArray) -> float:
    """Share of an image's 8 x 6 cells that hold one of the pixels (N, 2)."""
    nx, ny = COVERAGE_CELLS
    cell = np.floor((px + 0.5) / np.array(setup.size_px) * [nx, ny]).astype(np.int64)
    cell = cell[((cell >= 0) & (cell < [nx, ny])).all(axis=1)]
    return len(np.unique(cell[:, 0] * ny + cell[:, 1])) / (nx * ny)


def camera_qualities(
    setups: Sequence[CameraSetup], refined: Refined, views: SpotViews, held: Holdout
) -> tuple[CameraQuality, ...]:
    """Figures of each camera."""
    error = np.linalg.norm(reprojection_error(refined.cameras, views, refined.points), axis=1)
    noise_px = refined.noise_px(views)
    out = []
    for c, setup in enumerate(setups):
        own = views.camera == c
        inlier = own & refined.is_inlier
        out.append(
            CameraQuality(
                n_observations=int(own.sum()),
                fitted=ErrorSummary.of(error[inlier]),
                holdout=ErrorSummary.of(_finite(held.error_px[own])),
                noise_sigma_px=float(noise_px[c]),
                coverage=coverage(setup, views.px[inlier]),
            )
        )
    return tuple(out)


def overall_error(refined: Refined, views: SpotViews) -> ErrorSummary:
    """Error of all inliers."""
    error = np.linalg.norm(reprojection_error(refined.cameras, views, refined.points), axis=1)
    return ErrorSummary.of(error[refined.is_inlier])


def overall_holdout(held: Holdout) -> ErrorSummary:
    """Error of all held-out observations that agree."""
    return ErrorSummary.of(_finite(held.error_px))


def chi2_per_dof(refined: Refined, views: SpotViews, is_sigma_given: BoolArray) -> float:
    """Weighted sum of squares over degrees of freedom.

    With the detector's own sigma where it gave one for every inlier, else with the estimated noise (then near one by
    construction).
    """
    rows = np.flatnonzero(refined.is_inlier)
    noise = np.ones(len(refined.noise)) if is_sigma_given[rows].all() else refined.noise
    sigma = noise[views.camera[rows]] * views.sigma_px[rows]
    error = reprojection_error(refined.cameras, views, refined.points)[rows] / sigma[:, None]
    n_points = len(np.unique(views.point[rows]))
    n_shared = refined.state.n_shared - 7
    return float((error**2).sum() / max(2 * len(rows) - 3 * n_points - n_shared, 1))


def _finite(values: FloatArray) -> FloatArray:
    return values[np.isfinite(values)]
