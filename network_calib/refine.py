"""Joint maximum likelihood with outlier rounds: solve, judge every observation anew, until nothing changes.

Svoboda rejects by a threshold in pixels that shrinks; here an observation is judged by its residual in units of its
camera's own noise, which is estimated, and one that was rejected is admitted again when it fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from network_calib.blocks import Problem, State
from network_calib.bundle import Solution, SolverOptions, solve
from network_calib.camera_block import PART, CameraBlock, cameras_of
from network_calib.camera_parameters import CameraParameters, free_columns
from network_calib.cameras import Cameras
from network_calib.errors import ConvergenceError
from network_calib.gauge import inner_gauge
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.priors import lens_prior
from network_calib.robust_loss import CauchyLoss, Loss, SquaredLoss
from network_calib.room_setup import CameraSetup, Knowledge
from network_calib.spots import (
    SpotViews,
    drop_lonely,
    locate,
    located,
    normalised_error,
    reprojection_error,
    spot_leverage,
)

ROBUST_ROUNDS, EXACT_ROUNDS = 4, 10
SETTLED_SHARE, SETTLED_NOISE = 0.002, 0.03
# Rounds that are judged anew need no exact optimum; after the first, each starts close to its own.
ROUGH = SolverOptions(max_iterations=8, cost_tolerance=1e-3, initial_damping=1e-5)
MEDIUM = SolverOptions(max_iterations=2, cost_tolerance=1e-4, initial_damping=1e-6)
EXACT = SolverOptions(cost_tolerance=1e-9, initial_damping=1e-7)
# A Cauchy loss of 2.4 sigma keeps 95 % efficiency for Gaussian noise (Holland, Welsch 1977).
ROBUST_SCALE = 2.4
# Median of the norm of a 2D unit Gaussian.
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))
# Detectors do not do better than this, and a vanishing sigma would reject everything.
MIN_SIGMA_PX = 0.005


@dataclass(frozen=True, slots=True)
class Refined:
    """A joint optimum and the observations that it rests on.

    Attributes:
        cameras: in the solve's own frame.
        points: (F, 3); NaN for spots without two agreeing views.
        is_inlier: (K,).
        noise: (C,) factor on the detector's sigma: the noise in px where the detector gave none.
        problem: the last least-squares problem, over the located spots.
        state: its optimum.
        has_converged: of the last solve.
    """

    cameras: Cameras
    points: FloatArray
    is_inlier: BoolArray
    noise: FloatArray
    problem: Problem
    state: State
    has_converged: bool

    def noise_px(self, views: SpotViews) -> FloatArray:
        """(C,) noise of each camera's typical detection, px."""
        typical = [np.median(views.sigma_px[views.camera == c]) for c in range(len(self.cameras))]
        return self.noise * np.array(typical)


def refine(
    setups: Sequence[CameraSetup],
    cameras: Cameras,
    views: SpotViews,
    *,
    rejection: float,
    tolerance_px: float = 8.0,
) -> Refined:
    """Cameras, spots, noise and inliers of maximum likelihood, from a start.

    Args:
        setups: what is known of each camera.
        cameras: the start.
        views: K observations of F spots.
        rejection: sigma beyond which an observation is an outlier.
        tolerance_px: within which observations agree with the start.

    Raises:
        ConvergenceError: fewer than three observations per camera agree, or the solve fails.
    """
    cameras = _tied(setups, cameras)
    limit_px = np.full(len(views.camera), tolerance_px)
    points, is_inlier = locate(cameras, views, limit_px)
    noise = _robust_noise(cameras, views, points, is_inlier)
    for _ in range(ROBUST_ROUNDS):
        cameras, points, _, _ = _solve(
            setups, cameras, views, points, is_inlier, noise, CauchyLoss(ROBUST_SCALE), ROUGH
        )
        limit_px = np.minimum(limit_px, np.maximum(2 * rejection * noise[views.camera] * views.sigma_px, 0.5))
        agrees = np.linalg.norm(reprojection_error(cameras, views, points), axis=1) <= limit_px
        points, is_inlier = _relocated(cameras, views, points, is_inlier, agrees, limit_px)
        previous, noise = noise, _robust_noise(cameras, views, points, is_inlier)
        if np.abs(np.log(noise / previous)).max() < 0.1:
            break
    return _exact_rounds(setups, cameras, views, points, is_inlier, noise, rejection)


def _exact_rounds(
    setups: Sequence[CameraSetup],
    cameras: Cameras,
    views: SpotViews,
    points: FloatArray,
    is_inlier: BoolArray,
    noise: FloatArray,
    rejection: float,
) -> Refined:
    """Plain least squares over the inliers, re-judged until the mask and the noise stand still; then to the optimum."""
    points, is_inlier = _judged(cameras, views, points, is_inlier, noise, rejection)
    for _ in range(EXACT_ROUNDS):
        cameras, points, _, _ = _solve(setups, cameras, views, points, is_inlier, noise, SquaredLoss(), MEDIUM)
        previous_noise, noise = noise, estimate_noise(cameras, views, points, is_inlier, noise)
        previous_inlier = is_inlier
        points, is_inlier = _judged(cameras, views, points, is_inlier, noise, rejection)
        n_changed = int((previous_inlier != is_inlier).sum())
        if n_changed <= SETTLED_SHARE * len(is_inlier) and np.abs(np.log(noise / previous_noise)).max() < SETTLED_NOISE:
            break
    cameras, points, problem, solution = _solve(setups, cameras, views, points, is_inlier, noise, SquaredLoss(), EXACT)
    noise_now = estimate_noise(cameras, views, points, is_inlier, noise)
    return Refined(cameras, points, is_inlier, noise_now, problem, solution.state, solution.has_converged)


def _judged(
    cameras: Cameras, views: SpotViews, points: FloatArray, is_inlier: BoolArray, noise: FloatArray, rejection: float
) -> tuple[FloatArray, BoolArray]:
    """Spots and inliers by the normalised residual of every observation, in or out."""
    sigma_px = noise[views.camera] * views.sigma_px
    agrees = normalised_error(cameras, views, points, is_inlier, sigma_px) <= rejection
    return _relocated(cameras, views, points, is_inlier, agrees, rejection * sigma_px)


def _relocated(
    cameras: Cameras,
    views: SpotViews,
    points: FloatArray,
    is_inlier: BoolArray,
    agrees: BoolArray,
    limit_px: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Triangulate anew what a verdict unsettles: spots that lose a view, rest on a minority, or were not located.

    Args:
        cameras: as solved.
        views: K observations.
        points: (F, 3) as solved.
        is_inlier: (K,) what the points rest on.
        agrees: (K,) the verdict.
        limit_px: (K,) largest error of a view of the spots that are triangulated anew.
    """
    n_agreeing = np.bincount(views.point[agrees], minlength=views.n_points)
    # Two false views that met by chance under a poor start would else keep two honest ones out for good.
    is_doubtful = ~located(points) | (2 * n_agreeing <= np.bincount(views.point, minlength=views.n_points))
    is_doubtful[views.point[is_inlier & ~agrees]] = True
    if is_doubtful.any():
        rows = is_doubtful[views.point]
        points, agrees = points.copy(), agrees.copy()
        points[is_doubtful], agrees[rows] = locate(cameras, views.select_points(is_doubtful), limit_px[rows])
    return drop_lonely(views, points, agrees)


def fit(
    setups: Sequence[CameraSetup],
    cameras: Cameras,
    views: SpotViews,
    points: FloatArray,
    is_inlier: BoolArray,
    noise: FloatArray,
) -> Cameras:
    """One plain least-squares fit of given inliers from given cameras and points: for hold-out tests."""
    return _solve(setups, cameras, views, points, is_inlier, noise, SquaredLoss(), EXACT)[0]


def _solve(
    setups: Sequence[CameraSetup],
    cameras: Cameras,
    views: SpotViews,
    points: FloatArray,
    is_inlier: BoolArray,
    noise: FloatArray,
    loss: Loss,
    effort: SolverOptions,
) -> tuple[Cameras, FloatArray, Problem, Solution]:
    is_located = np.zeros(views.n_points, dtype=bool)
    is_located[views.point[is_inlier]] = True
    is_located &= located(points)
    rows = np.flatnonzero(is_inlier & is_located[views.point])
    if len(rows) < 3 * len(cameras):
        raise ConvergenceError(f"only {len(rows)} observations agree with the start: no calibration rests on so few")
    problem, state = build_problem(setups, cameras, views, points, rows, is_located, noise, loss)
    solution = solve(problem, state, effort)
    moved = np.full_like(points, np.nan)
    moved[is_located] = solution.state.points.T
    return cameras_of(solution.state.parts).apply_to(cameras), moved, problem, solution


def build_problem(
    setups: Sequence[CameraSetup],
    cameras: Cameras,
    views: SpotViews,
    points: FloatArray,
    rows: IntArray,
    is_located: BoolArray,
    noise: FloatArray,
    loss: Loss,
) -> tuple[Problem, State]:
    """The joint problem over the observations `rows` of the located spots, and its start."""
    columns = free_columns(
        tuple(setup.lens for setup in setups),
        is_pose_fixed=np.zeros(len(setups), dtype=bool),
        is_intrinsics_fixed=np.array([setup.knowledge is Knowledge.FIXED for setup in setups]),
        groups=intrinsics_groups(setups),
    )
    parameters = CameraParameters.from_cameras(cameras, columns)
    number = np.cumsum(is_located) - 1
    block = CameraBlock(
        group=views.camera[rows],
        point=number[views.point[rows]],
        px=np.ascontiguousarray(views.px[rows].T),
        inverse_sigma=1 / (noise[views.camera[rows]] * views.sigma_px[rows]),
        columns=columns,
        loss=loss,
    )
    state = State({PART: parameters}, np.ascontiguousarray(points[is_located].T))
    return Problem([block], [lens_prior(setups, parameters)], inner_gauge), state


def intrinsics_groups(setups: Sequence[CameraSetup]) -> IntArray:
    """(C,) equal numbers for cameras that share their intrinsics."""
    names = [setup.group if setup.group is not None else f"\0{c}" for c, setup in enumerate(setups)]
    return np.unique(names, return_inverse=True)[1].astype(np.int64)


def _tied(setups: Sequence[CameraSetup], cameras: Cameras) -> Cameras:
    """The cameras with one set of intrinsics, the median, for each group: a step moves a group but cannot unite it."""
    groups = intrinsics_groups(setups)
    is_free = np.array([setup.knowledge is not Knowledge.FIXED for setup in setups])
    intrinsics = cameras.intrinsics.copy()
    for group in np.unique(groups[is_free]):
        own = is_free & (groups == group)
        intrinsics[own] = np.median(intrinsics[own], axis=0)
    return replace(cameras, intrinsics=intrinsics)


def _robust_noise(cameras: Cameras, views: SpotViews, points: FloatArray, is_inlier: BoolArray) -> FloatArray:
    """(C,) noise factor from the median error of each camera; too small by the fit's share, which later rounds mend."""
    error = np.linalg.norm(reprojection_error(cameras, views, points), axis=1) / views.sigma_px
    noise = np.full(len(cameras), np.nan)
    for c in range(len(cameras)):
        own = error[is_inlier & (views.camera == c)]
        if len(own):
            noise[c] = np.median(own) / RAYLEIGH_MEDIAN
    typical = np.nanmedian(noise) if np.isfinite(noise).any() else 1.0
    return np.maximum(np.where(np.isfinite(noise), noise, typical), MIN_SIGMA_PX)


def estimate_noise(
    cameras: Cameras, views: SpotViews, points: FloatArray, is_inlier: BoolArray, noise: FloatArray
) -> FloatArray:
    """(C,) noise factor from the squared residuals over each camera's redundancy (variance components).

    Of 2 residuals each observation loses what its spot's three coordinates take: its leverage. The spots' leverages are
    exact for known cameras; what the cameras themselves take is shared out evenly, 14 of some hundred to thousand.
    """
    rows = np.flatnonzero(is_inlier & located(points)[views.point])
    camera = views.camera[rows]
    squares = np.bincount(camera, (_whitened(cameras, views, points)[rows] ** 2).sum(axis=1), minlength=len(cameras))
    leverage = np.trace(
        spot_leverage(cameras, views, points, is_inlier, noise[views.camera] * views.sigma_px), axis1=1, axis2=2
    )
    redundancy = np.bincount(camera, 2 - leverage[rows], minlength=len(cameras)) - 13
    typical = np.sqrt(squares.sum() / max(redundancy.sum(), 1.0))
    own = np.sqrt(squares / np.maximum(redundancy, 1.0))
    # Two cameras see the same residual: it cannot be told whose noise it is.
    is_told_apart = (redundancy > 20) & (len(cameras) > 2)
    return np.maximum(np.where(is_told_apart, own, typical), MIN_SIGMA_PX)


def _whitened(cameras: Cameras, views: SpotViews, points: FloatArray) -> FloatArray:
    return reprojection_error(cameras, views, points) / views.sigma_px[:, None]
