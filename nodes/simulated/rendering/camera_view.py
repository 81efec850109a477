"""One posed camera as a renderer needs it: rays of pixels, pixels of points, and which points it can see at all."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from network_calib.cameras import Cameras, cam_from_img, img_from_cam

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]
GRID_PX = 4
NEAREST_Z = 1e-3


@dataclass(frozen=True, slots=True)
class CameraView:
    """One camera.

    Attributes:
        size_px: width, height.
        intrinsics: (8,), see `network_calib.cameras`.
        is_fisheye: which of the two distortion models.
        rotation: (3, 3) cam_from_world.
        centre_in_world: (3,) m.
        max_ray: largest |(x/z, y/z)| of a pixel of the image: farther off the axis nothing is seen, and a polynomial
            lens may fold back into the image.
    """

    size_px: tuple[int, int]
    intrinsics: FloatArray
    is_fisheye: bool
    rotation: FloatArray
    centre_in_world: FloatArray
    max_ray: float

    @classmethod
    def of(cls, cameras: Cameras, index: int) -> CameraView:
        """The camera with this index."""
        width, height = (int(side) for side in cameras.size_px[index])
        row, is_fisheye = cameras.intrinsics[index], cameras.lenses[index].is_fisheye
        x, y = np.linspace(-0.5, width - 0.5, 65), np.linspace(-0.5, height - 0.5, 65)
        grid_px = np.stack(np.meshgrid(x, y), axis=-1)
        ray_xy, _ = cam_from_img(row, np.asarray(is_fisheye), grid_px)
        max_ray = float(np.nanmax(np.linalg.norm(ray_xy, axis=-1)))
        centre, rotation = cameras.centres_in_world[index], cameras.rotations[index]
        return cls((width, height), row, is_fisheye, rotation, centre, max_ray)

    @property
    def focal_px(self) -> float:
        """Mean of both focal lengths: pixels a radian in the middle of the image."""
        return float(self.intrinsics[:2].mean())

    def project(self, points_in_world: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (..., 2) of points (..., 3), and whether each can be in the image; others are NaN."""
        in_cam = (points_in_world - self.centre_in_world) @ self.rotation.T
        z = np.maximum(in_cam[..., 2], NEAREST_Z)
        is_seen = (in_cam[..., 2] > NEAREST_Z) & (np.hypot(in_cam[..., 0], in_cam[..., 1]) <= self.max_ray * z)
        px, _ = img_from_cam(self.intrinsics, np.asarray(self.is_fisheye), in_cam)
        return np.where(is_seen[..., None], px, np.nan), is_seen

    def project_clamped(self, points_in_world: FloatArray) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) for outlines: what lies too far off the axis is drawn in to the rim."""
        in_cam = (points_in_world - self.centre_in_world) @ self.rotation.T
        z = np.maximum(in_cam[..., 2:], NEAREST_Z)
        ray = in_cam[..., :2] / z
        ray = ray * np.minimum(1.0, self.max_ray / np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-9))
        ones = np.ones((*ray.shape[:-1], 1))
        return img_from_cam(self.intrinsics, np.asarray(self.is_fisheye), np.concatenate([ray, ones], axis=-1))[0]

    def is_in_image(self, px: FloatArray) -> bool:
        """Whether one pixel (2,) lies in the image; NaN does not."""
        width, height = self.size_px
        return bool(-0.5 <= px[0] <= width - 0.5 and -0.5 <= px[1] <= height - 0.5)

    def rays_in_world(self) -> Float32Array:
        """(h, w, 3) unit directions of all pixels; zero where the lens has no ray. Linear between every fourth."""
        width, height = self.size_px
        x = np.arange(0, width + GRID_PX, GRID_PX, dtype=np.float64)
        y = np.arange(0, height + GRID_PX, GRID_PX, dtype=np.float64)
        ray_xy, is_valid = cam_from_img(self.intrinsics, np.asarray(self.is_fisheye), np.stack(np.meshgrid(x, y), -1))
        in_cam = np.concatenate([ray_xy, np.ones((*ray_xy.shape[:2], 1))], axis=-1)
        in_cam = in_cam / np.linalg.norm(in_cam, axis=-1, keepdims=True)
        grid = np.where(is_valid[..., None], in_cam @ self.rotation, 0.0).astype(np.float32)
        across, down = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        rays = cv2.remap(grid, across / GRID_PX, down / GRID_PX, cv2.INTER_LINEAR)
        length = np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.where(length > 0.5, rays / np.maximum(length, 1e-6), np.float32(0.0))
