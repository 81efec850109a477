"""The cameras as shared parameters of the joint engine: which numbers are free, and how a step moves them.

Tangent of one camera, in the order of `result.PARAMETER_NAMES`: rotation omega (R <- exp(omega) R), centre in the world
frame, then focal length, aspect, principal point and distortion. Rotation and centre are independent, so a centre's
covariance is read off directly and its Jacobian is minus the point's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.observations import BoolArray, FloatArray, IntArray

N_POSE, N_PARAMETERS = 6, 14
FOCAL, ASPECT, CENTRE_X, CENTRE_Y, DISTORTION = 6, 7, 8, 9, 10


@dataclass(frozen=True, slots=True)
class CameraParameters:
    """C cameras as a part of the shared parameters.

    Attributes:
        rotations: (C, 3, 3) cam_from_world.
        centres: (C, 3) in the world frame.
        optics: (C, 8) focal_px, aspect, centre_x_px, centre_y_px, d0..d3.
        is_fisheye: (C,).
        columns: (C, 14) tangent column of each parameter within this part, -1 where fixed; cameras that share
            intrinsics name the same columns.
    """

    rotations: FloatArray
    centres: FloatArray
    optics: FloatArray
    is_fisheye: BoolArray
    columns: IntArray

    @classmethod
    def from_cameras(cls, cameras: Cameras, columns: IntArray) -> CameraParameters:
        """Take poses and intrinsics from posed cameras; `columns` as built by `free_columns`."""
        focal = cameras.intrinsics[:, 0]
        optics = cameras.intrinsics.copy()
        optics[:, 1] = cameras.intrinsics[:, 1] / focal
        return cls(cameras.rotations, cameras.centres_in_world, optics, cameras.is_fisheye, columns)

    def apply_to(self, cameras: Cameras) -> Cameras:
        """The same cameras with these poses and intrinsics."""
        intrinsics = self.optics.copy()
        intrinsics[:, 1] = self.optics[:, 0] * self.optics[:, 1]
        return replace(cameras, intrinsics=intrinsics, cam_from_world=poses_from_centres(self.rotations, self.centres))

    @property
    def size(self) -> int:
        """Tangent dimension."""
        return int(self.columns.max(initial=-1)) + 1

    def retract(self, step: FloatArray) -> CameraParameters:
        """The cameras moved by a tangent step (size,)."""
        moves = np.append(step, 0.0)[self.columns]
        turn = Rotation.from_rotvec(moves[:, :3]).as_matrix()
        return replace(
            self,
            rotations=turn @ self.rotations,
            centres=self.centres + moves[:, 3:6],
            optics=self.optics + moves[:, 6:],
        )

    def step_to(self, other: CameraParameters) -> FloatArray:
        """The tangent step (size,) that leads to `other`; the inverse of `retract`."""
        turn = other.rotations @ self.rotations.transpose(0, 2, 1)
        moves = np.column_stack(
            [Rotation.from_matrix(turn).as_rotvec(), other.centres - self.centres, other.optics - self.optics]
        )
        step = np.zeros(self.size)
        is_free = self.columns >= 0
        step[self.columns[is_free]] = moves[is_free]
        return step


def free_columns(
    lenses: tuple[LensModel, ...],
    *,
    is_pose_fixed: BoolArray,
    is_intrinsics_fixed: BoolArray,
    groups: IntArray,
    is_aspect_free: bool = False,
) -> IntArray:
    """(C, 14) tangent columns: six of each free pose, then one set of intrinsics for each group.

    Args:
        lenses: C lens models; they say which distortion terms are free.
        is_pose_fixed: (C,) poses that stay (the gauge).
        is_intrinsics_fixed: (C,) intrinsics that stay.
        groups: (C,) cameras with equal numbers share their intrinsics.
        is_aspect_free: let focal_y / focal_x differ from one.
    """
    columns = np.full((len(lenses), N_PARAMETERS), -1, dtype=np.int64)
    n_columns = 0
    for c in np.flatnonzero(~is_pose_fixed):
        columns[c, :N_POSE] = n_columns + np.arange(N_POSE)
        n_columns += N_POSE
    first_of_group: dict[int, int] = {}
    for c in np.flatnonzero(~is_intrinsics_fixed):
        first = first_of_group.setdefault(int(groups[c]), int(c))
        if first != c:
            columns[c, N_POSE:] = columns[first, N_POSE:]
            continue
        free = [FOCAL, CENTRE_X, CENTRE_Y, *range(DISTORTION, DISTORTION + lenses[c].n_distortion)]
        free += [ASPECT] if is_aspect_free else []
        columns[c, free] = n_columns + np.arange(len(free))
        n_columns += len(free)
    return columns
