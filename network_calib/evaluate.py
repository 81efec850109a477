"""Reprojection of observations that a calibration may never have seen: spots are triangulated, nothing is refitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray, Observations
from network_calib.result import Calibration, ErrorSummary
from network_calib.spots import SpotViews, locate, reprojection_error

# Honest observations of an honest calibration lie within this many of their camera's sigma, or within MIN_TOLERANCE_PX.
TOLERANCE_SIGMA, MIN_TOLERANCE_PX = 10.0, 2.0


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Errors of K observations in frames with two views or more.

    Attributes:
        overall: error of all inliers.
        cameras: the same for each camera of the calibration.
        error_px: (K,) reprojection error; NaN where the frame's views do not meet in a spot.
        is_inlier: (K,) the observation agrees with its frame's spot.
        camera: (K,) camera index in the calibration.
        n_frames: frames evaluated.
    """

    overall: ErrorSummary
    cameras: tuple[ErrorSummary, ...]
    error_px: FloatArray
    is_inlier: BoolArray
    camera: IntArray
    n_frames: int


def evaluate(calibration: Calibration, observations: Observations) -> Evaluation:
    """Triangulate every frame with the calibrated cameras and measure the reprojection error.

    Raises:
        InputError: an observed camera is not in the calibration, or no frame has two views.
    """
    names = tuple(camera.name for camera in calibration.cameras)
    views = SpotViews.of(with_cameras(observations, names))
    if not views.n_points:
        raise InputError("no frame was seen by two calibrated cameras: nothing to evaluate")
    cameras = calibration.as_cameras()
    noise = np.array([camera.quality.noise_sigma_px for camera in calibration.cameras])
    tolerance = np.maximum(TOLERANCE_SIGMA * noise, MIN_TOLERANCE_PX)[views.camera]
    points, is_inlier = locate(cameras, views, tolerance)
    error = np.linalg.norm(reprojection_error(cameras, views, points), axis=1)
    error = np.where(np.isfinite(points[views.point]).all(axis=1), error, np.nan)
    return Evaluation(
        overall=ErrorSummary.of(error[is_inlier]),
        cameras=tuple(ErrorSummary.of(error[is_inlier & (views.camera == c)]) for c in range(len(names))),
        error_px=error,
        is_inlier=is_inlier,
        camera=views.camera,
        n_frames=views.n_points,
    )


def with_cameras(observations: Observations, names: tuple[str, ...]) -> Observations:
    """The observations with camera indices that count in `names`."""
    unknown = [name for name in observations.camera_names if name not in names]
    if unknown:
        raise InputError(
            f"camera {unknown[0]!r} is not in the calibration, which has {', '.join(names)}",
            advice="Evaluate a recording of the same cameras, with the same names.",
        )
    number = np.array([names.index(name) for name in observations.camera_names], dtype=np.int64)
    return Observations.from_columns(
        names,
        camera=number[observations.camera],
        frame=observations.frame,
        px=observations.px,
        sigma_px=observations.sigma_px,
        stamp_ns=observations.stamp_ns,
    )
