"""Steps 1 to 6: from observations to the joint optimum, by the start that works, or to the reason why there is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from network_calib.anchor import anchor_start
from network_calib.cameras import Cameras, cam_from_img
from network_calib.diagnose import late_cameras, mirrored_camera
from network_calib.epipolar import unbend
from network_calib.errors import ConvergenceError, DegenerateError, FlatError, InputError, SpotcalError
from network_calib.observations import BoolArray, FloatArray, Observations
from network_calib.pairs import PairGraph, verify_pairs
from network_calib.refine import Refined, refine
from network_calib.refusals import refuse_disagreement, refuse_flat, refuse_islands
from network_calib.room_setup import Anchor, CameraSetup, Knowledge, KnownDistance, Options
from network_calib.spots import SpotViews
from network_calib.start import Start, StartProblem
from network_calib.svoboda_start import factorisation_start
from network_calib.twin import twin_cost_ratio

Progress = Callable[[str, float], None]
# Within which a start may be off, and detections may be bent by an unknown lens.
START_TOLERANCE_PX = 4.0
# Beyond this many cameras the factorisation's triples outnumber what it gains over growth.
MAX_FACTORISED_CAMERAS = 12
# Enough to tell whether a mirrored camera is the reason, which takes one attempt for each camera.
DIAGNOSED_FRAMES = 300
# In a plane the epipolar geometry does not tell the lens: rays stay bent by some percent. Volumes stand far above.
BENT_RAYS_SLACK = 3.0


@dataclass(frozen=True, slots=True)
class Network:
    """The optimum with what led to it.

    Attributes:
        graph: the verified pairs.
        start: the start that worked.
        refined: the optimum, in the solve's own frame and scale.
    """

    graph: PairGraph
    start: Start
    refined: Refined


def optimise(
    setups: Sequence[CameraSetup],
    views: SpotViews,
    *,
    anchor: Anchor,
    options: Options,
    seed: int,
    progress: Progress | None = None,
) -> Network:
    """From observations to the joint optimum.

    Raises:
        InputError: given intrinsics under which detections have no ray, or an unknown start method.
        DegenerateError: observations that do not determine the network.
        ConvergenceError: no optimum worth reporting.
    """
    report = progress or (lambda _step, _part: None)
    report("pairwise verification", 0.0)
    problem = start_problem(setups, views)
    graph = verify_pairs(problem, rng=np.random.default_rng(seed))
    refuse_islands(graph)
    # Two cameras side by side see a volume as if it were flat.
    unbent = unbend(problem.ray_xy, graph.bend[problem.camera])
    if len(setups) > 2:
        refuse_flat(setups, views, unbent, graph.is_inlier)
    failures: list[SpotcalError] = []
    for method in _methods(graph, options):
        try:
            report(f"start by {method}", 0.1)
            start = _start(method, problem, graph, anchor, seed)
            report("joint solve", 0.25)
            refined = refine(setups, started_cameras(setups, start), views, rejection=options.rejection)
            refuse_disagreement(graph.names, _inlier_share(refined, views), refined.noise_px(views))
            rays, has_ray = solved_rays(refined.cameras, views)
            refuse_flat(setups, views, rays, refined.is_inlier & has_ray)
        except (DegenerateError, ConvergenceError) as error:
            failures.append(error)
            continue
        return Network(graph, start, refined)
    # Flatness is the cause of whatever else went wrong.
    if len(setups) > 2:
        refuse_flat(setups, views, unbent, graph.is_inlier, slack=BENT_RAYS_SLACK)
    raise next((failure for failure in failures if isinstance(failure, FlatError)), failures[0])


def better_of_twins(
    setups: Sequence[CameraSetup], refined: Refined, views: SpotViews, options: Options
) -> tuple[Refined, float]:
    """The solution or its mirrored twin, whichever fits, and the other's cost over its own."""
    ratio, twin_cameras = twin_cost_ratio(setups, refined, views)
    if ratio >= 1:
        return refined, ratio
    return refine(setups, twin_cameras, views, rejection=options.rejection), 1 / ratio


def explained(
    error: SpotcalError,
    setups: Sequence[CameraSetup],
    observations: Observations,
    *,
    anchor: Anchor,
    options: Options,
    seed: int,
) -> SpotcalError:
    """The same refusal with what is found out about cameras that lag by whole frames or show a mirrored image."""
    if isinstance(error, FlatError):
        return error
    views = SpotViews.of(observations)
    try:
        graph = verify_pairs(start_problem(setups, views), rng=np.random.default_rng(seed))
    except SpotcalError:
        return error

    one_start = replace(options, start=_methods(graph, options)[0])

    def attempt(trial_setups: Sequence[CameraSetup], trial_observations: Observations) -> float:
        trial_views = SpotViews.of(trial_observations)
        network = optimise(trial_setups, trial_views, anchor=anchor, options=one_start, seed=seed)
        return float(network.refined.noise_px(trial_views).max())

    late = late_cameras(observations, graph)
    if late:
        return type(error)("\n".join(late), advice="Mend the trigger, or correct the frame numbers.")
    is_tied = len(graph.islands()) == 1
    is_sampled = np.zeros(views.n_points, dtype=bool)
    is_sampled[np.linspace(0, views.n_points - 1, min(DIAGNOSED_FRAMES, views.n_points)).astype(np.int64)] = True
    sample = views.select_points(is_sampled).observations
    mirrored = mirrored_camera(setups, sample, attempt) if is_tied else None
    if mirrored is not None:
        return type(error)(
            f"the image of {mirrored} seems mirrored: with its x axis turned round all cameras agree",
            advice=f"Switch off mirroring in {mirrored}, or swap left and right of its detections.",
        )
    return error


def start_problem(setups: Sequence[CameraSetup], views: SpotViews) -> StartProblem:
    """The observations as nominal rays.

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


def solved_rays(cameras: Cameras, views: SpotViews) -> tuple[FloatArray, BoolArray]:
    """(K, 2) undistorted rays of all views, and whether each has one."""
    return cam_from_img(cameras.intrinsics[views.camera], cameras.is_fisheye[views.camera], views.px)


def _methods(graph: PairGraph, options: Options) -> tuple[str, ...]:
    """Which starts to try, in order. Factorisation wants everyone to share with (nearly) everyone."""
    if options.start != "auto":
        return (options.start,)
    n = len(graph.names)
    is_dense = 2 < n <= MAX_FACTORISED_CAMERAS and len(graph.pairs) >= 0.8 * n * (n - 1) / 2
    return ("factorisation", "anchor") if is_dense else ("anchor", "factorisation")


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


def _inlier_share(refined: Refined, views: SpotViews) -> FloatArray:
    n_own = np.bincount(views.camera, minlength=views.n_cameras)
    return np.bincount(views.camera[refined.is_inlier], minlength=views.n_cameras) / np.maximum(n_own, 1)
