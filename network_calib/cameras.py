"""Camera models: pinhole with radial-tangential distortion, and fisheye; alone and as a batch with poses.

Axes of a camera frame are OpenCV's: x right, y down, z forward. Intrinsics are one row of eight numbers for any model,
    [focal_x, focal_y, centre_x, centre_y, d0, d1, d2, d3]      (px; d is without unit)
where d is k1, k2, p1, p2 (radial-tangential, as in OpenCV's `projectPoints`) or k1..k4 (fisheye, as in `cv2.fisheye`).
A lens model says which of the d may differ from zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import RigidTransform

from network_calib.observations import BoolArray, FloatArray, IntArray

N_INTRINSICS = 8


class LensModel(StrEnum):
    """How a lens departs from a pinhole, named by its free terms."""

    NONE = "none"
    K1 = "k1"
    K1_K2 = "k1_k2"
    K1_K2_P1_P2 = "k1_k2_p1_p2"
    FISHEYE = "fisheye"

    @property
    def is_fisheye(self) -> bool:
        return self is LensModel.FISHEYE

    @property
    def n_distortion(self) -> int:
        """How many of the four distortion terms are free; the rest are zero."""
        return {LensModel.NONE: 0, LensModel.K1: 1, LensModel.K1_K2: 2}.get(self, 4)


@dataclass(frozen=True, slots=True)
class Cameras:
    """C posed cameras.

    Attributes:
        names: C names.
        size_px: (C, 2) image width, height.
        lenses: C lens models.
        intrinsics: (C, 8), see the module.
        cam_from_world: batch of C poses, x_in_cam = cam_from_world * x_in_world.
    """

    names: tuple[str, ...]
    size_px: IntArray
    lenses: tuple[LensModel, ...]
    intrinsics: FloatArray
    cam_from_world: RigidTransform

    def __len__(self) -> int:
        return len(self.names)

    @property
    def is_fisheye(self) -> BoolArray:
        return np.array([lens.is_fisheye for lens in self.lenses], dtype=bool)

    @property
    def rotations(self) -> FloatArray:
        """(C, 3, 3) rotation matrices cam_from_world."""
        return self.cam_from_world.rotation.as_matrix().reshape(-1, 3, 3)

    @property
    def centres_in_world(self) -> FloatArray:
        """(C, 3) camera centres."""
        return self.cam_from_world.inv().translation.reshape(-1, 3)

    def with_poses(self, rotations: FloatArray, centres_in_world: FloatArray) -> Cameras:
        """The same cameras at other poses: (C, 3, 3) rotations cam_from_world and (C, 3) centres."""
        return replace(self, cam_from_world=poses_from_centres(rotations, centres_in_world))

    def img_from_world(self, camera: IntArray, points_in_world: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Project one point with one camera for each row.

        Args:
            camera: (K,) camera index.
            points_in_world: (K, 3).

        Returns:
            (K, 2) pixels and (K,) whether the point is in front of the camera and its pixel is finite.
        """
        offset = points_in_world - self.centres_in_world[camera]
        points_in_cam = np.einsum("kij,kj->ki", self.rotations[camera], offset)
        return img_from_cam(self.intrinsics[camera], self.is_fisheye[camera], points_in_cam)

    def is_in_image(self, camera: IntArray, px: FloatArray) -> BoolArray:
        """(K,) whether pixels (K, 2) lie inside their camera's image."""
        return np.asarray(((px >= -0.5) & (px <= self.size_px[camera] - 0.5)).all(axis=-1))


def poses_from_centres(rotations: FloatArray, centres_in_world: FloatArray) -> RigidTransform:
    """Poses cam_from_world with the given rotations (C, 3, 3) and centres (C, 3): t = -R C."""
    matrices = np.tile(np.eye(4), (len(rotations), 1, 1))
    matrices[:, :3, :3] = rotations
    matrices[:, :3, 3] = -np.einsum("cij,cj->ci", rotations, centres_in_world)
    return RigidTransform.from_matrix(matrices)


def distort(distortion: FloatArray, is_fisheye: BoolArray, ray_xy: FloatArray) -> FloatArray:
    """Distorted normalised coordinates (..., 2) of undistorted x/z, y/z (..., 2), distortion (..., 4) terms.

    Radial-tangential: Brown's model, as in OpenCV. Fisheye: Kannala-Brandt, theta (1 + k1 theta^2 + ... + k4 theta^8).
    """
    x, y = ray_xy[..., 0], ray_xy[..., 1]
    d0, d1, d2, d3 = np.moveaxis(distortion, -1, 0)
    r2 = x * x + y * y
    radial = 1 + r2 * (d0 + r2 * d1)
    out = np.stack(
        [
            x * radial + 2 * d2 * x * y + d3 * (r2 + 2 * x * x),
            y * radial + d2 * (r2 + 2 * y * y) + 2 * d3 * x * y,
        ],
        axis=-1,
    )
    if np.any(is_fisheye):
        r = np.sqrt(r2)
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3))))
        scale = np.where(r > 1e-12, theta_d / np.where(r > 1e-12, r, 1.0), 1.0)
        out = np.where(np.asarray(is_fisheye)[..., None], ray_xy * scale[..., None], out)
    return out


def img_from_cam(
    intrinsics: FloatArray, is_fisheye: BoolArray, points_in_cam: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Project points in the camera frame.

    Args:
        intrinsics: (..., 8) rows, see the module.
        is_fisheye: (...) which of the two distortion models.
        points_in_cam: (..., 3).

    Returns:
        (..., 2) pixels, and whether each is valid: z > 0 and finite. Invalid pixels are NaN.
    """
    z = points_in_cam[..., 2]
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is not finite, and so reported as invalid
        ray_xy = points_in_cam[..., :2] / np.where(z > 1e-12, z, np.nan)[..., None]
        px = intrinsics[..., :2] * distort(intrinsics[..., 4:], is_fisheye, ray_xy) + intrinsics[..., 2:4]
    is_valid = np.asarray(np.isfinite(px).all(axis=-1))
    return np.where(is_valid[..., None], px, np.nan), is_valid


def cam_from_img(
    intrinsics: FloatArray, is_fisheye: BoolArray, px: FloatArray, *, max_iterations: int = 30
) -> tuple[FloatArray, BoolArray]:
    """Undistort pixels to x/z, y/z in the camera frame: Newton's method on `distort`.

    Args:
        intrinsics: (..., 8) rows, see the module.
        is_fisheye: (...) which of the two distortion models.
        px: (..., 2) pixels.
        max_iterations: Newton steps at most.

    Returns:
        (..., 2) ray x/z, y/z, and whether the inverse converged to a ray that projects back to the pixel within
        1e-9 of the focal length. A pixel beyond the radius where the distortion folds back has no ray. Invalid rays
        hold NaN.
    """
    target = (px - intrinsics[..., 2:4]) / intrinsics[..., :2]
    distortion = np.broadcast_to(intrinsics[..., 4:], (*target.shape[:-1], 4))
    fisheye = np.broadcast_to(is_fisheye, target.shape[:-1])
    with np.errstate(over="ignore", invalid="ignore"):  # Newton's way from a pixel that has no ray may overflow
        ray_xy = np.where(fisheye[..., None], _fisheye_ray(distortion, target), target) if fisheye.any() else target
        if not fisheye.all():
            for _ in range(max_iterations):
                error = distort(distortion, fisheye, ray_xy) - target
                if np.nanmax(np.abs(error), initial=0.0) < 1e-13:
                    break
                step = _solve2(_brown_jacobian(distortion, ray_xy), error)
                ray_xy = np.where(fisheye[..., None], ray_xy, ray_xy - step)
        error = np.abs(distort(distortion, fisheye, ray_xy) - target).max(axis=-1)
        is_valid = (error < 1e-9) & (fisheye | _is_before_fold(distortion, ray_xy))
        if distortion[..., 2:].any() and not fisheye.all():
            # Tangential terms fold an image a little before its radius does, to one side.
            slope = _brown_jacobian(distortion, ray_xy)
            is_valid &= fisheye | (slope[..., 0, 0] * slope[..., 1, 1] > slope[..., 0, 1] * slope[..., 1, 0])
    return np.where(is_valid[..., None], ray_xy, np.nan), is_valid


def _fisheye_ray(distortion: FloatArray, target: FloatArray, n_steps: int = 20) -> FloatArray:
    """Invert theta -> theta_d along the radius by Newton, then back to x/z, y/z; NaN from 90 degrees or the fold on."""
    d0, d1, d2, d3 = np.moveaxis(distortion, -1, 0)
    theta_d = np.linalg.norm(target, axis=-1)
    theta = np.minimum(theta_d, 1.5)
    for _ in range(n_steps):
        t2 = theta * theta
        value = theta * (1 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3)))) - theta_d
        slope = 1 + t2 * (3 * d0 + t2 * (5 * d1 + t2 * (7 * d2 + t2 * 9 * d3)))
        theta = theta - value / np.where(np.abs(slope) > 1e-6, slope, 1e-6)
    is_valid = (theta >= 0) & (theta < np.pi / 2)
    # A lens that folds back and then grows again has roots beyond the fold; looking at 32 angles on the way out finds
    # every fold that is wider than 3 degrees.
    for part in np.linspace(0, 1, 32):
        t2 = (part * theta) ** 2
        is_valid &= 1 + t2 * (3 * d0 + t2 * (5 * d1 + t2 * (7 * d2 + t2 * 9 * d3))) > 0
    radius = np.tan(np.where(is_valid, theta, np.nan))
    return target * np.where(theta_d > 1e-12, radius / np.where(theta_d > 1e-12, theta_d, 1.0), 1.0)[..., None]


def _brown_jacobian(distortion: FloatArray, ray_xy: FloatArray) -> FloatArray:
    """(..., 2, 2) derivative of the radial-tangential model with respect to x/z, y/z."""
    x, y = ray_xy[..., 0], ray_xy[..., 1]
    k1, k2, p1, p2 = np.moveaxis(distortion, -1, 0)
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * k2), 2 * (k1 + 2 * k2 * r2)
    cross = slope * x * y + 2 * (p1 * x + p2 * y)
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return np.stack([np.stack([xx, cross], -1), np.stack([cross, yy], -1)], -2)


def _solve2(matrix: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve (..., 2, 2) systems by Cramer's rule; a singular one gives NaN."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    det = a * d - b * c
    det = np.where(np.abs(det) > 1e-12, det, np.nan)
    return np.stack([d * rhs[..., 0] - b * rhs[..., 1], a * rhs[..., 1] - c * rhs[..., 0]], -1) / det[..., None]


def _is_before_fold(distortion: FloatArray, ray_xy: FloatArray) -> BoolArray:
    """Whether the radial part still grows at every radius up to this ray's: beyond, two rays share one pixel.

    d/dr (r + k1 r^3 + k2 r^5) = 1 + 3 k1 s + 5 k2 s^2 with s = r^2 must be positive on [0, s]; a quadratic is smallest
    at its ends or at its vertex.
    """
    k1, k2 = distortion[..., 0], distortion[..., 1]
    s = (ray_xy**2).sum(axis=-1)
    vertex = np.where(k2 > 0, np.clip(-0.3 * k1 / np.where(k2 > 0, k2, 1.0), 0.0, s), 0.0)
    return (1 + s * (3 * k1 + 5 * k2 * s) > 0) & (1 + vertex * (3 * k1 + 5 * k2 * vertex) > 0)
