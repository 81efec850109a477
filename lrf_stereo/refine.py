"""The joint maximum-likelihood solve of cameras, LRFs and tilt angles over shared latent spots.

Each spot is one latent point seen by any number of cameras and LRFs; nothing is triangulated and registered in two
steps, so the stereo pair's poor depth weighs as little as it should.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from lrf_stereo.lrf_block import N_COLUMNS, SCANNERS, TILTS, LrfBlock
from lrf_stereo.lrf_priors import DistancePrior, InstrumentPrior, InstrumentSigma, TiltPrior
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.scanner_part import N_GEOMETRY, N_SCANNER, ScannerPart, TiltPart
from network_calib.blocks import Gauge, Problem, SharedBlock, State
from network_calib.bundle import Solution, SolverOptions, covariance, solve
from network_calib.camera_block import PART, CameraBlock, cameras_of
from network_calib.camera_parameters import CameraParameters, free_columns
from network_calib.cameras import Cameras
from network_calib.errors import DegenerateError
from network_calib.gauge import Similarity, similarity_directions
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.priors import lens_prior
from network_calib.refine import intrinsics_groups
from network_calib.robust_loss import CauchyLoss, Loss, SquaredLoss
from network_calib.room_setup import CameraSetup, Knowledge, KnownDistance
from network_calib.spots import SpotViews, located, spots_from_cameras

N_ROUNDS = 6
# A given baseline without sigma is held to a millionth: exact, as far as anything here can tell.
MIN_RELATIVE_SIGMA = 1e-6
ROBUST = SolverOptions(cost_tolerance=1e-4)
EXACT = SolverOptions(cost_tolerance=1e-10, initial_damping=1e-6)


@dataclass(frozen=True, slots=True)
class NetworkData:
    """The camera side of a joint solve.

    Attributes:
        setups: what is known of each camera.
        cameras: C cameras, metric.
        views: K camera observations of F spots.
        points: (F, 3) spots in the cameras' world, NaN where not located.
        is_inlier: (K,) observations that count.
        noise: (C,) noise factors.
        is_held: the cameras are known and stay as they are.
        baseline: the metric anchor of cameras that are not held; None leaves the scale to the LRFs' ranges.
    """

    setups: Sequence[CameraSetup]
    cameras: Cameras
    views: SpotViews
    points: FloatArray
    is_inlier: BoolArray
    noise: FloatArray
    is_held: bool
    baseline: KnownDistance | None


@dataclass(frozen=True, slots=True)
class LrfData:
    """The LRF side of a joint solve.

    Attributes:
        spots: M sightings.
        settings: T tilt settings as measured. A covariance of zero trusts the angles as they are.
        point: (M,) point index of each sighting's frame in the cameras' views, -1 where they have none.
        instrument: what the scanners may be wrong by.
    """

    spots: LrfSpots
    settings: TiltSettings
    point: IntArray
    instrument: InstrumentSigma

    @classmethod
    def of(cls, spots: LrfSpots, settings: TiltSettings, views: SpotViews, instrument: InstrumentSigma) -> LrfData:
        """Find the sightings' points in the cameras' views."""
        point = np.full(len(spots), -1)
        if views.n_points:
            at = np.minimum(np.searchsorted(views.frames, spots.frame), views.n_points - 1)
            point = np.where(views.frames[at] == spots.frame, at, -1)
        return cls(spots, settings, point, instrument)

    @property
    def measured(self) -> FloatArray:
        """(3, M) range, bearing, height over the scan plane."""
        return np.stack([self.spots.range_m, self.spots.bearing_rad, self.spots.out_of_plane_m])

    @property
    def sigma(self) -> FloatArray:
        """(3, M) standard deviations of `measured`."""
        return np.stack([self.spots.sigma_range_m, self.spots.sigma_bearing_rad, self.spots.sigma_out_of_plane_m])


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
    instrument: InstrumentSigma | None = None,
    rejection: float = 4.0,
) -> LrfRefined:
    """Cameras, scanners and tilt angles of maximum likelihood.

    Args:
        network: the camera side; the world is the cameras'.
        scanners: the start; poses hold at each scanner's first setting.
        spots: LRF sightings; those whose frame the cameras did not locate are left out.
        settings: measured tilt angles. A covariance of zero trusts them as they are.
        instrument: what the scanners may be wrong by; by default nothing.
        rejection: sigma (of one dimension) whose probability a sighting's surprise must not pass.

    Raises:
        DegenerateError: no sighting of a setting is left.
    """
    data = LrfData.of(spots, settings, network.views, instrument or InstrumentSigma())
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
        solved = _posed(solved, cam_from_world)
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
    """Covariances under the gauge of the first camera (nothing is free when the cameras are held).

    Attributes:
        cameras: (C, 14, 14), zero when held.
        scanners: (S, 14, 14) in the order of SCANNER_TANGENT.
        tilts: (T, T) rad^2; zero for reference settings.
        joint: (n, n) of the whole shared tangent vector: cameras, scanners, tilts.
    """

    cameras: FloatArray
    scanners: FloatArray
    tilts: FloatArray
    joint: FloatArray


def lrf_covariance(refined: LrfRefined) -> LrfCovariance:
    """Covariances at a joint optimum.

    Raises:
        DegenerateError: some direction is not determined.
    """
    try:
        joint = covariance(refined.problem, refined.state).shared
    except LinAlgError as error:
        raise DegenerateError(
            "the LRF sightings leave some direction of the scanner free",
            advice="Take more tilts, further apart, and spots near and far, left and right.",
        ) from error
    padded = np.pad(joint, ((0, 1), (0, 1)))
    cameras, scanners, tilts = (refined.state.parts[name] for name in (PART, SCANNERS, TILTS))
    assert isinstance(cameras, CameraParameters)
    assert isinstance(scanners, ScannerPart)
    assert isinstance(tilts, TiltPart)
    first_scanner, first_tilt = cameras.size, cameras.size + scanners.size
    return LrfCovariance(
        _cut(padded, cameras.columns),
        _cut(padded, _shifted(scanners.columns, first_scanner)),
        _cut(padded, _shifted(tilts.columns, first_tilt)[None])[0],
        joint,
    )


def _cut(padded: FloatArray, columns: IntArray) -> FloatArray:
    return padded[columns[:, :, None], columns[:, None, :]]


def _shifted(columns: IntArray, first: int) -> IntArray:
    return np.where(columns >= 0, columns + first, -1)


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


def _posed(solved: _Solved, cam_from_world: RigidTransform) -> _Solved:
    """The same solution with the first camera where it was: the solve lets the whole world drift."""
    drifted, state = solved.network, solved.solution.state
    world_from_drifted = cam_from_world.inv() * drifted.cameras.cam_from_world[0]
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
    return replace(solved, network=network, scanners=scanners, solution=replace(solved.solution, state=state))


def _degrees_of_freedom(solved: _Solved, *, is_held: bool) -> int:
    camera_block, lrf_block = solved.problem.point_blocks
    n_residuals = 2 * len(camera_block.point) + 3 * len(lrf_block.point)
    n_residuals += sum(len(block.columns) for block in solved.problem.shared_blocks)
    state = solved.solution.state
    return n_residuals - 3 * state.points.shape[1] - state.n_shared + (0 if is_held else 6)


def build_joint_problem(
    network: NetworkData,
    scanners: tuple[TiltingScanner, ...],
    data: LrfData,
    is_inlier: BoolArray,
    is_used: BoolArray,
    loss: Loss,
) -> tuple[Problem, State]:
    """The joint problem over the points `is_used` (F,) and the sightings `is_inlier` (M,), and its start."""
    number = np.cumsum(is_used) - 1
    camera_columns = _camera_columns(network)
    cameras = CameraParameters.from_cameras(network.cameras, camera_columns)
    part = ScannerPart.from_scanners(scanners, _scanner_columns(len(scanners), data.instrument))
    tilts = TiltPart(data.settings.angle_rad, _tilt_columns(data.settings))
    tilt_columns = _shifted(tilts.columns, cameras.size + part.size)
    rows = np.flatnonzero(network.is_inlier & is_used[network.views.point])
    camera_block = CameraBlock(
        group=network.views.camera[rows],
        point=number[network.views.point[rows]],
        px=np.ascontiguousarray(network.views.px[rows].T),
        inverse_sigma=1 / (network.noise[network.views.camera[rows]] * network.views.sigma_px[rows]),
        columns=camera_columns,
        loss=SquaredLoss(),
    )
    kept = np.flatnonzero(is_inlier)
    lrf_block = LrfBlock(
        group=data.spots.setting[kept],
        point=number[data.point[kept]],
        measured=data.measured[:, kept],
        inverse_sigma=1 / data.sigma[:, kept],
        scanner_of_setting=data.settings.scanner,
        reference_rad=np.array([scanner.reference_tilt_rad for scanner in scanners]),
        columns=np.column_stack([_shifted(part.columns, cameras.size)[data.settings.scanner], tilt_columns]),
        loss=loss,
    )
    priors: list[SharedBlock] = [
        lens_prior(network.setups, cameras),
        InstrumentPrior.of(part, data.instrument, cameras.size),
    ]
    free = np.flatnonzero(tilts.columns >= 0)
    if len(free):
        priors.append(TiltPrior.of(data.settings, free, tilt_columns[free]))
    if network.baseline is not None and not network.is_held:
        priors.append(_distance_prior(network, network.baseline, camera_columns))
    state = State({PART: cameras, SCANNERS: part, TILTS: tilts}, np.ascontiguousarray(network.points[is_used].T))
    return Problem([camera_block, lrf_block], priors, None if network.is_held else _first_camera_gauge), state


def _camera_columns(network: NetworkData) -> IntArray:
    n = len(network.cameras)
    is_fixed = np.array([network.is_held or setup.knowledge is Knowledge.FIXED for setup in network.setups])
    return free_columns(
        tuple(setup.lens for setup in network.setups),
        is_pose_fixed=np.full(n, network.is_held),
        is_intrinsics_fixed=is_fixed,
        groups=intrinsics_groups(network.setups),
    )


def _scanner_columns(n_scanners: int, instrument: InstrumentSigma) -> IntArray:
    is_free = np.concatenate([np.ones(N_GEOMETRY, dtype=bool), instrument.as_array() > 0])
    columns = np.full((n_scanners, N_SCANNER), -1, dtype=np.int64)
    columns[:, is_free] = np.arange(n_scanners * is_free.sum()).reshape(n_scanners, -1)
    return columns


def _tilt_columns(settings: TiltSettings) -> IntArray:
    """Reference settings stay; so do angles that are trusted (no variance of their difference)."""
    reference = settings.reference_settings()[settings.scanner]
    spread = settings.covariance_rad2
    own = np.arange(len(settings.angle_rad))
    variance = spread[own, own] + spread[reference, reference] - 2 * spread[own, reference]
    is_free = (own != reference) & (variance > 0)
    return np.where(is_free, np.cumsum(is_free) - 1, -1)


def _distance_prior(network: NetworkData, known: KnownDistance, camera_columns: IntArray) -> DistancePrior:
    a, b = network.cameras.names.index(known.camera_a), network.cameras.names.index(known.camera_b)
    sigma_m = max(known.sigma_m, MIN_RELATIVE_SIGMA * known.distance_m)
    columns = np.concatenate([camera_columns[a, 3:6], camera_columns[b, 3:6]])[None]
    return DistancePrior(a, b, known.distance_m, sigma_m, columns)


def _first_camera_gauge(state: State) -> Gauge:
    """The first camera's pose stays; ranges or the baseline determine the scale."""
    cameras, part = cameras_of(state.parts), state.parts[SCANNERS]
    assert isinstance(part, ScannerPart)
    constraints = np.zeros((6, state.n_shared))
    constraints[np.arange(6), cameras.columns[0, :6]] = 1.0
    null = np.zeros((state.n_shared, 6))
    null[: cameras.size] = similarity_directions(cameras)[:, :6]
    null[cameras.size : cameras.size + part.size] = part.rigid_directions()
    return Gauge(constraints, null)


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
    block = LrfBlock(
        group=data.spots.setting[rows],
        point=point,
        measured=data.measured[:, rows],
        inverse_sigma=1 / data.sigma[:, rows],
        scanner_of_setting=data.settings.scanner,
        reference_rad=np.array([scanner.reference_tilt_rad for scanner in scanners]),
        columns=np.full((len(tilt_rad), N_COLUMNS), -1),
    )
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
