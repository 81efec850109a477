"""The calibration of a camera network as a list of steps (Svoboda, Martinec, Pajdla 2005; see the package docstring)."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from scipy.linalg import LinAlgError

from network_calib import doubts, quality
from network_calib.anchor import anchor_start
from network_calib.bundle import Covariance, covariance
from network_calib.cameras import Cameras, cam_from_img
from network_calib.errors import ConvergenceError, DegenerateError, InputError, SpotcalError
from network_calib.observations import FloatArray, Observations
from network_calib.pairs import PairGraph, verify_pairs
from network_calib.refine import Refined, refine
from network_calib.refusals import (
    refuse_bad_input,
    refuse_disagreement,
    refuse_flat,
    refuse_islands,
    refuse_unobservable,
)
from network_calib.result import CalibratedCamera, Calibration, NetworkQuality, Provenance, Warning
from network_calib.room_setup import Anchor, CameraSetup, KnownDistance, Knowledge, Options, UnitScale
from network_calib.spots import SpotViews
from network_calib.start import Start, StartProblem
from network_calib.svoboda_start import factorisation_start
from network_calib.sync import estimate_time_offsets
from network_calib.world import in_world, covariance_problem

Progress = Callable[[str, float], None]
# Within which a start may be off, and detections may be bent by an unknown lens.
START_TOLERANCE_PX = 4.0


def calibrate(
    observations: Observations,
    setups: Sequence[CameraSetup],
    *,
    anchor: Anchor | None = None,
    options: Options | None = None,
    seed: int = 0,
    input_name: str = "",
    input_sha256: str = "",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate a camera network from spot observations.

    Args:
        observations: of all cameras, in the order of the setups.
        setups: what is known of each camera.
        anchor: where metric scale and world frame come from; by default the first camera's frame and unit scale.
        options: how to solve.
        seed: of all random draws; the same input and seed give the same result, bit for bit.
        input_name: stands in the result.
        input_sha256: stands in the result.
        progress: called with the name of each step and the fraction done.

    Raises:
        InputError: input that does not fit together.
        DegenerateError: observations that do not determine the network; says why and where to wave.
        ConvergenceError: no optimum worth reporting.
    """
    anchor, options, report = anchor or UnitScale(), options or Options(), progress or (lambda _step, _part: None)
    views = SpotViews.of(observations)
    refuse_bad_input(observations, setups, views)

    report("pairwise verification", 0.0)
    network = _optimise(setups, views, anchor, options, seed, report)
    refuse_flat(setups, network.refined.points)

    report("world frame and covariance", 0.55)
    world_frame, refined = in_world(network.refined, views, anchor, options)
    spread = _covariance(refined, setups, views, anchor)
    focal_px, focal_sigma_px = refined.cameras.intrinsics[:, 0], np.sqrt(np.diagonal(spread.cameras, 0, 1, 2)[:, 6])
    refuse_unobservable(setups, focal_px, focal_sigma_px)

    report("hold-out", 0.65)
    held = quality.hold_out(setups, refined, views, share=options.holdout_share)
    qualities = quality.camera_qualities(setups, refined, views, held)
    report("repeats", 0.75)
    centre_spread, focal_spread_px = _repeat_spread(setups, views, anchor, options, seed, refined)

    report("checks", 0.95)
    fitted, holdout = quality.overall_error(refined, views), quality.overall_holdout(held)
    rows = np.flatnonzero(refined.is_inlier)
    offsets = estimate_time_offsets(refined.problem, refined.state, views, rows)
    warnings = (
        *_convergence_doubt(refined),
        *doubts.about_cameras(setups, qualities, focal_px, focal_sigma_px),
        *doubts.about_geometry(network.graph, refined.cameras),
        *doubts.about_holdout(fitted, holdout, held.agreeing_share),
        *doubts.about_time(observations.camera_names, offsets),
        *doubts.about_given_intrinsics(setups, _freed(setups, refined, views, options)),
    )
    spot_sigma = np.sqrt(np.linalg.eigvalsh(spread.points)[:, -1])
    report("done", 1.0)
    return Calibration(
        cameras=tuple(
            CalibratedCamera(
                name=setup.name,
                size_px=setup.size_px,
                lens=setup.lens,
                intrinsics=refined.cameras.intrinsics[c],
                cam_from_world=refined.cameras.cam_from_world[c],
                covariance=spread.cameras[c],
                is_intrinsics_fixed=setup.knowledge is Knowledge.FIXED,
                quality=qualities[c],
            )
            for c, setup in enumerate(setups)
        ),
        world=world_frame,
        quality=NetworkQuality(
            n_points=len(np.unique(views.point[rows])),
            n_observations=len(views.point),
            n_inliers=len(rows),
            fitted=fitted,
            holdout=holdout,
            chi2_per_dof=quality.chi2_per_dof(refined, views, ~np.isnan(views.observations.sigma_px)),
            spot_sigma_median=float(np.median(spot_sigma)),
            spot_sigma_p95=float(np.percentile(spot_sigma, 95)),
            repeat_centre_spread=centre_spread,
            repeat_focal_spread_px=focal_spread_px,
        ),
        warnings=warnings,
        provenance=Provenance(
            program_version=program_version(),
            created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
            input_name=input_name,
            input_sha256=input_sha256,
            seed=seed,
            start_method=network.start.method,
            options_json=_canonical_json(options, anchor),
        ),
    )


@dataclass(frozen=True, slots=True)
class _Network:
    """The optimum with what led to it."""

    graph: PairGraph
    start: Start
    refined: Refined


@dataclass(frozen=True, slots=True)
class _Spread:
    """Covariances: (C, 14, 14) of the cameras, (F', 3, 3) of the located spots."""

    cameras: FloatArray
    points: FloatArray


def start_problem(setups: Sequence[CameraSetup], views: SpotViews) -> StartProblem:
    """The observations as nominal rays; those without a ray (beyond a given lens's rim) are refused.

    Raises:
        InputError: given intrinsics under which detections have no ray.
    """
    intrinsics = np.stack([setup.nominal_intrinsics() for setup in setups])
    is_fisheye = np.array([setup.lens.is_fisheye for setup in setups])
    ray_xy, has_ray = cam_from_img(intrinsics[views.camera], is_fisheye[views.camera], views.px)
    if not has_ray.all():
        k = int(np.flatnonzero(~has_ray)[0])
        raise InputError(
            f"camera {setups[views.camera[k]].name}: no ray leads to pixel {views.px[k].round(1)} "
            f"in frame {views.observations.frame[k]} through the given lens",
            advice="Check the given distortion and resolution, or leave the intrinsics unknown.",
        )
    return StartProblem(
        camera=views.camera,
        point=views.point,
        ray_xy=ray_xy,
        tolerance=START_TOLERANCE_PX / intrinsics[:, 0],
        is_focal_known=np.array([setup.knowledge is not Knowledge.UNKNOWN for setup in setups]),
        names=views.observations.camera_names,
    )


def _optimise(
    setups: Sequence[CameraSetup], views: SpotViews, anchor: Anchor, options: Options, seed: int, report: Progress
) -> _Network:
    """From observations to the joint optimum, by the start that works."""
    problem = start_problem(setups, views)
    graph = verify_pairs(problem, rng=np.random.default_rng(seed))
    refuse_islands(graph)
    failures: list[SpotcalError] = []
    for method in _methods(graph, options):
        report(f"start by {method}", 0.1)
        try:
            start = _start(method, problem, graph, anchor, seed)
            report("joint solve", 0.25)
            refined = refine(setups, started_cameras(setups, start), views, rejection=options.rejection)
            shares = _inlier_share(refined, views)
            refuse_disagreement(graph, shares)
        except (DegenerateError, ConvergenceError) as error:
            failures.append(error)
            continue
        return _Network(graph, start, refined)
    raise failures[0]


def _methods(graph: PairGraph, options: Options) -> tuple[str, ...]:
    """Which starts to try, in order. Factorisation wants everyone to share with (nearly) everyone."""
    if options.start != "auto":
        return (options.start,)
    n = len(graph.names)
    is_dense = n > 2 and len(graph.pairs) >= 0.8 * n * (n - 1) / 2
    return ("factorisation", "anchor") if is_dense and n <= 12 else ("anchor", "factorisation")


def _start(method: str, problem: StartProblem, graph: PairGraph, anchor: Anchor, seed: int) -> Start:
    rng = np.random.default_rng(seed)
    if method == "factorisation":
        return factorisation_start(problem, graph, rng=rng)
    if method != "anchor":
        raise InputError(f"unknown start {method!r}, expected auto, factorisation or anchor")
    pair = None
    if isinstance(anchor, KnownDistance) and anchor.is_stereo_pair:
        pair = (problem.names.index(anchor.camera_a), problem.names.index(anchor.camera_b))
    return anchor_start(problem, graph, rng=rng, seed_pair=pair)


def started_cameras(setups: Sequence[CameraSetup], start: Start) -> Cameras:
    """Nominal cameras with the start's poses and focal lengths."""
    intrinsics = np.stack([setup.nominal_intrinsics() for setup in setups])
    intrinsics[:, :2] *= start.focal_ratio[:, None]
    return Cameras(
        names=tuple(setup.name for setup in setups),
        size_px=np.array([setup.size_px for setup in setups], dtype=np.int64),
        lenses=tuple(setup.lens for setup in setups),
        intrinsics=intrinsics,
        cam_from_world=start.cam_from_world,
    )


def _inlier_share(refined: Refined, views: SpotViews) -> FloatArray:
    n_own = np.bincount(views.camera, minlength=views.n_cameras)
    return np.bincount(views.camera[refined.is_inlier], minlength=views.n_cameras) / np.maximum(n_own, 1)


def _covariance(refined: Refined, setups: Sequence[CameraSetup], views: SpotViews, anchor: Anchor) -> _Spread:
    """Covariances in the world frame, cut by camera."""
    problem, state = covariance_problem(refined, setups, views, anchor)
    try:
        joint: Covariance = covariance(problem, state)
    except LinAlgError as error:
        raise DegenerateError(
            "the observations leave some direction of the calibration free",
            advice="Wave through the whole volume, in view of several cameras at once.",
        ) from error
    columns = problem.point_blocks[0].columns
    padded = np.pad(joint.shared, ((0, 1), (0, 1)))
    return _Spread(padded[columns[:, :, None], columns[:, None, :]], joint.points)


def _repeat_spread(
    setups: Sequence[CameraSetup], views: SpotViews, anchor: Anchor, options: Options, seed: int, refined: Refined
) -> tuple[float, float]:
    """Largest differences of centres and focal lengths to runs with the next seeds."""
    centre, focal_px = [], []
    for other_seed in range(seed + 1, seed + options.n_repeats):
        network = _optimise(setups, views, anchor, options, other_seed, lambda _step, _part: None)
        _, other = in_world(network.refined, views, anchor, options)
        offset = other.cameras.centres_in_world - refined.cameras.centres_in_world
        centre.append(float(np.linalg.norm(offset, axis=1).max()))
        focal_px.append(float(np.abs(other.cameras.intrinsics[:, 0] - refined.cameras.intrinsics[:, 0]).max()))
    return max(centre, default=float("nan")), max(focal_px, default=float("nan"))


def _freed(setups: Sequence[CameraSetup], refined: Refined, views: SpotViews, options: Options) -> Cameras:
    """The cameras with held intrinsics let go (as priors), to see what the data want."""
    if not any(setup.knowledge is Knowledge.FIXED for setup in setups):
        return refined.cameras
    freed = [replace(s, knowledge=Knowledge.INITIAL) if s.knowledge is Knowledge.FIXED else s for s in setups]
    return refine(freed, refined.cameras, views, rejection=options.rejection).cameras


def _convergence_doubt(refined: Refined) -> tuple[Warning, ...]:
    if refined.has_converged:
        return ()
    return (Warning("convergence", "the joint solve stopped before it settled", "Wave longer; report this recording."),)


def program_version() -> str:
    """The installed version of spotcal."""
    try:
        return version("spotcal")
    except PackageNotFoundError:
        return "unknown"


def _canonical_json(options: Options, anchor: Anchor) -> str:
    def plain(value: object) -> object:
        return value.tolist() if isinstance(value, np.ndarray) else str(value)

    content = {"options": asdict(options), "anchor": {"kind": type(anchor).__name__, **asdict(anchor)}}
    return json.dumps(content, sort_keys=True, default=plain)
