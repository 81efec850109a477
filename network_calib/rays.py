"""From pixels back into the world: rays, points on a plane, and points seen by several cameras, with covariance.

Errors of the calibration are taken as independent from camera to camera: that is all that a result file says of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.camera_block import PART, CameraBlock
from network_calib.camera_parameters import N_PARAMETERS, CameraParameters
from network_calib.cameras import Cameras, cam_from_img
from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.triangulate import solve_symmetric3, triangulate, world_directions

# Gauss-Newton steps from the rays' nearest point to the pixels' likeliest: it converges quadratically.
N_STEPS = 6


@dataclass(frozen=True, slots=True)
class PixelRays:
    """Where N pixels look; NaN where not valid.

    Attributes:
        origins: (N, 3) camera centres in world.
        directions: (N, 3) unit vectors in world.
        ray_xy: (N, 2) x/z, y/z in the camera.
        is_valid: (N,) the pixel is inside the image, and the lens shows something there.
    """

    origins: FloatArray
    directions: FloatArray
    ray_xy: FloatArray
    is_valid: BoolArray


@dataclass(frozen=True, slots=True)
class LocatedPoints:
    """N points in world with covariance (N, 3, 3); NaN where not valid."""

    points: FloatArray
    covariance: FloatArray
    is_valid: BoolArray


@dataclass(frozen=True, slots=True)
class Plane:
    """Points x with normal . x = offset; the normal has unit length after construction."""

    normal: FloatArray
    offset: float

    def __post_init__(self) -> None:
        normal = np.asarray(self.normal, dtype=np.float64)
        length = float(np.linalg.norm(normal)) if normal.shape == (3,) else np.nan
        if not (length > 0 and np.isfinite(length) and np.isfinite(self.offset)):
            raise InputError(f"a plane needs a normal of three numbers and an offset, got {normal} and {self.offset}")
        object.__setattr__(self, "normal", normal / length)
        object.__setattr__(self, "offset", float(self.offset) / length)

    def basis(self) -> FloatArray:
        """(3, 2) two unit vectors in the plane, at right angles."""
        return np.linalg.svd(self.normal[None])[2][1:].T


class PixelLocator:
    """Cameras prepared for questions from their pixels.

    Args:
        cameras: C cameras.
        covariance: (C, 14, 14) in the order of `result.PARAMETER_NAMES`; None where the calibration counts as exact.

    Raises:
        InputError: a covariance of another shape.
    """

    def __init__(self, cameras: Cameras, covariance: FloatArray | None = None) -> None:
        expected = (len(cameras), N_PARAMETERS, N_PARAMETERS)
        if covariance is not None and covariance.shape != expected:
            raise InputError(f"a covariance of cameras has the shape {covariance.shape}, expected {expected}")
        self._cameras, self._covariance = cameras, covariance
        columns = np.full((len(cameras), N_PARAMETERS), -1, dtype=np.int64)
        self._parameters = CameraParameters.from_cameras(cameras, columns)

    def rays(self, camera: IntArray, px: FloatArray) -> PixelRays:
        """Rays of pixels (N, 2), each of its own camera (N,)."""
        ray_xy, is_valid = np.full(px.shape, np.nan), np.zeros(len(px), dtype=bool)
        rows = np.flatnonzero(self._cameras.is_in_image(camera, px))
        if len(rows):
            intrinsics, is_fisheye = self._cameras.intrinsics[camera[rows]], self._parameters.is_fisheye[camera[rows]]
            ray_xy[rows], is_valid[rows] = cam_from_img(intrinsics, is_fisheye, px[rows])
        origins = np.where(is_valid[:, None], self._parameters.centres[camera], np.nan)
        return PixelRays(origins, world_directions(camera, ray_xy, self._parameters.rotations), ray_xy, is_valid)

    def on_plane(self, camera: IntArray, px: FloatArray, plane: Plane, *, sigma_px: float) -> LocatedPoints:
        """Where rays meet a plane; `sigma_px` is the pixels' standard deviation per axis.

        Not valid where the ray runs along the plane or away from it.
        """
        rays = self.rays(camera, px)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            distance = (plane.offset - rays.origins @ plane.normal) / (rays.directions @ plane.normal)
            points = rays.origins + distance[:, None] * rays.directions
        is_valid = rays.is_valid & (distance > 0) & np.isfinite(points).all(axis=1)
        covariance = np.full((len(px), 3, 3), np.nan)
        rows, basis = np.flatnonzero(is_valid), plane.basis()
        if len(rows):
            _, spread, slope = self._seen(camera[rows], px[rows], points[rows], sigma_px)
            with np.errstate(all="ignore"):
                # The pixel moves with the point in the plane by slope basis (2, 2); its inverse carries errors back.
                back = basis @ _inverse2(slope @ basis)
                covariance[rows] = back @ spread @ back.transpose(0, 2, 1)
        return _whole(points, covariance, is_valid)

    def triangulated(
        self, camera: IntArray, point: IntArray, px: FloatArray, n_points: int, *, sigma_px: float
    ) -> LocatedPoints:
        """The likeliest points of pixels (K, 2) in cameras (K,), each a view of the point (K,).

        A pixel is as uncertain as `sigma_px` and its camera's calibration make it. Not valid with fewer than two rays,
        with parallel ones, or behind a camera.
        """
        rays = self.rays(camera, px)
        rows = np.flatnonzero(rays.is_valid)
        rows = rows[np.argsort(point[rows], kind="stable")]
        camera, point, px = camera[rows], point[rows], px[rows]
        weights = self._parameters.optics[camera, 0] ** 2
        rotations, centres = self._parameters.rotations, self._parameters.centres
        points, is_valid = triangulate(
            camera, point, rays.ray_xy[rows], rotations, centres, n_points, weights=weights / weights.max(initial=1.0)
        )
        kept = is_valid[point]
        refined, covariance = self._likeliest(camera[kept], point[kept], px[kept], points, sigma_px)
        return _whole(refined, covariance, is_valid)

    def _likeliest(
        self, camera: IntArray, point: IntArray, px: FloatArray, points: FloatArray, sigma_px: float
    ) -> tuple[FloatArray, FloatArray]:
        """Points (F, 3) moved to the least weighted squares of their pixels, and the covariance (F, 3, 3) there."""
        points = points.copy()
        cost, matrix, gradient = self._normal_equations(camera, point, px, points, sigma_px)
        for _ in range(N_STEPS):
            trial = points - solve_symmetric3(matrix, gradient)
            next_cost, next_matrix, next_gradient = self._normal_equations(camera, point, px, trial, sigma_px)
            is_better = next_cost < cost
            if not is_better.any():
                break
            points[is_better], cost[is_better] = trial[is_better], next_cost[is_better]
            matrix[is_better], gradient[is_better] = next_matrix[is_better], next_gradient[is_better]
        columns = [solve_symmetric3(matrix, np.tile(unit, (len(points), 1))) for unit in np.eye(3)]
        return points, np.stack(columns, axis=-1)

    def _normal_equations(
        self, camera: IntArray, point: IntArray, px: FloatArray, points: FloatArray, sigma_px: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(F,) weighted squares, infinite behind a camera, their matrix (F, 6) and gradient (F, 3)."""
        with np.errstate(all="ignore"):  # a step may lead behind a camera, which the infinite cost undoes
            error, spread, slope = self._seen(camera, px, points[point], sigma_px)
            weight = _inverse2(spread)
            weighted = weight @ slope
            square = np.einsum("ka,kab,kb->k", error, weight, error)
            products = np.einsum("kai,kaj->kij", slope, weighted)
            gradient = np.einsum("ka,kai->ki", error, weighted)
        rows = np.column_stack(
            [
                np.where(np.isfinite(square), square, np.inf),
                products[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]],
                gradient,
            ]
        )
        summed = np.empty((len(points), rows.shape[1]))
        for place, column in enumerate(rows.T):
            summed[:, place] = np.bincount(point, weights=column, minlength=len(points))
        return summed[:, 0], summed[:, 1:7], summed[:, 7:]

    def _seen(
        self, camera: IntArray, px: FloatArray, points: FloatArray, sigma_px: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of points (K, 3): predicted minus given pixel (K, 2), its covariance (K, 2, 2), slope (K, 2, 3) by point."""
        rows = np.arange(len(camera))
        block = CameraBlock(camera, rows, px.T, np.ones(len(camera)), self._parameters.columns)
        error, by_camera, by_point = block.linearise({PART: self._parameters}, points.T, slice(0, len(camera)))
        spread = np.tile(sigma_px**2 * np.eye(2), (len(camera), 1, 1))
        if self._covariance is not None:
            for one in np.unique(camera):
                is_its = camera == one
                slope = by_camera[:, :, is_its].transpose(2, 1, 0)
                spread[is_its] += slope @ self._covariance[one] @ slope.transpose(0, 2, 1)
        return error.T, spread, by_point.transpose(2, 1, 0)


def _whole(points: FloatArray, covariance: FloatArray, is_valid: BoolArray) -> LocatedPoints:
    """Points whose position and covariance are both known; the rest is NaN."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    is_valid = is_valid & np.isfinite(points).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    is_valid &= (variance >= 0).all(axis=1)
    return LocatedPoints(
        np.where(is_valid[:, None], points, np.nan), np.where(is_valid[:, None, None], covariance, np.nan), is_valid
    )


def _inverse2(matrix: FloatArray) -> FloatArray:
    """Inverses of (..., 2, 2); not finite where there is none."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    adjugate = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2)
    return adjugate / (a * d - b * c)[..., None, None]
