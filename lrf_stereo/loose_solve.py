"""The joint problem solved once more with something let go: what the spots alone say of numbers that are trusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError

from lrf_stereo.held_cameras import CameraSpread, Sensitivity
from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.joint_problem import build_joint_problem
from lrf_stereo.refine import LrfRefined
from network_calib.blocks import State
from network_calib.bundle import SolverOptions, covariance, solve
from network_calib.observations import FloatArray
from network_calib.robust_loss import SquaredLoss
from network_calib.spots import located

# From the optimum with held numbers it is a step or two.
EFFORT = SolverOptions(max_iterations=4, cost_tolerance=1e-6, initial_damping=1e-6)


def solve_loosely(
    refined: LrfRefined, network: NetworkData, loose: LrfData, held: CameraSpread | None
) -> tuple[State, FloatArray] | None:
    """Solve from the optimum on, with the same inliers.

    Args:
        refined: the optimum.
        network: the camera side.
        loose: the LRF side, in which what is in question has a wide prior.
        held: what held cameras may be wrong by; None where they are exact, or solved along.

    Returns:
        The state and the covariance of its shared parameters; None where the spots do not determine them.
    """
    at_optimum = replace(network, cameras=refined.cameras, points=refined.points)
    is_used = located(refined.points)
    if network.is_held:
        with_lrf = np.zeros(len(is_used), dtype=bool)
        with_lrf[loose.point[refined.is_inlier]] = True
        is_used &= with_lrf
    problem, state = build_joint_problem(at_optimum, refined.scanners, loose, refined.is_inlier, is_used, SquaredLoss())
    state = solve(problem, state, EFFORT).state
    try:
        spread = covariance(problem, state).shared
    except LinAlgError:
        return None
    if held is not None:
        spread = spread + Sensitivity.at(refined, network, loose).covariance(held, spread)
    return state, spread
