"""How time and memory grow with cameras (a chain of rooms) and with spots: exponents, a table, a plot."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.measure import MemoryPeak, in_child
from benchmarks.report import Row, Run
from benchmarks.rooms import baseline_of, random_generator, setups_of
from network_calib.calibrate import calibrate
from network_calib.errors import SpotcalError
from network_calib.synthetic import align_cameras, observe, room

FRAMES_PER_CAMERA = 250
# Names of steps that `calibrate` reports, by what they belong to; all others are the quality of the result.
SOLVE_STEPS = ("pairwise verification", "start by", "joint solve")


@dataclass(frozen=True, slots=True)
class Size:
    """A synthetic scene."""

    scene: str
    n_cameras: int
    n_frames: int


@dataclass(frozen=True, slots=True)
class Grown:
    """One calibration in a process of its own.

    Attributes:
        size: of the scene.
        n_observations: detections.
        solve_s: pairs, start and joint solve.
        total_s: the whole of `calibrate`, with hold-out, repeats and checks.
        added_mb: memory added by `calibrate`.
        peak_mb: of the process.
        centre_m: median error of the camera centres after a similarity.
        failure: the message where there is no calibration, else empty.
    """

    size: Size
    n_observations: int
    solve_s: float
    total_s: float
    added_mb: float
    peak_mb: float
    centre_m: float
    failure: str = ""


def measure(run: Run) -> Iterator[Row]:
    """A chain of 5 to 200 cameras, then 1,000 to 50,000 spots before the cameras of one room."""
    chain = (5, 10, 20) if run.is_quick else (5, 10, 20, 50, 100, 200)
    spots = (1000, 2000) if run.is_quick else (1000, 2000, 5000, 10_000, 20_000, 50_000)
    series = {
        "cameras": [Size("corridor_chain", n, n * FRAMES_PER_CAMERA) for n in chain],
        "spots": [Size("smart_room", 5, n) for n in spots],
    }
    grown = {axis: [] for axis in series}
    for axis, sizes in series.items():
        for size in sizes:
            one = in_child(calibrate_size, size)
            grown[axis].append(one)
            yield _size_row(one)
        yield from _exponents(axis, [one for one in grown[axis] if not one.failure])
    path = run.out / "growth.png"
    _plot(grown, str(path))
    yield Row("growth: plot", path.name)


def calibrate_size(size: Size) -> Grown:
    """Calibrate one scene; for a process of its own."""
    rng = random_generator(7, size.n_cameras, size.n_frames)
    truth = room(size.scene, rng=rng, n_frames=size.n_frames, n_cameras=size.n_cameras)
    observations = observe(truth, rng=rng).observations
    setups, anchor = setups_of(truth), baseline_of(truth)
    steps: list[tuple[str, float]] = []
    with MemoryPeak() as peak:
        begin = time.perf_counter()
        try:
            found = calibrate(
                observations,
                setups,
                anchor=anchor,
                progress=lambda step, _part: steps.append((step, time.perf_counter() - begin)),
            )
        except SpotcalError as error:
            nothing = float("nan")
            return Grown(size, len(observations), nothing, nothing, nothing, nothing, nothing, error.message)
        total_s = time.perf_counter() - begin
    solve_s = next((at for step, at in steps if not step.startswith(SOLVE_STEPS)), total_s)
    aligned, _ = align_cameras(found.as_cameras(), truth.cameras)
    error_m = np.linalg.norm(aligned.centres_in_world - truth.cameras.centres_in_world, axis=1)
    return Grown(
        size, len(observations), solve_s, total_s, peak.added_mb, peak.peak_mb, centre_m=float(np.median(error_m))
    )


def _size_row(one: Grown) -> Row:
    size = one.size
    what = f"{size.scene}: {size.n_cameras} cameras × {size.n_frames:,} spots, {one.n_observations:,} detections"
    if one.failure:
        return Row(what, f"no calibration: {one.failure}", "calibrates", False)
    figures = (
        f"solve {one.solve_s:.2f} s, whole `calibrate` {one.total_s:.1f} s, peak {one.peak_mb:.0f} MB "
        f"(+{one.added_mb:.0f}), centres {1e3 * one.centre_m:.1f} mm"
    )
    return Row(what, figures, "calibrates", True)


def _exponents(axis: str, grown: Sequence[Grown]) -> Iterator[Row]:
    if len(grown) < 2:
        return
    size = [_extent(axis, one) for one in grown]
    for name, values in (
        ("time of the solve", [one.solve_s for one in grown]),
        ("time of `calibrate`", [one.total_s for one in grown]),
        ("added memory", [one.added_mb for one in grown]),
    ):
        slope = np.polyfit(np.log(size), np.log(values), 1)[0]
        last = np.log(values[-1] / values[-2]) / np.log(size[-1] / size[-2])
        yield Row(f"{name} ∝ {axis}^n, {size[0]:,} to {size[-1]:,}", f"n = {slope:.2f} (last step {last:.2f})")


def _extent(axis: str, one: Grown) -> int:
    return one.size.n_cameras if axis == "cameras" else one.size.n_frames


def _plot(grown: dict[str, list[Grown]], path: str) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, rows = plt.subplots(2, 2, figsize=(10, 8), layout="constrained", squeeze=False)
    for column, (axis, all_sizes) in enumerate(grown.items()):
        done = [one for one in all_sizes if not one.failure]
        size = [_extent(axis, one) for one in done]
        label = f"{axis}, {FRAMES_PER_CAMERA} spots for each" if axis == "cameras" else f"{axis}, 5 cameras"
        times, memory = rows[0, column], rows[1, column]
        times.loglog(size, [one.total_s for one in done], "o-", label="whole calibrate")
        times.loglog(size, [one.solve_s for one in done], "s-", label="pairs, start, joint solve")
        times.set(xlabel=label, ylabel="time [s]")
        times.legend()
        memory.loglog(size, [one.peak_mb for one in done], "o-", label="process peak")
        memory.loglog(size, [one.added_mb for one in done], "s-", label="added by calibrate")
        memory.set(xlabel=label, ylabel="memory [MB]")
        memory.legend()
        for panel in (times, memory):
            panel.grid(which="both", alpha=0.3)
            panel.set_xticks(size, [f"{n:,}" for n in size])
            panel.set_xticks([], minor=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)
