"""The same spots solved by spotcal and by COLMAP's structure from motion, in turn: left-out error, cameras, time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from benchmarks.colmap_sfm import SfmModel, structure_from_motion
from benchmarks.left_out import even_frames, left_out_error
from benchmarks.measure import interleaved
from benchmarks.report import Row, Run, at_most
from benchmarks.rooms import ABSENT, NAMES, random_generator, recording_folder, setups_of, solve_once
from network_calib.calibrate import calibrate
from network_calib.formats.svoboda import read_svoboda
from network_calib.observations import Observations
from network_calib.optimum import Network
from network_calib.room_setup import CameraSetup
from network_calib.synthetic import observe, room

# COLMAP's result depends on its seed; the best of these is taken for it.
COLMAP_SEEDS = (0, 1, 2)


@dataclass(frozen=True, slots=True)
class Scene:
    """Spots, cameras, and how much longer than COLMAP the solve may take.

    Attributes:
        name: for the table.
        observations: what is fitted, the even frames of it in the left-out test.
        judged: what the left-out test predicts and predicts from: without the detections that are known to be false.
        setups: of the cameras.
        time_reach: largest ratio of times.
    """

    name: str
    observations: Observations
    judged: Observations
    setups: Sequence[CameraSetup]
    time_reach: float


def measure(run: Run) -> Iterator[Row]:
    """Every recording, then the synthetic ring."""
    for name in NAMES:
        folder = recording_folder(name)
        if folder is None:
            yield Row(f"{name} against COLMAP", ABSENT)
            continue
        recording = read_svoboda(folder)
        # Neither side is given intrinsics that lie beside the recording.
        setups = [CameraSetup(setup.name, setup.size_px) for setup in recording.setups]
        yield from _compare(Scene(name, recording.observations, recording.observations, setups, 2.0), run)
    for missing, false_detections in ((0.0, 0.0), (0.3, 0.1)):
        yield from _compare(_ring(run, missing=missing, false_detections=false_detections), run)


def _ring(run: Run, *, missing: float, false_detections: float) -> Scene:
    n_cameras, n_frames = run.pick(20, 8), run.pick(5000, 600)
    truth = room("ring_room", rng=random_generator(20), n_frames=n_frames, n_cameras=n_cameras)
    seen = observe(truth, rng=random_generator(21), missing=missing, false_detections=false_detections)
    what = f"ring of {n_cameras} cameras × {n_frames} frames"
    if missing or false_detections:
        what += f", {missing:.0%} missing, {false_detections:.0%} false"
    return Scene(what, seen.observations, seen.observations.select(seen.is_usable), setups_of(truth), 1.0)


def _compare(scene: Scene, run: Run) -> Iterator[Row]:
    sizes = [setup.size_px for setup in scene.setups]

    def ours() -> Network | SfmModel:
        return solve_once(scene.observations, scene.setups)

    def theirs() -> Network | SfmModel:
        return structure_from_motion(scene.observations, sizes, seed=0)

    our, their = interleaved([ours, theirs], repeats=run.pick(5, 1))
    assert isinstance(their.value, SfmModel)
    n = len(scene.setups)
    note = f"{our.seconds:.3f} s / {their.seconds:.3f} s"
    yield at_most(
        f"{scene.name}: time of the solve / COLMAP SfM", our.seconds / their.seconds, scene.time_reach, note=note
    )
    yield Row(f"{scene.name}: cameras registered", f"{n} of {n} (COLMAP {their.value.n_registered})", f"{n}", True)
    yield _left_out(scene, sizes)


def _left_out(scene: Scene, sizes: Sequence[tuple[int, int]]) -> Row:
    """Both fit the even frames and are judged on the odd ones."""
    fitted = even_frames(scene.observations)
    our = left_out_error(calibrate(fitted, scene.setups).as_cameras(), scene.judged).median_px
    models = [structure_from_motion(fitted, sizes, seed=seed) for seed in COLMAP_SEEDS]
    errors = [left_out_error(m.cameras, scene.judged).median_px for m in models if m.cameras is not None]
    what = f"{scene.name}: left-out error, median / COLMAP's best of {len(COLMAP_SEEDS)} seeds"
    if not errors:
        return Row(what, f"{our:.3f} px; COLMAP registered every camera in no run", "< 1", True)
    note = f"{our:.3f} px / {', '.join(f'{error:.3f}' for error in errors)} px"
    return at_most(what, our / min(errors), 1.0, note=note)
