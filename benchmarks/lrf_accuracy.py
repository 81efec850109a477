"""The laser range finder on the paper's simulated set-up, 150 sessions: each method's error, and how far to trust it.

Errors are those of the calibration alone: exact readings, over tilts of 2 to 50 degrees, in the left image and in
space. The Cramer-Rao bound is the covariance of the joint problem at the truth.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.pool import Pool

import numpy as np
from scipy.stats import chi2

from benchmarks.lrf_time import time_rows
from benchmarks.report import Row, Run, at_least, at_most, within
from lrf_stereo.calibrate import LrfCalibration, calibrate_lrfs
from lrf_stereo.joint_problem import LrfData, build_joint_problem
from lrf_stereo.lrf_priors import InstrumentSigma
from lrf_stereo.refine import LrfRefined, lrf_covariance
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.study import (
    PROBE_TILTS_DEG,
    Accuracy,
    Method,
    MethodErrors,
    StudySetup,
    accuracy,
    gathered,
    run_once,
)
from lrf_stereo.study_data import StudyData
from lrf_stereo.synthetic import LrfSamples, SampleNoise, paper_scene, sample
from network_calib.observations import FloatArray
from network_calib.robust_loss import SquaredLoss

SEED, N_SPOTS = 0, 22
WRONG_PAIRS, WRONG_TILT_RAD = 0.2, float(np.radians(0.5))


@dataclass(frozen=True, slots=True)
class Trust:
    """One session by the joint solve: is what it says of itself true?

    Attributes:
        squared_m2: of the error of the LRF origin at the reference tilt.
        bound_m2: the Cramer-Rao bound of the same.
        distance2: of the error in the metric of the stated covariance.
        is_doubted: whether any doubt was raised, though nothing is wrong.
        told: for a trusted angle that is off by half a degree, each setting in turn, whether it is doubted.
    """

    squared_m2: float
    bound_m2: float
    distance2: float
    is_doubted: bool
    told: tuple[bool, ...]


def measure(run: Run) -> Iterator[Row]:
    """Errors, then trust, wrong pairs, and time."""
    n_runs = run.pick(150, 6)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        stereo = {n: _errors(pool, tuple(Method), StudySetup(), n, n_runs) for n in (6, N_SPOTS)}
        (room,) = _errors(pool, (Method.JOINT,), StudySetup(n_room_cameras=3), N_SPOTS, n_runs)
        trust = pool.map(_trust, range(run.pick(600, 6)), chunksize=1)
        wrong = pool.map(_wrong_pairs, range(n_runs), chunksize=1)
    what = f"stereo pair, {n_runs} sessions"
    for n, errors in stereo.items():
        for one in errors:
            yield from _error_rows(f"{what}, N = {n}", one)
    joint_of_6, paper = stereo[6][-1], stereo[N_SPOTS][0]
    share = float((joint_of_6.px_by_tilt / paper.px_by_tilt).max())
    yield at_most(f"{what}: joint with N = 6 / paper with N = 22, worst tilt", share, 1.0)
    note = _by_tilt(room.px_by_tilt, "px")
    worst = float(room.px_by_tilt.max())
    yield at_most(f"five cameras, {n_runs} sessions, N = 22: joint, worst tilt", worst, 0.25, unit=" px", note=note)
    yield from _trust_rows(trust)
    with_wrong, without = (np.median([pair[k].px for pair in wrong]) for k in (0, 1))
    change = 100 * abs(float(with_wrong / without) - 1)
    yield at_most(f"{what}: 20 % wrong pairs change the median error by", change, 5.0, unit=" %")
    yield from time_rows(run)


def _errors(
    pool: Pool, methods: tuple[Method, ...], setup: StudySetup, n_spots: int, n_runs: int
) -> list[MethodErrors]:
    rows = pool.map(partial(_session, methods, setup, n_spots), range(n_runs), chunksize=1)
    return [gathered(method, n_spots, [row[k] for row in rows]) for k, method in enumerate(methods)]


def _session(methods: tuple[Method, ...], setup: StudySetup, n_spots: int, run: int) -> tuple[Accuracy | None, ...]:
    return run_once(methods, setup, n_spots=n_spots, run=run, seed=SEED)


def _error_rows(what: str, errors: MethodErrors) -> Iterator[Row]:
    """Median over sessions and probes, worst tilt; what `joint` should reach is for 22 spots."""
    has_reach = errors.method is Method.JOINT and errors.n_spots == N_SPOTS
    for by_tilt, unit, reach in ((errors.px_by_tilt, "px", 0.5), (1e3 * errors.space_m_by_tilt, "mm", 5.0)):
        note = _by_tilt(by_tilt, unit) + (f"; {errors.n_refused} refused" if errors.n_refused else "")
        row = at_most(f"{what}: {errors.method}, worst tilt", float(by_tilt.max()), reach, unit=f" {unit}", note=note)
        yield row if has_reach else replace(row, reach="", is_met=None)


def _by_tilt(values: FloatArray, unit: str) -> str:
    tilts = "/".join(f"{tilt:g}" for tilt in PROBE_TILTS_DEG)
    return f"at {tilts}°: {' / '.join(f'{value:.2f}' for value in values)} {unit}"


def _joint(data: StudyData) -> LrfCalibration:
    return calibrate_lrfs(data.network, data.spots, data.settings, rng=np.random.default_rng(SEED))


def _trust(run: int) -> Trust:
    data, samples = _sampled(SampleNoise(), run)
    found = _joint(data)
    scanner = found.refined.scanners[0]
    truth = _referred(data.scene.scanner, scanner.reference_tilt_rad)
    error = scanner.world_from_lrf.translation - truth.world_from_lrf.translation
    told = []
    for setting in range(len(data.settings.angle_rad)):
        angles = data.settings.angle_rad.copy()
        angles[setting] += WRONG_TILT_RAD
        wrong = _joint(replace(data, settings=replace(data.settings, angle_rad=angles)))
        told.append(any(doubt.code in {"tilt angles", "lrf chi2"} for doubt in wrong.doubts))
    return Trust(
        squared_m2=float(error @ error),
        bound_m2=float(np.trace(_bound(data, samples, found.refined, truth))),
        distance2=float(error @ np.linalg.solve(found.covariance.scanners[0, 3:6, 3:6], error)),
        is_doubted=bool(found.doubts),
        told=tuple(told),
    )


def _sampled(noise: SampleNoise, run: int) -> tuple[StudyData, LrfSamples]:
    rng = np.random.default_rng((SEED, 1, run))
    scene = paper_scene(rng=rng, n_spots_per_tilt=N_SPOTS)
    samples = sample(scene, rng=rng, noise=noise)
    return StudyData.of(scene, samples), samples


def _referred(scanner: TiltingScanner, tilt_rad: float) -> TiltingScanner:
    """The same scanner with its pose stated at another tilt."""
    pose = scanner.world_from_lrf_at(tilt_rad)
    return replace(scanner, world_from_lrf=pose, reference_tilt_rad=tilt_rad)


def _bound(data: StudyData, samples: LrfSamples, like: LrfRefined, truth: TiltingScanner) -> FloatArray:
    """(3, 3) inverse of the Fisher information of the LRF origin, at the truth."""
    network = replace(data.network, points=samples.spots_in_world[data.network.views.frames])
    joint = LrfData.of(data.spots, data.settings, network.views, InstrumentSigma())
    everything = np.ones(network.views.n_points, dtype=bool)
    is_seen = joint.point >= 0
    problem, state = build_joint_problem(network, (truth,), joint, is_seen, everything, SquaredLoss())
    return lrf_covariance(replace(like, problem=problem, state=state)).scanners[0, 3:6, 3:6]


def _trust_rows(trust: list[Trust]) -> Iterator[Row]:
    squared, bound, distance2 = (
        np.array([getattr(one, name) for one in trust]) for name in ("squared_m2", "bound_m2", "distance2")
    )
    ratio = float(np.sqrt(squared.mean() / bound.mean()))
    spread = 0.5 * ratio * squared.std(ddof=1) / squared.mean() / np.sqrt(len(squared))
    what = f"joint, N = 22, {len(trust)} sessions"
    note = f"± {spread:.3f} by the draw of the sessions; RMS {1e3 * np.sqrt(squared.mean()):.2f} mm"
    yield at_most(f"{what}: RMS error of the LRF origin / Cramér–Rao bound", ratio, 1.05, note=note)
    inside = distance2 < chi2.ppf(0.95, 3)
    note = f"± {100 * np.sqrt(0.95 * 0.05 / len(trust)):.1f}; mean NEES {distance2.mean():.2f} of 3"
    yield within(f"{what}: 95 % ellipsoid of the LRF origin holds", 100 * inside.mean(), 93, 97, unit=" %", note=note)
    told = np.array([one.told for one in trust])
    yield at_least(f"{what}: a trusted angle off by 0.5° is told", 100 * told.mean(), 99.0, unit=" %")
    false_alarms = float(np.mean([one.is_doubted for one in trust]))
    yield at_most(f"{what}: doubts where nothing is wrong", 100 * false_alarms, 1.0, unit=" %")


def _wrong_pairs(run: int) -> tuple[Accuracy, Accuracy]:
    """Errors with wrong pairs among the sightings, and with the right ones alone."""
    data, samples = _sampled(SampleNoise(wrong_pairs=WRONG_PAIRS), run)
    found, clean = _joint(data), _joint(data.keep(samples.is_true))
    return accuracy(found.refined.scanners[0], data.scene), accuracy(clean.refined.scanners[0], data.scene)
