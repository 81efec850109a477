"""What every start method takes and gives: nominal rays in, metric cameras up to a similarity out.

A start works in *nominal rays*: pixels taken back through the intrinsics that are known (given ones, or a nominal
camera whose focal length is the longer image side and whose principal point is the image centre). So numbers are near
one, and what is unknown of a camera is one factor, its focal ratio: true focal length = ratio x nominal.
"""

from __future__ import annotations

from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform

from network_calib.observations import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class StartProblem:
    """K observations of F spots by C cameras, as nominal rays.

    Attributes:
        camera: (K,) camera index. Rows are sorted by point, then camera.
        point: (K,) spot index, 0..F-1, every spot seen by two cameras or more.
        ray_xy: (K, 2) x/z and y/z in the nominal camera.
        tolerance: (C,) how far, in ray units, an honest observation may lie off the model (a few pixels).
        is_focal_known: (C,) True where the nominal intrinsics are given ones, so the focal ratio is 1.
        names: C camera names, for messages.
    """

    camera: IntArray
    point: IntArray
    ray_xy: FloatArray
    tolerance: FloatArray
    is_focal_known: BoolArray
    names: tuple[str, ...]

    @property
    def n_cameras(self) -> int:
        return len(self.names)

    @property
    def n_points(self) -> int:
        return int(self.point[-1]) + 1 if len(self.point) else 0


@dataclass(frozen=True, slots=True)
class Start:
    """Cameras good enough for the joint engine to finish, in any frame and scale.

    Attributes:
        method: "factorisation" or "anchor"; stands in the result.
        cam_from_world: C poses.
        focal_ratio: (C,) true over nominal focal length.
        is_inlier: (K,) observations that agree with this start; rows in the order of the problem.
    """

    method: str
    cam_from_world: RigidTransform
    focal_ratio: FloatArray
    is_inlier: BoolArray
