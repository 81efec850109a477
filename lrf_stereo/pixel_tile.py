"""A tile of cameras x points: pixels and their validity.

Arrays are (c, n), cameras by points, the points contiguous.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrf_stereo.lens_arrays import Lens
from network_calib.camera_parameters import N_POSE
from network_calib.cameras import Cameras
from network_calib.observations import BoolArray, FloatArray, IntArray

# As in `network_calib.cameras`: nearer points count as behind the camera.
MIN_DEPTH = 1e-12


@dataclass(frozen=True, slots=True)
class LensGroup:
    """c cameras of one kind of lens.

    Attributes:
        lens: the formulas.
        from_world: (3, c, 4) rows x, y, z of the poses cam_from_world.
        focal_x: (c, 1) px.
        focal_y: (c, 1) px.
        centre_x: (c, 1) px.
        centre_y: (c, 1) px.
        terms: (2 or 4, c, 1) distortion.
        end: (2, c, 1) last pixel position that is inside the image, x and y.
        fold_r2: (c, 1) squared radius of x/z, y/z from which on the lens folds back.
        minus_turn: (c, 3, 3) minus the rotations world_from_cam.
        active: which intrinsics are uncertain in any of the cameras, as places in PARAMETER_NAMES.
        covariance: (c, k, k) of centre, rotation and active intrinsics; where cameras and scanner err together, then
            also of the 15 scanner parameters, with zeros in the scanner's own part: that is in the points already.
    """

    lens: Lens
    from_world: FloatArray
    focal_x: FloatArray
    focal_y: FloatArray
    centre_x: FloatArray
    centre_y: FloatArray
    terms: FloatArray
    end: FloatArray
    fold_r2: FloatArray
    minus_turn: FloatArray
    active: tuple[int, ...]
    covariance: FloatArray | None

    @classmethod
    def of(
        cls,
        lens: Lens,
        cameras: Cameras,
        members: IntArray,
        covariance: FloatArray | None,
        camera_scanner: FloatArray | None,
    ) -> LensGroup:
        """The cameras `members`; covariances (C, 14, 14) and (C, 14, 15) are those of all cameras."""
        columns = cameras.intrinsics[members].T[:, :, None]
        active, matrix = _arranged(members, covariance, camera_scanner)
        poses = cameras.cam_from_world.as_matrix().reshape(-1, 4, 4)[members]
        return cls(
            lens=lens,
            from_world=np.ascontiguousarray(poses[:, :3].transpose(1, 0, 2)),
            focal_x=columns[0],
            focal_y=columns[1],
            centre_x=columns[2],
            centre_y=columns[3],
            terms=lens.needed(columns[4:]),
            end=cameras.size_px[members].T[:, :, None].astype(np.float64) - 0.5,
            fold_r2=lens.fold_r2(columns[4:])[:, None],
            minus_turn=np.ascontiguousarray(-poses[:, :3, :3].transpose(0, 2, 1)),
            active=active,
            covariance=matrix,
        )

    def take(self, rows: slice | IntArray) -> LensGroup:
        """Some of the cameras."""
        return replace(
            self,
            from_world=self.from_world[:, rows],
            focal_x=self.focal_x[rows],
            focal_y=self.focal_y[rows],
            centre_x=self.centre_x[rows],
            centre_y=self.centre_y[rows],
            terms=self.terms[:, rows],
            end=self.end[:, rows],
            fold_r2=self.fold_r2[rows],
            minus_turn=self.minus_turn[rows],
            covariance=None if self.covariance is None else self.covariance[rows],
        )

    @property
    def n_parameters(self) -> int:
        """Parameters by which the covariance needs derivatives: at least the centre, whose are also the points'."""
        return 3 if self.covariance is None else self.covariance.shape[1]


@dataclass(frozen=True, slots=True)
class Tile:
    """Pixels of n points in c cameras of one kind of lens.

    Attributes:
        group: the cameras.
        u: (c, n) x/z in the camera frame; NaN behind it.
        v: (c, n) y/z.
        r2: (c, n) u^2 + v^2.
        inverse_z: (c, n) 1/z; NaN behind.
        ud: (c, n) distorted u.
        vd: (c, n) distorted v.
        px: (2, c, n) pixels.
        depth: (c, n) z.
        is_valid: (c, n).
    """

    group: LensGroup
    u: FloatArray
    v: FloatArray
    r2: FloatArray
    inverse_z: FloatArray
    ud: FloatArray
    vd: FloatArray
    px: FloatArray
    depth: FloatArray
    is_valid: BoolArray

    @classmethod
    def of(cls, group: LensGroup, points_in_world: FloatArray) -> Tile:
        """Project points (3, n)."""
        n = points_in_world.shape[1]
        poses = group.from_world.reshape(-1, 4)
        u, v, z = (poses[:, :3] @ points_in_world + poses[:, 3:]).reshape(3, -1, n)
        is_front = z > MIN_DEPTH
        inverse_z = 1.0 / z
        if not is_front.all():
            inverse_z[~is_front] = np.nan
        u *= inverse_z
        v *= inverse_z
        r2 = u * u
        r2 += v * v
        ud, vd = group.lens.distorted(group.terms, u, v, r2)
        px = np.empty((2, *u.shape))
        np.multiply(group.focal_x, ud, out=px[0, :])
        px[0] += group.centre_x
        np.multiply(group.focal_y, vd, out=px[1, :])
        px[1] += group.centre_y
        # Comparisons with NaN are false: what is behind fails here.
        is_valid = r2 < group.fold_r2
        if group.lens.is_bent(group.terms):
            # Tangential terms fold an image a little before its radius does, to one side.
            xx, xy, yy = group.lens.slope(group.terms, u, v, r2)
            is_valid &= xx * yy > xy * xy
        for along, end in zip(px, group.end, strict=True):
            is_valid &= along >= -0.5
            is_valid &= along <= end
        return cls(group, u, v, r2, inverse_z, ud, vd, px, z, is_valid)


def _arranged(
    members: IntArray, covariance: FloatArray | None, camera_scanner: FloatArray | None
) -> tuple[tuple[int, ...], FloatArray | None]:
    """Intrinsics that are uncertain in any camera, and the matrix that `LensGroup.covariance` describes."""
    if covariance is None:
        return (), None
    own = covariance[members]
    intrinsics = N_POSE + np.flatnonzero(own[:, N_POSE:].any(axis=(0, 2)))
    order = np.concatenate([[3, 4, 5, 0, 1, 2], intrinsics])
    n_own = len(order)
    matrix = own[:, order[:, None], order]
    if camera_scanner is not None:
        cross = camera_scanner[members][:, order]
        n_all = n_own + cross.shape[2]
        matrix, own_matrix = np.zeros((len(members), n_all, n_all)), matrix
        matrix[:, :n_own, :n_own] = own_matrix
        matrix[:, :n_own, n_own:], matrix[:, n_own:, :n_own] = cross, cross.transpose(0, 2, 1)
    # Fancy indexing leaves an order of memory that BLAS cannot take.
    return tuple(int(k) for k in intrinsics), np.ascontiguousarray(matrix)
