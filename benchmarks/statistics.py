"""A synthetic room, many seeds: are the errors as small as the data allow, and are the stated uncertainties true?

The same room and walk each time, new noise. Efficiency is measured after a similarity: in the frame of C0, whose scale
comes from the short baseline, all centres err together by the one error of the scale, and a hundred draws of one number
have an RMS that is good to 7 % only. Coverage is measured in that frame, where the stated covariances hold.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import chi2

from benchmarks.report import Row, Run, at_least, within
from benchmarks.rooms import baseline_of, random_generator, setups_of, solve_once
from network_calib.bundle import covariance
from network_calib.camera_block import cameras_of
from network_calib.cameras import Cameras
from network_calib.gauge import into_camera, similarity_directions
from network_calib.observations import FloatArray
from network_calib.optimum import Network
from network_calib.refine import build_problem, fit
from network_calib.robust_loss import SquaredLoss
from network_calib.room_setup import Options
from network_calib.spots import SpotViews, locate
from network_calib.synthetic import Room, Sighting, align_cameras, observe, room
from network_calib.uncertainty import uncertainty
from network_calib.world import in_world

SIGMA_PX = 0.2
CENTRE, FOCAL = slice(3, 6), 6


@dataclass(frozen=True, slots=True)
class Bound:
    """Smallest mean squares that an unbiased estimate can have, summed over cameras: centres after a similarity."""

    centre_m2: float
    focal_px2: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """One seed, C cameras.

    Attributes:
        centre_m: (C, 3) errors after a similarity.
        focal_px: (C,) errors.
        bound: of Cramer and Rao.
        centre_in_c0_m: (C, 3) errors in the frame of C0, scaled by the baseline.
        stated: (C, 14, 14) covariance of the result in that frame.
        mask_accuracy: share of observations judged rightly.
        clean_centre_m: (C, 3) errors after a similarity of a fit to exactly the true inliers.
        clean_focal_px: (C,) the same of the focal lengths.
    """

    centre_m: FloatArray
    focal_px: FloatArray
    bound: Bound
    centre_in_c0_m: FloatArray
    stated: FloatArray
    mask_accuracy: float
    clean_centre_m: FloatArray
    clean_focal_px: FloatArray


def measure(run: Run) -> Iterator[Row]:
    """Clean, then with gaps and false detections."""
    n_seeds, n_frames = run.pick(300, 8), run.pick(1500, 600)
    for missing, false_detections in ((0.0, 0.0), (0.3, 0.1)):
        trial = partial(_trial, n_frames, missing, false_detections)
        # Seeds are independent: two at a time, each on one core.
        with multiprocessing.get_context("spawn").Pool(2) as pool:
            outcomes = pool.map(trial, range(n_seeds), chunksize=1)
        what = f"smart room, {n_frames} frames, {n_seeds} seeds, {SIGMA_PX} px"
        if missing:
            what += f", {missing:.0%} missing, {false_detections:.0%} false"
        yield from _efficiency(what, outcomes, has_outliers=false_detections > 0)
        yield _coverage(what, outcomes)
        if false_detections:
            yield from _outliers(what, outcomes)


def _trial(n_frames: int, missing: float, false_detections: float, seed: int) -> Outcome:
    truth = room("smart_room", rng=random_generator(0), n_frames=n_frames)
    rng = random_generator(1, seed)
    seen = observe(truth, rng=rng, sigma_px=SIGMA_PX, missing=missing, false_detections=false_detections)
    setups, anchor, views = setups_of(truth), baseline_of(truth), SpotViews.of(seen.observations)
    network = solve_once(seen.observations, setups, anchor=anchor, seed=seed)
    _, refined = in_world(network.refined, views, anchor, Options())
    is_usable = seen.is_usable[seen.observations.n_views() >= 2]
    true_cameras = into_camera(truth.cameras, 0, 1.0).apply_to_cameras(truth.cameras)
    clean = _clean_fit(truth, seen, network)
    return Outcome(
        centre_m=_centre_errors(refined.cameras, truth),
        focal_px=refined.cameras.intrinsics[:, 0] - truth.cameras.intrinsics[:, 0],
        bound=_bound(truth, seen),
        centre_in_c0_m=refined.cameras.centres_in_world - true_cameras.centres_in_world,
        stated=uncertainty(refined, setups, views, anchor).cameras,
        mask_accuracy=float((refined.is_inlier == is_usable).mean()),
        clean_centre_m=_centre_errors(clean, truth),
        clean_focal_px=clean.intrinsics[:, 0] - truth.cameras.intrinsics[:, 0],
    )


def _centre_errors(estimated: Cameras, truth: Room) -> FloatArray:
    aligned, _ = align_cameras(estimated, truth.cameras)
    return aligned.centres_in_world - truth.cameras.centres_in_world


def _clean_fit(truth: Room, seen: Sighting, network: Network) -> Cameras:
    """What the true inliers alone give."""
    views = SpotViews.of(seen.observations.select(seen.is_usable))
    cameras = network.refined.cameras
    points, agrees = locate(cameras, views, np.full(len(views.point), 50 * SIGMA_PX))
    return fit(setups_of(truth), cameras, views, points, agrees, np.full(len(cameras), SIGMA_PX))


def _bound(truth: Room, seen: Sighting) -> Bound:
    """Inverse of the Fisher information of the true inliers at the truth, with the true noise and without any prior."""
    views = SpotViews.of(seen.observations.select(seen.is_usable))
    ignorant = [replace(setup, intrinsics_sigma=np.full(8, np.inf)) for setup in setups_of(truth)]
    problem, state = build_problem(
        ignorant,
        truth.cameras,
        views,
        truth.trajectory[views.frames],
        np.arange(len(views.point)),
        np.ones(views.n_points, dtype=bool),
        np.full(len(truth.cameras), SIGMA_PX),
        SquaredLoss(),
    )
    joint, columns = covariance(problem, state).shared, problem.point_blocks[0].columns
    centre, focal = columns[:, CENTRE].ravel(), columns[:, FOCAL]
    # The fitted similarity takes what lies along the motions of all centres together.
    motions, _ = np.linalg.qr(similarity_directions(cameras_of(state.parts))[centre])
    rest = np.eye(len(centre)) - motions @ motions.T
    aligned = rest @ joint[np.ix_(centre, centre)] @ rest
    return Bound(float(np.trace(aligned)), float(np.trace(joint[np.ix_(focal, focal)])))


def _efficiency(what: str, outcomes: list[Outcome], *, has_outliers: bool) -> Iterator[Row]:
    """RMS error over the root of the mean bound, with the standard error that so few seeds leave."""
    centre2 = np.array([(one.centre_m**2).sum() for one in outcomes])
    focal2 = np.array([(one.focal_px**2).sum() for one in outcomes])
    centre_bound = np.mean([one.bound.centre_m2 for one in outcomes])
    focal_bound = np.mean([one.bound.focal_px2 for one in outcomes])
    for name, squares, bound in (("camera centres", centre2, centre_bound), ("focal lengths", focal2, focal_bound)):
        ratio = np.sqrt(squares.mean() / bound)
        spread = 0.5 * ratio * squares.std(ddof=1) / squares.mean() / np.sqrt(len(squares))
        note = f"± {spread:.3f} by the draw of the seeds"
        row = within(f"{what}: RMS error of {name} / Cramér–Rao bound", float(ratio), 0.95, 1.05, note=note)
        # With false detections the bound is that of knowing the inliers, and the fit of these is the measure, below.
        yield replace(row, reach="", is_met=None) if has_outliers else row
    in_c0 = np.sqrt(
        np.mean([(one.centre_in_c0_m**2).sum() for one in outcomes])
        / np.mean([np.trace(one.stated[:, CENTRE, CENTRE], axis1=1, axis2=2).sum() for one in outcomes])
    )
    measured = f"{in_c0:.3f} (not judged: one mode, the scale from the short baseline, dominates)"
    yield Row(f"{what}: the same of the centres in the frame of C0", measured)


def _coverage(what: str, outcomes: list[Outcome]) -> Row:
    """How often the truth lies in the stated 95 % ellipsoid of a centre; C0 is the frame and C1 half of it."""
    distance2 = np.array(
        [
            [error @ np.linalg.solve(cov, error) for error, cov in zip(e, c, strict=True)]
            for e, c in ((one.centre_in_c0_m[2:], one.stated[2:, CENTRE, CENTRE]) for one in outcomes)
        ]
    )
    focal2 = np.array([one.focal_px**2 / one.stated[:, FOCAL, FOCAL] for one in outcomes])
    focal_share = float((focal2 < chi2.ppf(0.95, 1)).mean())
    by_seed = (distance2 < chi2.ppf(0.95, 3)).mean(axis=1)
    note = f"± {100 * by_seed.std(ddof=1) / np.sqrt(len(by_seed)):.1f}; focal intervals {focal_share:.1%}"
    return within(f"{what}: 95 % ellipsoids of centres hold", 100 * float(by_seed.mean()), 93, 97, unit=" %", note=note)


def _outliers(what: str, outcomes: list[Outcome]) -> Iterator[Row]:
    accuracy = np.array([one.mask_accuracy for one in outcomes])
    note = f"worst seed {100 * accuracy.min():.2f} %"
    yield at_least(f"{what}: inlier mask right", 100 * float(accuracy.mean()), 99.5, unit=" %", note=note)
    for name, all_errors in (
        ("camera centres", [(one.centre_m, one.clean_centre_m) for one in outcomes]),
        ("focal lengths", [(one.focal_px, one.clean_focal_px) for one in outcomes]),
    ):
        ours, clean = (np.sqrt(np.mean([(pair[k] ** 2).sum() for pair in all_errors])) for k in (0, 1))
        ratio = float(ours / clean)
        yield within(f"{what}: RMS error of {name} / that of the true inliers' fit", ratio, 0.0, 1.05)
