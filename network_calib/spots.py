"""Spots from cameras: latent positions of all frames, reprojection errors, and which detections agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.camera_block import PART, CameraBlock
from network_calib.camera_parameters import N_PARAMETERS, CameraParameters
from network_calib.cameras import Cameras, cam_from_img
from network_calib.observations import BoolArray, FloatArray, IntArray, Observations
from network_calib.triangulate import triangulate_robust


@dataclass(frozen=True, slots=True)
class SpotViews:
    """Observations whose frames are numbered as points 0..F-1, each seen by two cameras or more.

    Attributes:
        observations: K rows sorted by frame, then camera.
        point: (K,) point index.
        frames: (F,) frame number of each point.
        sigma_px: (K,) the detector's standard deviation, 1 where it gave none.
    """

    observations: Observations
    point: IntArray
    frames: IntArray
    sigma_px: FloatArray

    @classmethod
    def of(cls, observations: Observations) -> SpotViews:
        """Keep the frames with two views or more."""
        kept = observations.in_frames_with_views(2)
        frames, point = np.unique(kept.frame, return_inverse=True)
        return cls(kept, point.astype(np.int64), frames, np.where(np.isnan(kept.sigma_px), 1.0, kept.sigma_px))

    @property
    def camera(self) -> IntArray:
        return self.observations.camera

    @property
    def px(self) -> FloatArray:
        return self.observations.px

    @property
    def n_points(self) -> int:
        return len(self.frames)

    @property
    def n_cameras(self) -> int:
        return self.observations.n_cameras

    def select_points(self, is_kept: BoolArray) -> SpotViews:
        """The views of the points where `is_kept` (F,) holds, renumbered."""
        rows = is_kept[self.point]
        number = np.cumsum(is_kept) - 1
        return SpotViews(
            self.observations.select(rows), number[self.point[rows]], self.frames[is_kept], self.sigma_px[rows]
        )


def reprojection_error(cameras: Cameras, views: SpotViews, points: FloatArray) -> FloatArray:
    """(K, 2) predicted minus detected pixel for points (F, 3); infinite where the prediction is not valid."""
    px, is_valid = cameras.img_from_world(views.camera, points[views.point])
    return np.where(is_valid[:, None], px - views.px, np.inf)


def locate(cameras: Cameras, views: SpotViews, tolerance_px: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Triangulate every spot robustly.

    Args:
        cameras: C cameras.
        views: K observations.
        tolerance_px: (K,) largest reprojection error of an honest observation.

    Returns:
        (F, 3) points, NaN where no two views agree, and (K,) which observations agree with their spot.
    """
    intrinsics = cameras.intrinsics[views.camera]
    ray_xy, has_ray = cam_from_img(intrinsics, cameras.is_fisheye[views.camera], views.px)
    rows = np.flatnonzero(has_ray)
    # A pixel is worth less angle off the axis; 1 + r^2 is the projection's own stretch along the radius.
    stretch = 1 + (ray_xy[rows] ** 2).sum(axis=1)
    tolerance = tolerance_px[rows] / intrinsics[rows, 0] * np.maximum(stretch, 1.0)
    points, _, agrees = triangulate_robust(
        views.camera[rows],
        views.point[rows],
        ray_xy[rows],
        cameras.rotations,
        cameras.centres_in_world,
        views.n_points,
        tolerance=tolerance,
    )
    is_inlier = np.zeros(len(views.camera), dtype=bool)
    is_inlier[rows] = agrees
    error = np.linalg.norm(reprojection_error(cameras, views, points), axis=1)
    is_inlier &= error <= tolerance_px
    return drop_lonely(views, points, is_inlier)


def located(points: FloatArray) -> BoolArray:
    """(F,) which points (F, 3) have a position."""
    return np.asarray(np.isfinite(points).all(axis=1))


def drop_lonely(views: SpotViews, points: FloatArray, is_inlier: BoolArray) -> tuple[FloatArray, BoolArray]:
    """A spot needs two agreeing views: others lose their position, and their views are no inliers."""
    n_views = np.bincount(views.point[is_inlier], minlength=views.n_points)
    is_located = (n_views >= 2) & located(points)
    return np.where(is_located[:, None], points, np.nan), is_inlier & is_located[views.point]


def spot_leverage(
    cameras: Cameras, views: SpotViews, points: FloatArray, is_inlier: BoolArray, sigma_px: FloatArray
) -> FloatArray:
    """(K, 2, 2) J C J': how uncertain each whitened prediction is through its spot, cameras taken as known.

    C is the covariance of the spot from its inliers, J the whitened derivative of the pixel by the spot. For an inlier
    it is the share of its own noise that the spot absorbs. Zero where the spot is not located.
    """
    rows, _, by_point = _linearised(cameras, views, points, sigma_px)
    spread = _spot_covariance(views, points, is_inlier, rows, by_point)
    leverage = np.zeros((len(views.point), 2, 2))
    leverage[rows] = np.einsum("imn,nij,jkn->nmk", by_point, spread[views.point[rows]], by_point, optimize=True)
    return leverage


def spots_from_cameras(
    cameras: Cameras, views: SpotViews, points: FloatArray, is_inlier: BoolArray, sigma_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where the cameras alone put each spot: one Gauss-Newton step from nearby positions.

    Returns:
        (F, 3) positions, NaN where not located, and (F, 3, 3) covariances, cameras taken as known.
    """
    rows, residual, by_point = _linearised(cameras, views, points, sigma_px)
    spread = _spot_covariance(views, points, is_inlier, rows, by_point)
    pull = np.einsum("imn,mn->in", by_point, np.nan_to_num(residual)) * is_inlier[rows]
    gradient = np.stack([np.bincount(views.point[rows], part, minlength=len(points)) for part in pull], axis=1)
    return points - np.einsum("fij,fj->fi", spread, gradient), spread


def _linearised(
    cameras: Cameras, views: SpotViews, points: FloatArray, sigma_px: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Rows of located spots, their whitened residuals (2, n), and derivatives (3, 2, n) by the spot."""
    rows = np.flatnonzero(located(points)[views.point])
    camera, point = views.camera[rows], views.point[rows]
    columns = np.full((len(cameras), N_PARAMETERS), -1, dtype=np.int64)
    block = CameraBlock(camera, point, np.ascontiguousarray(views.px[rows].T), 1 / sigma_px[rows], columns)
    parts = {PART: CameraParameters.from_cameras(cameras, columns)}
    residual, _, by_point = block.linearise(parts, np.ascontiguousarray(points[point].T), slice(0, len(rows)))
    return rows, residual, np.nan_to_num(by_point)


def _spot_covariance(
    views: SpotViews, points: FloatArray, is_inlier: BoolArray, rows: IntArray, by_point: FloatArray
) -> FloatArray:
    """(F, 3, 3) covariance of each spot from its inliers; zero where not located."""
    point, weight = views.point[rows], is_inlier[rows].astype(np.float64)
    normal = np.zeros((len(points), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            product = weight * np.einsum("mn,mn->n", by_point[i], by_point[j])
            normal[:, i, j] = normal[:, j, i] = np.bincount(point, product, minlength=len(points))
    spread = np.zeros_like(normal)
    is_located = located(points)
    spread[is_located] = np.linalg.pinv(normal[is_located], rcond=1e-12, hermitian=True)
    return spread


def normalised_error(
    cameras: Cameras, views: SpotViews, points: FloatArray, is_inlier: BoolArray, sigma_px: FloatArray
) -> FloatArray:
    """(K,) length of each residual in units of its own standard deviation (2 degrees of freedom).

    A residual that its spot was fitted to has covariance 1 - J C J' (whitened), one that was not has 1 + J C J'; so an
    observation gets the same verdict whether it is in or out. Infinite where the spot is not located.
    """
    error = reprojection_error(cameras, views, points) / sigma_px[:, None]
    sign = np.where(is_inlier, -1.0, 1.0)[:, None, None]
    spread = np.eye(2) + sign * spot_leverage(cameras, views, points, is_inlier, sigma_px)
    # A spot of two views leaves one direction of each residual empty: the small term keeps the inverse finite there.
    spread[:, [0, 1], [0, 1]] += 1e-6
    determinant = spread[:, 0, 0] * spread[:, 1, 1] - spread[:, 0, 1] * spread[:, 1, 0]
    ex, ey = error.T
    with np.errstate(invalid="ignore"):
        squared = spread[:, 1, 1] * ex**2 - 2 * spread[:, 0, 1] * ex * ey + spread[:, 0, 0] * ey**2
        out = np.sqrt(np.maximum(squared / determinant, 0.0))
    return np.where(np.isfinite(out), out, np.inf)
