"""The left-out test: frames that were not fitted, each view predicted from the other cameras of its frame.

An own triangulation, apart from the product's: linear, then Gauss-Newton on pixels with numerical derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.cameras import Cameras, cam_from_img
from network_calib.observations import FloatArray, IntArray, Observations

GAUSS_NEWTON_STEPS = 6


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Distances between predicted and seen pixels: median, mean of the lowest 95 %, 95th percentile."""

    n: int
    median_px: float
    trimmed_px: float
    p95_px: float


def even_frames(observations: Observations) -> Observations:
    """What is fitted."""
    return observations.select(observations.frame % 2 == 0)


def left_out_error(cameras: Cameras, observations: Observations) -> LeftOut:
    """Error over the odd frames that three cameras or more saw."""
    errors = left_out_errors(cameras, observations.select(observations.frame % 2 == 1).in_frames_with_views(3))
    errors = np.sort(errors[np.isfinite(errors)])
    return LeftOut(
        n=len(errors),
        median_px=float(np.median(errors)),
        trimmed_px=float(errors[: int(0.95 * len(errors))].mean()),
        p95_px=float(np.percentile(errors, 95)),
    )


def left_out_errors(cameras: Cameras, observations: Observations) -> FloatArray:
    """(K,) for every row: the distance to the prediction from the other rows of its frame; NaN behind a camera."""
    target, other = _pairs_in_frames(observations.frame)
    n, camera, px = len(observations), observations.camera, observations.px
    points = _linear_points(cameras, camera[other], px[other], target, n)
    for _ in range(GAUSS_NEWTON_STEPS):
        points = points + _gauss_newton_step(cameras, camera[other], px[other], target, points)
    predicted, _ = cameras.img_from_world(camera, points)
    return np.linalg.norm(predicted - px, axis=1)


def _pairs_in_frames(frame: IntArray) -> tuple[IntArray, IntArray]:
    """All ordered pairs of different rows of one frame: the row to predict, and one that helps to."""
    _, first, count = np.unique(frame, return_index=True, return_counts=True)
    target = np.repeat(np.arange(len(frame)), np.repeat(count, count))
    offset = np.concatenate([np.tile(np.arange(c), c) for c in count])
    other = np.repeat(np.repeat(first, count), np.repeat(count, count)) + offset
    is_pair = target != other
    return target[is_pair], other[is_pair]


def _linear_points(cameras: Cameras, camera: IntArray, px: FloatArray, target: IntArray, n: int) -> FloatArray:
    """(n, 3) where the rays of each target's helpers meet: smallest eigenvector of the 4 x 4 normal matrix."""
    ray_xy, _ = cam_from_img(cameras.intrinsics[camera], cameras.is_fisheye[camera], px)
    pose = cameras.cam_from_world.as_matrix()[camera]
    equations = ray_xy[:, :, None] * pose[:, 2:3, :] - pose[:, :2, :]
    normal = np.zeros((n, 4, 4))
    np.add.at(normal, target, np.nan_to_num(np.einsum("kri,krj->kij", equations, equations)))
    _, vectors = np.linalg.eigh(normal)
    return vectors[:, :3, 0] / vectors[:, 3:, 0]


def _gauss_newton_step(
    cameras: Cameras, camera: IntArray, px: FloatArray, target: IntArray, points: FloatArray
) -> FloatArray:
    """(n, 3) least-squares steps of all points on the pixels of their helpers."""
    at = points[target]
    predicted, _ = cameras.img_from_world(camera, at)
    size = 1e-6 * np.maximum(np.linalg.norm(at, axis=1), 1e-9)
    slope = np.stack(
        [
            (cameras.img_from_world(camera, at + size[:, None] * axis)[0] - predicted) / size[:, None]
            for axis in np.eye(3)
        ],
        axis=-1,
    )
    normal, gradient = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    np.add.at(normal, target, np.einsum("kri,krj->kij", slope, slope))
    np.add.at(gradient, target, np.einsum("kri,kr->ki", slope, px - predicted))
    is_usable = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1)
    step = np.full((len(points), 3), np.nan)
    step[is_usable] = np.einsum("nij,nj->ni", np.linalg.pinv(normal[is_usable], hermitian=True), gradient[is_usable])
    return step
