"""A bundle adjustment that two programs can solve from the same start, and its solution by the joint engine.

Square pixels, principal point and k1, k2 free, every residual in px with unit weight, no robust loss.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.measure import MemoryPeak
from benchmarks.rooms import random_generator
from network_calib.blocks import Problem, State
from network_calib.bundle import SolverOptions, solve
from network_calib.camera_block import PART, CameraBlock
from network_calib.camera_parameters import CameraParameters, free_columns
from network_calib.cameras import Cameras, poses_from_centres
from network_calib.gauge import inner_gauge
from network_calib.observations import FloatArray, Observations
from network_calib.synthetic import observe, room

# Both stop when a step lowers the cost by less than this part of it.
COST_TOLERANCE = 1e-8


@dataclass(frozen=True, slots=True)
class Scene:
    """Observations whose frame is the row of `points`, and a start some way off the optimum."""

    observations: Observations
    cameras: Cameras
    points: FloatArray


@dataclass(frozen=True, slots=True)
class Solved:
    """One solve: its time without setting up the problem for Ceres, its end and its steps."""

    seconds: float
    cost: float
    n_iterations: int


def ring(n_cameras: int, n_points: int, missing: float) -> Scene:
    """A ring of cameras that see every spot but the missing share; start off by 0.6 degrees, 2 cm, 10 px."""
    rng = random_generator(n_cameras, n_points)
    truth = room("ring_room", rng=rng, n_frames=n_points, n_cameras=n_cameras)
    seen = observe(truth, rng=rng, missing=missing).observations.in_frames_with_views(2)
    frames, number = np.unique(seen.frame, return_inverse=True)
    seen = Observations.from_columns(seen.camera_names, camera=seen.camera, frame=number, px=seen.px)
    turns = Rotation.from_rotvec(0.01 * rng.standard_normal((n_cameras, 3))).as_matrix()
    centres = truth.cameras.centres_in_world + 0.02 * rng.standard_normal((n_cameras, 3))
    intrinsics = truth.cameras.intrinsics.copy()
    intrinsics[:, :2] += 10 * rng.standard_normal((n_cameras, 1))
    cameras = Cameras(
        truth.cameras.names,
        truth.cameras.size_px,
        truth.cameras.lenses,
        intrinsics,
        poses_from_centres(turns @ truth.cameras.rotations, centres),
    )
    points = truth.trajectory[frames]
    return Scene(seen, cameras, points + 0.02 * rng.standard_normal(points.shape))


def solve_ours(scene: Scene) -> Solved:
    """By the joint engine."""
    seen, n_cameras = scene.observations, len(scene.cameras)
    is_free = np.zeros(n_cameras, dtype=bool)
    columns = free_columns(
        scene.cameras.lenses, is_pose_fixed=is_free, is_intrinsics_fixed=is_free, groups=np.arange(n_cameras)
    )
    px = np.ascontiguousarray(seen.px.T)
    block = CameraBlock(seen.camera, seen.frame, px, np.ones(len(seen)), columns)
    start = State({PART: CameraParameters.from_cameras(scene.cameras, columns)}, np.ascontiguousarray(scene.points.T))
    begin = time.perf_counter()
    solution = solve(Problem([block], gauge=inner_gauge), start, SolverOptions(cost_tolerance=COST_TOLERANCE))
    return Solved(time.perf_counter() - begin, solution.cost, solution.n_iterations)


def memory_of(
    solve_scene: Callable[[Scene], Solved], n_cameras: int, n_points: int, missing: float
) -> tuple[float, float]:
    """For a process of its own: MB that one solve adds, and the peak of the process during it."""
    # The first solve of a process loads what is imported late and pages in libraries; a tiny one takes that away.
    solve_scene(ring(3, 20, 0.0))
    scene = ring(n_cameras, n_points, missing)
    with MemoryPeak() as peak:
        solve_scene(scene)
    return peak.added_mb, peak.peak_mb
