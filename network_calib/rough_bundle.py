"""The joint engine on nominal rays without bend: poses and focal ratios of the cameras placed so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.blocks import Gauge, Parts, Problem, State
from network_calib.bundle import SolverOptions, solve
from network_calib.camera_block import PART, CameraBlock
from network_calib.camera_parameters import (
    CENTRE_X,
    CENTRE_Y,
    DISTORTION,
    FOCAL,
    N_PARAMETERS,
    N_POSE,
    CameraParameters,
)
from network_calib.cameras import poses_from_centres
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.robust_loss import CauchyLoss

# An honest observation lies within a tolerance, so a quarter of it is a fair standard deviation.
SIGMAS_PER_TOLERANCE = 4.0
# Before the data: log(ratio) around the expected one, principal points within 3 % of the longer image side, and what
# the bend of the pairs leaves of k1.
LENS_SIGMA = np.array([0.3, 0.03, 0.03, 0.05])
LENS = np.array([FOCAL, CENTRE_X, CENTRE_Y, DISTORTION])


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Residuals of the free lenses against what is expected: log(ratio), principal point, k1.

    Attributes:
        camera: (M,) camera index.
        columns: (4 M, 1) tangent columns of ratio, centre x, centre y and k1 of each.
        log_expected: (M,) of the ratio; the others are expected at 0.
    """

    camera: IntArray
    columns: IntArray
    log_expected: FloatArray

    def linearise(self, parts: Parts) -> tuple[FloatArray, FloatArray]:
        """Residuals (4 M,) and Jacobian (4 M, 1)."""
        cameras = parts[PART]
        assert isinstance(cameras, CameraParameters)
        lens = cameras.optics[self.camera][:, LENS - N_POSE]
        slope = np.ones_like(lens)
        ratio = np.maximum(lens[:, 0], 1e-6)
        slope[:, 0] = 1 / ratio
        lens[:, 0] = np.log(ratio) - self.log_expected
        return (lens / LENS_SIGMA).ravel(), (slope / LENS_SIGMA).reshape(-1, 1)


@dataclass(frozen=True, slots=True)
class RoughNetwork:
    """C cameras in nominal rays.

    Attributes:
        rotations: (C, 3, 3) cam_from_world.
        centres: (C, 3) in world.
        lens: (C, 4) focal ratio, principal point x, y (nominal ray units), k1 (on true rays).
    """

    rotations: FloatArray
    centres: FloatArray
    lens: FloatArray

    def of(self, cameras: list[int]) -> RoughNetwork:
        """The given cameras, in that order."""
        return RoughNetwork(self.rotations[cameras], self.centres[cameras], self.lens[cameras])

    def poses_for_central_lenses(self) -> RigidTransform:
        """Poses cam_from_world for lenses whose principal point is taken at the image centre.

        A camera that is turned by c / f shifts its image by c: so much of the principal point goes into the pose.
        """
        shift = self.lens[:, 1:3] / self.lens[:, :1]
        turn = Rotation.from_rotvec(np.column_stack([-shift[:, 1], shift[:, 0], np.zeros(len(shift))])).as_matrix()
        return poses_from_centres(turn @ self.rotations, self.centres)


def refine_network(
    network: RoughNetwork,
    points: FloatArray,
    *,
    camera: IntArray,
    point: IntArray,
    ray_xy: FloatArray,
    tolerance: FloatArray,
    is_lens_fixed: BoolArray,
    max_iterations: int,
) -> tuple[RoughNetwork, FloatArray]:
    """Refine cameras and spots together; the first camera and its distance to the second stay.

    Args:
        network: C cameras.
        points: (F, 3), each in front of the cameras that see it.
        camera: (K,) camera index.
        point: (K,) spot index; every spot has two rows or more.
        ray_xy: (K, 2) nominal rays without bend.
        tolerance: (K,) ray units.
        is_lens_fixed: (C,).
        max_iterations: of the engine.

    Returns:
        The cameras and the (F, 3) points.
    """
    n = len(network.lens)
    columns = np.full((n, N_PARAMETERS), -1, dtype=np.int64)
    columns[:, :N_POSE] = np.arange(N_POSE * n).reshape(n, N_POSE)
    free = np.flatnonzero(~is_lens_fixed)
    columns[free[:, None], LENS] = N_POSE * n + np.arange(len(LENS) * len(free)).reshape(-1, len(LENS))
    optics = np.zeros((n, 8))
    optics[:, LENS - N_POSE], optics[:, 1] = network.lens, 1.0
    parts = {PART: CameraParameters(network.rotations, network.centres, optics, np.zeros(n, dtype=bool), columns)}
    block = CameraBlock(
        group=camera,
        point=point,
        px=np.ascontiguousarray(ray_xy.T),
        inverse_sigma=SIGMAS_PER_TOLERANCE / tolerance,
        columns=columns,
        loss=CauchyLoss(SIGMAS_PER_TOLERANCE / 2),
    )
    prior = LensPrior(free, columns[free][:, LENS].reshape(-1, 1), np.log(network.lens[free, 0]))
    options = SolverOptions(max_iterations=max_iterations, cost_tolerance=1e-4)
    problem = Problem([block], [prior], gauge=lambda state: _first_camera(state, N_POSE * n + len(LENS) * len(free)))
    solution = solve(problem, State(parts, np.ascontiguousarray(points.T)), options)
    cameras = solution.state.parts[PART]
    assert isinstance(cameras, CameraParameters)
    refined = RoughNetwork(cameras.rotations, cameras.centres, cameras.optics[:, LENS - N_POSE])
    return refined, np.ascontiguousarray(solution.state.points.T)


def _first_camera(state: State, n_columns: int) -> Gauge:
    """The first camera's pose and its distance to the second; the directions matter to a covariance alone."""
    cameras = state.parts[PART]
    assert isinstance(cameras, CameraParameters)
    constraints = np.zeros((N_POSE + 1, n_columns))
    constraints[np.arange(N_POSE), np.arange(N_POSE)] = 1.0
    baseline = cameras.centres[1] - cameras.centres[0]
    constraints[N_POSE, N_POSE + 3 : N_POSE + 6] = baseline / np.linalg.norm(baseline)
    return Gauge(constraints, np.zeros((n_columns, N_POSE + 1)))
