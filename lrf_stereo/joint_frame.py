"""The world of a joint solve: images and ranges know its size, but not where it is nor how it is turned.

What names the frame of the cameras alone names it again after the joint solve, by a rigid motion: the scale is the
solve's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.blocks import Gauge, Problem, State
from network_calib.camera_block import cameras_of
from network_calib.cameras import Cameras
from network_calib.gauge import Similarity, fit_similarity, level_to_floor
from network_calib.observations import FloatArray, IntArray
from network_calib.room_setup import Anchor, KnownCentres, KnownPoints, Options
from network_calib.spots import SpotViews


@dataclass(frozen=True, slots=True)
class GivenPositions:
    """Where some cameras or spots are in the world.

    Attributes:
        cameras: (a,) camera indices.
        points: (b,) point indices; one of both is empty.
        in_world_m: (a + b, 3).
    """

    cameras: IntArray
    points: IntArray
    in_world_m: FloatArray

    def found(self, cameras: Cameras, points: FloatArray) -> FloatArray:
        """(a + b, 3) the same positions in a solution."""
        return np.concatenate([cameras.centres_in_world[self.cameras], points[self.points]])


@dataclass(frozen=True, slots=True)
class JointFrame:
    """What names the world frame.

    Attributes:
        given: positions that fix it; None where the first camera does, which stays as it was posed.
        floor: (n,) points on the floor, which level it; none for a frame that is not levelled.
    """

    given: GivenPositions | None = None
    floor: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @classmethod
    def of(cls, anchor: Anchor, options: Options, views: SpotViews, names: Sequence[str]) -> JointFrame:
        """The frame that anchor and options ask for; all frames that they name have been located.

        Args:
            anchor: of the cameras.
            options: may level the world.
            views: spots of the cameras.
            names: of the cameras.
        """
        none = np.empty(0, dtype=np.int64)
        given = None
        if isinstance(anchor, KnownCentres):
            index = np.array([names.index(name) for name in anchor.names], dtype=np.int64)
            given = GivenPositions(index, none, anchor.centres_in_world_m)
        if isinstance(anchor, KnownPoints):
            given = GivenPositions(none, np.searchsorted(views.frames, anchor.frames), anchor.points_in_world_m)
        return cls(given, np.searchsorted(views.frames, np.array(options.floor_frames, dtype=np.int64)))

    def world_from_solve(self, cameras: Cameras, points: FloatArray, cam_from_world: RigidTransform) -> RigidTransform:
        """The motion from the frame that a solve drifted into.

        Args:
            cameras: as solved.
            points: (F, 3) as solved.
            cam_from_world: pose of the first camera before the solve.
        """
        if self.given is None:
            motion = cam_from_world.inv() * cameras.cam_from_world[0]
        else:
            source, target = self.given.found(cameras, points), self.given.in_world_m
            turn = Rotation.from_matrix(fit_similarity(source, target).rotation)
            motion = RigidTransform.from_components(target.mean(axis=0) - turn.apply(source.mean(axis=0)), turn)
        if not len(self.floor):
            return motion
        posed = moved(cameras, motion)
        level = level_to_floor(motion.apply(points[self.floor]), posed)
        return RigidTransform.from_components(level.translation, Rotation.from_matrix(level.rotation)) * motion

    def named_gauge(self, problem: Problem) -> Problem:
        """The problem with the gauge of this frame: given positions prefer no camera, as without LRFs."""
        if self.given is None:
            return problem

        def inner(state: State) -> Gauge:
            null, n_cameras = problem.gauge_at(state).null, cameras_of(state.parts).size
            constraints = np.zeros((null.shape[1], len(null)))
            constraints[:, :n_cameras] = np.linalg.qr(null[:n_cameras])[0].T
            return Gauge(constraints, null)

        return Problem(problem.point_blocks, problem.shared_blocks, inner)

    def rms_m(self, cameras: Cameras, points: FloatArray) -> float:
        """How far the given positions are from those of a solution that is posed in the frame; 0 without any."""
        if self.given is None:
            return 0.0
        error = self.given.found(cameras, points) - self.given.in_world_m
        return float(np.sqrt((error**2).sum(axis=1).mean()))


def moved(cameras: Cameras, motion: RigidTransform) -> Cameras:
    """The cameras after a rigid motion of the world."""
    return Similarity(1.0, motion.rotation.as_matrix(), np.asarray(motion.translation)).apply_to_cameras(cameras)
