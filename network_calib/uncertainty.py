"""How certain the result is: covariances in the world frame, under the gauge that the frame names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError

from network_calib.blocks import Problem, State
from network_calib.bundle import covariance
from network_calib.errors import DegenerateError
from network_calib.gauge import camera_gauge, inner_gauge
from network_calib.observations import FloatArray
from network_calib.refine import Refined, build_problem
from network_calib.robust_loss import SquaredLoss
from network_calib.room_setup import Anchor, CameraSetup, KnownCentres, KnownPoints
from network_calib.spots import SpotViews
from network_calib.world import scale_ends


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Covariances in the world frame.

    Attributes:
        cameras: (C, 14, 14) in the order of `result.PARAMETER_NAMES`; zero where a parameter was held.
        spots: (F', 3, 3) of the located spots.
    """

    cameras: FloatArray
    spots: FloatArray

    @property
    def focal_sigma_px(self) -> FloatArray:
        """(C,) standard deviation of each focal length."""
        return np.sqrt(np.diagonal(self.cameras, 0, 1, 2)[:, 6])

    @property
    def spot_sigma(self) -> FloatArray:
        """(F',) standard deviation of each spot along its worst direction."""
        return np.sqrt(np.linalg.eigvalsh(self.spots)[:, -1])


def uncertainty(refined: Refined, setups: Sequence[CameraSetup], views: SpotViews, anchor: Anchor) -> Uncertainty:
    """Covariances of a solution that is posed in the world frame.

    Raises:
        DegenerateError: some direction of the calibration is not determined.
    """
    problem, state = _posed_problem(refined, setups, views, anchor)
    try:
        joint = covariance(problem, state)
    except LinAlgError as error:
        raise DegenerateError(
            "the observations leave some direction of the calibration free",
            advice="Wave through the whole volume, in view of several cameras at once.",
        ) from error
    columns = problem.point_blocks[0].columns
    padded = np.pad(joint.shared, ((0, 1), (0, 1)))
    return Uncertainty(padded[columns[:, :, None], columns[:, None, :]], joint.points)


def _posed_problem(
    refined: Refined, setups: Sequence[CameraSetup], views: SpotViews, anchor: Anchor
) -> tuple[Problem, State]:
    """The final problem in the world frame.

    In the first camera's frame that camera has no uncertainty and the anchor's distance none; in a frame of given
    positions the covariance is that of inner constraints, the smallest in the mean.
    """
    rows = np.flatnonzero(refined.is_inlier)
    is_located = np.zeros(views.n_points, dtype=bool)
    is_located[views.point[rows]] = True
    problem, state = build_problem(
        setups, refined.cameras, views, refined.points, rows, is_located, refined.noise, SquaredLoss()
    )
    if isinstance(anchor, KnownCentres | KnownPoints):
        return replace(problem, gauge=inner_gauge), state
    end_a, end_b = scale_ends(refined.cameras, anchor)
    return replace(problem, gauge=lambda at: camera_gauge(at, 0, end_a, end_b)), state
