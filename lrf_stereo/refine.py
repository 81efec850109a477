"""The joint maximum-likelihood solve of cameras, LRFs and tilt angles over shared latent spots.

Each spot is one latent point seen by any number of cameras and LRFs; nothing is triangulated and registered in two
steps, so the stereo pair's poor depth weighs as little as it should.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.joint_frame import JointFrame
from lrf_stereo.joint_problem import build_joint_problem, shifted
from lrf_stereo.lrf_block import N_COLUMNS, SCANNERS, TILTS
from lrf_stereo.lrf_priors import Instruments
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.scanner_part import N_SCANNER, ScannerPart, TiltPart
from lrf_stereo.sighting_block import sighting_block
from network_calib.blocks import Problem, State
from network_calib.bundle import Solution, SolverOptions, covariance, solve
from network_calib.camera_block import PART, cameras_of
from network_calib.camera_parameters import CameraParameters
from network_calib.cameras import Cameras
from network_calib.errors import DegenerateError
from network_calib.gauge import Similarity
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.robust_loss import CauchyLoss, Loss, SquaredLoss
from network_calib.spots import located, spots_from_cameras

N_ROUNDS = 6
ROBUST = SolverOptions(cost_tolerance=1e-4)
EXACT = SolverOptions(cost_tolerance=1e-10, initial_damping=1e-6)


@dataclass(frozen=True, slots=True)
class LrfRefined:
    """A joint optimum.

    Attributes:
        cameras: as solved, or as held.
        points: (F, 3).
        scanners: S scanners.
        tilt_rad: (T,) solved angles; each scanner's reference setting as measured.
        is_inlier: (M,) LRF sightings that were used.
        problem: the last problem.
        state: its optimum.
        chi2: weighted sum of squares of the LRF sightings and priors' share included, see `dof`.
        dof: degrees of freedom of the whole problem.
        has_converged: of the last solve.
    """

    cameras: Cameras
    points: FloatArray
    scanners: tuple[TiltingScanner, ...]
    tilt_rad: FloatArray
    is_inlier: BoolArray
    problem: Problem
    state: State
    chi2: float
    dof: int
    has_converged: bool


def refine_jointly(
    network: NetworkData,
    scanners: tuple[TiltingScanner, ...],
    spots: LrfSpots,
    settings: TiltSettings,
    *,
    instrument: Instruments | None = None,
    rejection: float = 4.0,
    frame: JointFrame | None = None,
) -> LrfRefined:
    """Cameras, scanners and tilt angles of maximum likelihood.

    Args:
        network: the camera side; the world is the cameras'.
        scanners: the start; poses hold at each scanner's first setting.
        spots: LRF sightings; those whose frame the cameras did not locate are left out.
        settings: measured tilt angles. A covariance of zero trusts them as they are.
        instrument: what the scanners may be wrong by, one for all or one for each; by default nothing.
        rejection: sigma (of one dimension) whose probability a sighting's surprise must not pass.
        frame: names the world of cameras that are not held; by default the first camera stays where it is.

    Raises:
        DegenerateError: no sighting of a setting is left.
    """
    data = LrfData.of(spots, settings, network.views, instrument)
    usable = (data.point >= 0) & located(network.points)[np.maximum(data.point, 0)]
    is_inlier = usable.copy()
    cam_from_world = network.cameras.cam_from_world[0]
    limit = float(chi2.isf(chi2.sf(rejection**2, 1), 3))
    loss: Loss = CauchyLoss(2.4)
    for _ in range(N_ROUNDS):
        solved = _solve(network, scanners, data, is_inlier, loss, ROBUST)
        network, scanners = solved.network, solved.scanners
        judged = usable & (_surprise(network, scanners, data, solved.tilt_rad) <= limit)
        _refuse_empty(data, judged)
        if isinstance(loss, SquaredLoss) and (judged == is_inlier).all():
            break
        is_inlier, loss = judged, SquaredLoss()
    solved = _solve(network, scanners, data, is_inlier, SquaredLoss(), EXACT)
    if not network.is_held:
        solved = _posed(solved, frame or JointFrame(), cam_from_world)
    return LrfRefined(
        cameras=solved.network.cameras,
        points=solved.network.points,
        scanners=solved.scanners,
        tilt_rad=solved.tilt_rad,
        is_inlier=is_inlier,
        problem=solved.problem,
        state=solved.solution.state,
        chi2=2 * solved.solution.cost,
        dof=_degrees_of_freedom(solved, is_held=network.is_held),
        has_converged=solved.solution.has_converged,
    )


@dataclass(frozen=True, slots=True)
class LrfCovariance:
    """Covariances under the gauge of the world frame (nothing is free when the cameras are held).

    Attributes:
        cameras: (C, 14, 14), zero when held.
        scanners: (S, 15, 15) in the order of SCANNER_TANGENT.
        tilts: (T, T) rad^2; zero for reference settings.
        camera_scanner: (S, C, 14, 15) of each camera's parameters with each scanner's.
        points: (F', 3, 3) of the spots that were used.
        joint: (n, n) of the whole shared tangent vector: cameras, scanners, tilts.
    """

    cameras: FloatArray
    scanners: FloatArray
    tilts: FloatArray
    camera_scanner: FloatArray
    points: FloatArray
    joint: FloatArray


def lrf_covariance(refined: LrfRefined) -> LrfCovariance:
    """Covariances at a joint optimum; of the scanners and tilts given the cameras when these were held.

    Raises:
        DegenerateError: some direction is not determined.
    """
    try:
        whole = covariance(refined.problem, refined.state)
    except LinAlgError as error:
        raise DegenerateError(
            "the LRF sightings leave some direction of the scanner free",
            advice="Take more tilts, further apart, and spots near and far, left and right.",
        ) from error
    padded = np.pad(whole.shared, ((0, 1), (0, 1)))
    columns = _Columns.of(refined.state)
    return LrfCovariance(
        cameras=_cut(padded, columns.cameras),
        scanners=_cut(padded, columns.scanners),
        tilts=_cut(padded, columns.tilts[None])[0],
        camera_scanner=padded[columns.cameras[None, :, :, None], columns.scanners[:, None, None, :]],
        points=whole.points,
        joint=whole.shared,
    )


def with_shared_covariance(
    spread: LrfCovariance, refined: LrfRefined, joint: FloatArray, with_cameras: FloatArray
) -> LrfCovariance:
    """Covariances of a solve with held cameras for another one (n, n) of the shared tangent vector.

    Args:
        spread: of the same solve.
        refined: the solve.
        joint: scanners and tilts.
        with_cameras: (C, 14, n) of the held cameras' parameters with them.
    """
    columns = _Columns.of(refined.state)
    padded = np.pad(joint, ((0, 1), (0, 1)))
    cross = np.pad(with_cameras, ((0, 0), (0, 0), (0, 1)))
    return replace(
        spread,
        scanners=_cut(padded, columns.scanners),
        tilts=_cut(padded, columns.tilts[None])[0],
        camera_scanner=cross[:, :, columns.scanners].transpose(2, 0, 1, 3),
        joint=joint,
    )


def scale_sigma(refined: LrfRefined, spread: LrfCovariance) -> float:
    """Relative standard deviation of the metric scale: of the cameras' RMS distance from their middle."""
    columns = _Columns.of(refined.state).cameras[:, 3:6]
    centres = refined.cameras.centres_in_world
    away = centres - centres.mean(axis=0)
    slope = np.zeros(len(spread.joint))
    slope[columns] = away / (away**2).sum()
    return float(np.sqrt(slope @ spread.joint @ slope))


@dataclass(frozen=True, slots=True)
class _Columns:
    """Columns of the shared tangent vector: (C, 14), (S, 15), (T,); -1 where held."""

    cameras: IntArray
    scanners: IntArray
    tilts: IntArray

    @classmethod
    def of(cls, state: State) -> _Columns:
        cameras, scanners, tilts = (state.parts[name] for name in (PART, SCANNERS, TILTS))
        assert isinstance(cameras, CameraParameters)
        assert isinstance(scanners, ScannerPart)
        assert isinstance(tilts, TiltPart)
        first_scanner, first_tilt = cameras.size, cameras.size + scanners.size
        return cls(cameras.columns, shifted(scanners.columns, first_scanner), shifted(tilts.columns, first_tilt))


def _cut(padded: FloatArray, columns: IntArray) -> FloatArray:
    return padded[columns[:, :, None], columns[:, None, :]]


@dataclass(frozen=True, slots=True)
class _Solved:
    network: NetworkData
    scanners: tuple[TiltingScanner, ...]
    tilt_rad: FloatArray
    problem: Problem
    solution: Solution


def _solve(
    network: NetworkData,
    scanners: tuple[TiltingScanner, ...],
    data: LrfData,
    is_inlier: BoolArray,
    loss: Loss,
    effort: SolverOptions,
) -> _Solved:
    is_used = located(network.points)
    if network.is_held:
        # Spots that no LRF saw say nothing once the cameras stay.
        with_lrf = np.zeros(network.views.n_points, dtype=bool)
        with_lrf[data.point[is_inlier]] = True
        is_used &= with_lrf
    problem, state = build_joint_problem(network, scanners, data, is_inlier, is_used, loss)
    solution = solve(problem, state, effort)
    points = network.points.copy()
    points[is_used] = solution.state.points.T
    part, tilts = solution.state.parts[SCANNERS], solution.state.parts[TILTS]
    assert isinstance(part, ScannerPart)
    assert isinstance(tilts, TiltPart)
    cameras = cameras_of(solution.state.parts).apply_to(network.cameras)
    moved = replace(network, cameras=cameras, points=points)
    return _Solved(moved, part.apply_to(scanners), tilts.angle_rad, problem, solution)


def _posed(solved: _Solved, frame: JointFrame, cam_from_world: RigidTransform) -> _Solved:
    """The same solution in its frame: the solve lets the whole world drift."""
    drifted, state = solved.network, solved.solution.state
    world_from_drifted = frame.world_from_solve(drifted.cameras, drifted.points, cam_from_world)
    motion = Similarity(1.0, world_from_drifted.rotation.as_matrix(), np.asarray(world_from_drifted.translation))
    cameras = motion.apply_to_cameras(drifted.cameras)
    scanners = tuple(scanner.moved_by(world_from_drifted) for scanner in solved.scanners)
    part = state.parts[SCANNERS]
    assert isinstance(part, ScannerPart)
    parts = {
        PART: CameraParameters.from_cameras(cameras, cameras_of(state.parts).columns),
        SCANNERS: ScannerPart.from_scanners(scanners, part.columns),
        TILTS: state.parts[TILTS],
    }
    state = State(parts, np.ascontiguousarray(motion.apply(state.points.T).T))
    network = replace(drifted, cameras=cameras, points=motion.apply(drifted.points))
    return replace(
        solved,
        network=network,
        scanners=scanners,
        problem=frame.named_gauge(solved.problem),
        solution=replace(solved.solution, state=state),
    )


def _degrees_of_freedom(solved: _Solved, *, is_held: bool) -> int:
    camera_block, lrf_block = solved.problem.point_blocks
    n_residuals = 2 * len(camera_block.point) + 3 * len(lrf_block.point)
    n_residuals += sum(len(block.columns) for block in solved.problem.shared_blocks)
    state = solved.solution.state
    return n_residuals - 3 * state.points.shape[1] - state.n_shared + (0 if is_held else 6)


def _surprise(
    network: NetworkData, scanners: tuple[TiltingScanner, ...], data: LrfData, tilt_rad: FloatArray
) -> FloatArray:
    """(M,) squared Mahalanobis distance of each sighting from what the cameras alone say of its spot.

    The LRF's own pull on the spot is left out, so that a wrong sighting cannot vouch for itself.
    """
    sigma_px = network.noise[network.views.camera] * network.views.sigma_px
    from_cameras, spread = spots_from_cameras(
        network.cameras, network.views, network.points, network.is_inlier, sigma_px
    )
    rows = np.flatnonzero((data.point >= 0) & located(from_cameras)[np.maximum(data.point, 0)])
    point = data.point[rows]
    parts = {
        SCANNERS: ScannerPart.from_scanners(scanners, np.full((len(scanners), N_SCANNER), -1)),
        TILTS: TiltPart(tilt_rad, np.full(len(tilt_rad), -1)),
    }
    block = sighting_block(
        network, scanners, data, rows,
        tilt_rad=tilt_rad, point=point, columns=np.full((len(tilt_rad), N_COLUMNS), -1), loss=SquaredLoss(),
    )  # fmt: skip
    residual, _, by_point = block.linearise(parts, np.ascontiguousarray(from_cameras[point].T), slice(0, len(rows)))
    total = np.einsum("imn,nij,jkn->nmk", by_point, spread[point], by_point) + np.eye(3)
    out = np.full(len(data.spots), np.inf)
    out[rows] = np.einsum("mn,nm->n", residual, np.linalg.solve(total, residual.T[:, :, None])[:, :, 0])
    return out


def _refuse_empty(data: LrfData, judged: BoolArray) -> None:
    count = np.bincount(data.spots.setting[judged], minlength=len(data.settings.angle_rad))
    empty = np.flatnonzero(count == 0)
    if len(empty):
        angles = ", ".join(f"{np.degrees(data.settings.angle_rad[t]):.1f}°" for t in empty.tolist())
        raise DegenerateError(
            f"no LRF sighting at tilt {angles} agrees with the cameras",
            advice="Cross the scan plane there with the spot in view of two cameras, and check the tilt angle.",
        )
