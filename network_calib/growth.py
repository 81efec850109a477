"""A camera network under construction: place spots, add one camera, refine everything."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.resection import MIN_SPOTS, resect
from network_calib.rough_bundle import RoughNetwork, refine_network
from network_calib.triangulate import largest_parallax_rad, residuals, triangulate

MIN_PARALLAX_RAD = np.radians(0.5)
MIN_RESECTION_SHARE = 0.5
N_UNDISTORT_STEPS = 4


@dataclass(slots=True)
class Growth:
    """C cameras, of which those in `order` are placed, and F spots, on chosen rows of a start problem.

    Attributes:
        camera: (K,) camera index; rows are sorted by point.
        point: (K,) spot index.
        ray_xy: (K, 2) nominal rays without bend.
        tolerance: (K,) nominal ray units.
        is_lens_fixed: (C,) cameras whose lens is known.
        network: all cameras; what it says of those not placed is only their expected focal ratio.
        order: placed cameras, in the order in which they were placed.
        points: (F, 3) spots, NaN where not placed.
        is_valid: (F,) whether a spot is placed.
        slack: factor on all tolerances.
    """

    camera: IntArray
    point: IntArray
    ray_xy: FloatArray
    tolerance: FloatArray
    is_lens_fixed: BoolArray
    network: RoughNetwork
    order: list[int]
    points: FloatArray
    is_valid: BoolArray
    slack: float = 1.0

    @property
    def is_placed(self) -> BoolArray:
        placed = np.zeros(len(self.is_lens_fixed), dtype=bool)
        placed[self.order] = True
        return placed

    @property
    def n_seen(self) -> IntArray:
        """(C,) how many placed spots each camera sees that is not placed itself; 0 for those that are."""
        seen = np.bincount(self.camera[self.is_valid[self.point]], minlength=len(self.is_lens_fixed))
        return np.where(self.is_placed, 0, seen)

    def agreeing(self) -> BoolArray:
        """(K,) rows of placed cameras within tolerance of their placed spot."""
        ray, scale = self._true_rays(np.arange(len(self.camera)))
        network = self.network
        distance = residuals(self.camera, self.point, ray, network.rotations, network.centres, self.points)
        return self.is_placed[self.camera] & self.is_valid[self.point] & (distance <= scale)

    def distances(self, weights: FloatArray) -> FloatArray:
        """(K,) distance of every row from its spot, triangulated from rows so weighted (K,), in tolerances."""
        ray, scale = self._true_rays(np.arange(len(self.camera)))
        rotations, centres, n = self.network.rotations, self.network.centres, int(self.point[-1]) + 1
        points, _ = triangulate(self.camera, self.point, ray, rotations, centres, n, weights=weights, scale=scale)
        return residuals(self.camera, self.point, ray, rotations, centres, points) / scale

    def place_spots(self, is_touched: BoolArray | None = None) -> None:
        """Triangulate the touched (F,) spots, or all, anew from all placed cameras."""
        rows = self.is_placed[self.camera]
        rows = np.flatnonzero(rows if is_touched is None else rows & is_touched[self.point])
        chosen, local = np.unique(self.point[rows], return_inverse=True)
        camera, n, network = self.camera[rows], len(chosen), self.network
        ray, scale = self._true_rays(rows)
        weights = (scale.min(initial=1.0) / scale) ** 2
        points, is_valid = triangulate(
            camera, local, ray, network.rotations, network.centres, n, weights=weights, scale=scale
        )
        distance = residuals(camera, local, ray, network.rotations, network.centres, points)
        is_valid &= np.bincount(local[distance <= scale], minlength=n) >= 2
        is_valid &= largest_parallax_rad(camera, local, ray, network.rotations, n) >= MIN_PARALLAX_RAD
        self.points[chosen], self.is_valid[chosen] = points, is_valid

    def add_next(self) -> bool:
        """Add the camera that sees most of the placed spots, or the next that fits; False where none does."""
        n_seen = self.n_seen
        candidates = [int(c) for c in np.argsort(-n_seen, kind="stable") if n_seen[c] >= MIN_SPOTS]
        return any(self._add(camera) for camera in candidates)

    def refine(self, max_iterations: int) -> None:
        """The joint engine on all placed cameras, then all spots anew."""
        rows = np.flatnonzero(self.agreeing())
        rows = rows[np.bincount(self.point[rows], minlength=len(self.points))[self.point[rows]] >= 2]
        chosen, local = np.unique(self.point[rows], return_inverse=True)
        position = np.full(len(self.is_lens_fixed), -1, dtype=np.int64)
        position[self.order] = np.arange(len(self.order))
        refined, _ = refine_network(
            self.network.of(self.order),
            self.points[chosen],
            camera=position[self.camera[rows]],
            point=local,
            ray_xy=self.ray_xy[rows],
            tolerance=self.slack * self.tolerance[rows],
            is_lens_fixed=self.is_lens_fixed[self.order],
            max_iterations=max_iterations,
        )
        self.network.rotations[self.order] = refined.rotations
        self.network.centres[self.order] = refined.centres
        self.network.lens[self.order] = refined.lens
        self.place_spots()

    def _add(self, camera: int) -> bool:
        rows = np.flatnonzero((self.camera == camera) & self.is_valid[self.point])
        found = resect(
            self.ray_xy[rows],
            self.points[self.point[rows]],
            self.slack * self.tolerance[rows],
            ratio=float(self.network.lens[camera, 0]),
            is_ratio_fixed=bool(self.is_lens_fixed[camera]),
        )
        if found is None or found.is_inlier.mean() < MIN_RESECTION_SHARE:
            return False
        self.network.rotations[camera], self.network.centres[camera] = found.rotation, found.centre
        self.network.lens[camera] = [found.ratio, 0.0, 0.0, 0.0]
        self.order.append(camera)
        is_touched = np.zeros(len(self.points), dtype=bool)
        is_touched[self.point[self.camera == camera]] = True
        self.place_spots(is_touched)
        return True

    def _true_rays(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Undistorted rays (n, 2) of some rows by the lenses as they stand, and their tolerances (n,)."""
        lens = self.network.lens[self.camera[rows]]
        distorted = (self.ray_xy[rows] - lens[:, 1:3]) / lens[:, :1]
        ray = distorted
        if lens[:, 3].any():
            for _ in range(N_UNDISTORT_STEPS):
                factor = 1 + lens[:, 3] * (ray**2).sum(axis=1)
                ray = distorted / np.clip(factor, 0.5, 2.0)[:, None]
        return ray, self.slack * self.tolerance[rows] / lens[:, 0]
