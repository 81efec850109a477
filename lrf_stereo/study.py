"""Table I and figure 7 from a simulation: the methods side by side on the same sessions, their errors known.

A session is the paper's: spots on the scan plane at three tilts, seen by the stereo pair and the scanner. Its errors
are then taken over the whole range of tilts at exact readings of probes, so that they are the calibration's alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from lrf_stereo.calibrate import calibrate_lrfs, plane_samples
from lrf_stereo.joint_problem import LrfData
from lrf_stereo.lrf_priors import InstrumentSigma
from lrf_stereo.paper import calibrate_paper, calibrate_screw
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.study_data import StudyData
from lrf_stereo.synthetic import LrfScene, SampleNoise, paper_scene, sample, spots_on_plane
from network_calib.errors import SpotcalError
from network_calib.observations import FloatArray

PAPER_N_SPOTS = (6, 9, 12, 15, 18, 22)
# Table I as printed.
PAPER_AE_PX = (26.333, 9.655, 6.854, 7.080, 5.721, 5.715)
PAPER_SD_PX = (5.613, 3.577, 3.130, 3.148, 2.835, 2.807)
PROBE_TILTS_DEG = (2.0, 12.1, 23.2, 35.0, 50.0)
N_PROBES = 40


class Method(StrEnum):
    """How the scanner is calibrated."""

    PAPER = "paper"
    SCREW = "screw"
    JOINT = "joint"


@dataclass(frozen=True, slots=True)
class StudySetup:
    """What is simulated.

    Attributes:
        n_room_cameras: cameras around the room beside the stereo pair; three make five cameras in all.
        noise: of the samples.
    """

    n_room_cameras: int = 0
    noise: SampleNoise = field(default_factory=SampleNoise)


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Errors of one calibrated scanner at T tilts with P probes each.

    Attributes:
        px: (T, P) distance in the left image; a probe that is put behind the camera, or farther than the image's
            diagonal, counts as the diagonal.
        space_m: (T, P) distance in space.
        rotation_rad: (T,) angle between the true and the estimated rotation of the LRF in the camera's frame.
        translation_m: (T,) distance between the true and the estimated origin of the LRF.
    """

    px: FloatArray
    space_m: FloatArray
    rotation_rad: FloatArray
    translation_m: FloatArray


@dataclass(frozen=True, slots=True)
class MethodErrors:
    """Errors of one method with one number of spots over R runs; axes as in `Accuracy` behind the runs.

    Attributes:
        method: the method.
        n_spots: spots at each tilt.
        px: (R, T, P).
        space_m: (R, T, P).
        rotation_rad: (R, T).
        translation_m: (R, T).
        n_refused: runs that the method refused; they are not among the R.
    """

    method: Method
    n_spots: int
    px: FloatArray
    space_m: FloatArray
    rotation_rad: FloatArray
    translation_m: FloatArray
    n_refused: int

    @property
    def average_px(self) -> float:
        """Table I's AE: the mean over a run's probes; of the median run, since eq 10 has no finite mean."""
        return float(np.median(self.px.mean(axis=(1, 2))))

    @property
    def spread_px(self) -> float:
        """Table I's SD: the standard deviation over a run's probes; of the median run."""
        return float(np.median(self.px.std(axis=(1, 2))))

    @property
    def px_by_tilt(self) -> FloatArray:
        """(T,) median over runs and probes."""
        return np.median(self.px, axis=(0, 2))

    @property
    def space_m_by_tilt(self) -> FloatArray:
        """(T,) median over runs and probes."""
        return np.median(self.space_m, axis=(0, 2))


@dataclass(frozen=True, slots=True)
class Study:
    """What was simulated, and how each method did.

    Attributes:
        setup: what was simulated.
        seed: of all random numbers.
        n_runs: sessions for each number of spots.
        errors: for each number of spots, each method.
    """

    setup: StudySetup
    seed: int
    n_runs: int
    errors: tuple[MethodErrors, ...]

    def of(self, method: Method, n_spots: int) -> MethodErrors:
        """The errors of a method with `n_spots` at each tilt."""
        return next(one for one in self.errors if (one.method, one.n_spots) == (method, n_spots))


def run_study(
    methods: Sequence[Method],
    *,
    n_runs: int,
    seed: int,
    n_spots: Sequence[int] = PAPER_N_SPOTS,
    setup: StudySetup | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Simulate sessions and calibrate each by every method.

    Args:
        methods: to compare, on the same sessions.
        n_runs: sessions for each number of spots.
        seed: session r with n spots is drawn from (seed, n, r).
        n_spots: spots at each tilt.
        setup: what is simulated.
        progress: called after each session with the number done and the number in all.
    """
    setup = setup or StudySetup()
    errors: list[MethodErrors] = []
    for step, n in enumerate(n_spots):
        runs: list[tuple[Accuracy | None, ...]] = []
        for run in range(n_runs):
            runs.append(run_once(methods, setup, n_spots=n, run=run, seed=seed))
            if progress is not None:
                progress(step * n_runs + run + 1, n_runs * len(n_spots))
        errors += [gathered(method, n, [row[k] for row in runs]) for k, method in enumerate(methods)]
    return Study(setup, seed, n_runs, tuple(errors))


def run_once(
    methods: Sequence[Method], setup: StudySetup, *, n_spots: int, run: int, seed: int
) -> tuple[Accuracy | None, ...]:
    """One session by every method; None where a method refuses."""
    data = simulate(setup, n_spots=n_spots, run=run, seed=seed)
    out: list[Accuracy | None] = []
    for method in methods:
        try:
            scanner = calibrated(method, data, rng=np.random.default_rng((seed, n_spots, run)))
        except SpotcalError:
            out.append(None)
        else:
            out.append(accuracy(scanner, data.scene))
    return tuple(out)


def simulate(setup: StudySetup, *, n_spots: int, run: int, seed: int) -> StudyData:
    """Session `run` with `n_spots` at each of the paper's tilts."""
    rng = np.random.default_rng((seed, n_spots, run))
    scene = paper_scene(rng=rng, n_spots_per_tilt=n_spots, n_room_cameras=setup.n_room_cameras)
    return StudyData.of(scene, sample(scene, rng=rng, noise=setup.noise))


def calibrated(method: Method, data: StudyData, *, rng: np.random.Generator) -> TiltingScanner:
    """The scanner in the left camera's frame, by one method.

    Raises:
        SpotcalError: as `calibrate_paper`, `calibrate_screw` and `calibrate_lrfs`.
    """
    if method is Method.JOINT:
        return calibrate_lrfs(data.network, data.spots, data.settings, rng=rng).refined.scanners[0]
    lrf = LrfData.of(data.spots, data.settings, data.network.views, InstrumentSigma())
    samples, _ = plane_samples(data.network, lrf, np.arange(len(data.settings.angle_rad)))
    calibrate = calibrate_paper if method is Method.PAPER else calibrate_screw
    return calibrate(samples, rng=rng).scanner


def accuracy(
    scanner: TiltingScanner, scene: LrfScene, *, tilts_deg: Sequence[float] = PROBE_TILTS_DEG, n_probes: int = N_PROBES
) -> Accuracy:
    """Errors of a scanner at probes on the true scan planes in view of the stereo pair, the same ones every time."""
    rng, truth = np.random.default_rng(0), scene.scanner
    tilts = np.radians(np.asarray(tilts_deg, dtype=np.float64))
    px, space = np.empty((2, len(tilts), n_probes))
    for t, tilt in enumerate(tilts.tolist()):
        probes = spots_on_plane(scene.cameras, truth, tilt, n_probes, room=scene.room, rng=rng)
        range_m, bearing_rad, _ = truth.measure(probes, tilt)
        found = scanner.points_in_world(range_m, bearing_rad, tilt)
        px[t] = _distance_px(scene, probes, found)
        space[t] = np.linalg.norm(found - probes, axis=1)
    expected, estimated = truth.world_from_lrf_at(tilts), scanner.world_from_lrf_at(tilts)
    return Accuracy(
        px=px,
        space_m=space,
        rotation_rad=(expected.rotation.inv() * estimated.rotation).magnitude(),
        translation_m=np.linalg.norm(estimated.translation - expected.translation, axis=1),
    )


def gathered(method: Method, n_spots: int, runs: Sequence[Accuracy | None]) -> MethodErrors:
    """The runs of one method as arrays."""
    done = [one for one in runs if one is not None]
    if not done:
        shape = (0, len(PROBE_TILTS_DEG), N_PROBES)
        empty = np.empty(shape), np.empty(shape), np.empty(shape[:2]), np.empty(shape[:2])
        return MethodErrors(method, n_spots, *empty, n_refused=len(runs))
    return MethodErrors(
        method,
        n_spots,
        px=np.stack([one.px for one in done]),
        space_m=np.stack([one.space_m for one in done]),
        rotation_rad=np.stack([one.rotation_rad for one in done]),
        translation_m=np.stack([one.translation_m for one in done]),
        n_refused=len(runs) - len(done),
    )


def _distance_px(scene: LrfScene, expected: FloatArray, found: FloatArray) -> FloatArray:
    """(P,) distances in the left image of points (P, 3)."""
    left = np.zeros(len(expected), dtype=np.int64)
    diagonal = float(np.hypot(*scene.cameras.size_px[0]))
    true_px, _ = scene.cameras.img_from_world(left, expected)
    px, is_valid = scene.cameras.img_from_world(left, found)
    distance = np.linalg.norm(px - true_px, axis=1)
    return np.where(is_valid, np.minimum(distance, diagonal), diagonal)
