"""The mirrored twin: seen from far through long lenses, a world and its depth-reversed image look the same.

For parallel projection every scene has a twin, mirrored in depth and turned (Necker's cube); perspective tells them
apart. A start can fall on the wrong side, so the joint solve is tried from the twin of its result as well. Where
perspective is strong the twin may have no optimum of its own: that solve then climbs back to where it came from, and
its small cost says nothing. Depth tells: a twin shows the far spots near.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import rankdata

from network_calib.blocks import State
from network_calib.bundle import SolverOptions, solve
from network_calib.camera_block import PART, cameras_of
from network_calib.camera_parameters import CameraParameters
from network_calib.cameras import Cameras
from network_calib.errors import ConvergenceError
from network_calib.observations import FloatArray
from network_calib.refine import Refined, build_problem
from network_calib.robust_loss import CauchyLoss
from network_calib.room_setup import CameraSetup
from network_calib.spots import SpotViews

MAX_SPOTS = 600
_MIRROR = np.diag([1.0, 1.0, -1.0])


def twin_cost_ratio(setups: Sequence[CameraSetup], refined: Refined, views: SpotViews) -> tuple[float, Cameras]:
    """Cost of the twin's optimum over that of the solution, on at most 600 spots, and the twin's cameras.

    A ratio far above one says that perspective rules the twin out; infinite where the twin puts spots behind cameras,
    or its solve ends in a world that is not mirrored.
    """
    is_located = np.isfinite(refined.points).all(axis=1)
    index = np.flatnonzero(is_located)
    chosen = index[np.linspace(0, len(index) - 1, min(MAX_SPOTS, len(index))).astype(np.int64)]
    is_chosen = np.zeros(views.n_points, dtype=bool)
    is_chosen[chosen] = True
    rows = np.flatnonzero(refined.is_inlier & is_chosen[views.point])
    noise = refined.noise
    problem, state = build_problem(
        setups, refined.cameras, views, refined.points, rows, is_chosen, noise, CauchyLoss(3.0)
    )
    options = SolverOptions(max_iterations=25, cost_tolerance=1e-4)
    own = solve(problem, state, options)
    parameters = cameras_of(state.parts)
    try:
        twin = solve(problem, _twin_state(parameters, state.points.T), options)
    except ConvergenceError:
        return float("inf"), refined.cameras
    if not _is_mirrored(own.state, twin.state):
        return float("inf"), refined.cameras
    return twin.cost / max(own.cost, 1e-300), cameras_of(twin.state.parts).apply_to(refined.cameras)


def _is_mirrored(own: State, twin: State) -> bool:
    """Whether what is far in one world is near in the other, on the whole.

    Ranks, because a few spots may be stuck anywhere; their correlation is -1 for the twin of parallel projection and +1
    for the same world in any frame and scale.
    """
    own_rank, twin_rank = rankdata(_depths(own), axis=1), rankdata(_depths(twin), axis=1)
    middle = (own.points.shape[1] + 1) / 2
    return float(((own_rank - middle) * (twin_rank - middle)).sum()) < 0


def _depths(state: State) -> FloatArray:
    """(C, F) depth of every spot in every camera."""
    parameters = cameras_of(state.parts)
    forward = parameters.rotations[:, 2]
    return forward @ state.points - (forward * parameters.centres).sum(axis=1)[:, None]


def _twin_state(parameters: CameraParameters, points: FloatArray) -> State:
    """World mirrored at z = 0; each camera mirrored with it and then turned round the scene's mean depth."""
    mean = points.mean(axis=0)
    rotations = _MIRROR @ parameters.rotations @ _MIRROR
    mean_in_cam = np.einsum("cij,cj->ci", parameters.rotations, mean - parameters.centres)
    # x_in_cam = R' (X' - C'): the mean spot keeps its place in every camera.
    centres = _MIRROR @ mean - np.einsum("cji,cj->ci", rotations, mean_in_cam)
    moved = CameraParameters(rotations, centres, parameters.optics, parameters.is_fisheye, parameters.columns)
    return State({PART: moved}, np.ascontiguousarray((points @ _MIRROR).T))
