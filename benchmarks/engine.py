"""The joint engine against pycolmap's bundle adjustment: same problem, same start, same optimum; time and memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.engine_colmap import solve_colmap
from benchmarks.engine_problem import Scene, Solved, memory_of, ring, solve_ours
from benchmarks.measure import in_child
from benchmarks.report import Row, Run, at_most

# Two costs that agree to four digits.
SAME_COST = 1e-4
# COLMAP on one core, as the engine, and on all of them, its default: the faster counts.
COLMAP_THREADS = (1, -1)


def measure(run: Run) -> Iterator[Row]:
    """Few and many cameras, complete and with gaps."""
    for n_cameras, n_points, time_reach in ((5, run.pick(2000, 500), 2.0), (20, run.pick(5000, 500), 1.0)):
        for missing in (0.0, 0.3):
            what = f"{n_cameras} cameras × {n_points} spots" + (f", {missing:.0%} missing" if missing else "")
            yield from _times(what, ring(n_cameras, n_points, missing), time_reach, run)
            yield from _memory(what, n_cameras, n_points, missing)


def _times(what: str, scene: Scene, reach: float, run: Run) -> Iterator[Row]:
    rounds = [
        (solve_ours(scene), *(solve_colmap(scene, n_threads) for n_threads in COLMAP_THREADS))
        for _ in range(run.pick(5, 1))
    ]
    ours, *theirs = ([one[k] for one in rounds] for k in range(1 + len(COLMAP_THREADS)))
    peer = min(theirs, key=_median_s)
    difference = abs(ours[-1].cost / peer[-1].cost - 1)
    costs = f"cost {ours[-1].cost:.6g} / {peer[-1].cost:.6g}"
    yield Row(f"{what}: same optimum, engine / pycolmap", costs, "4 digits", difference < SAME_COST)
    note = (
        f"{_median_s(ours):.3f} s, {ours[-1].n_iterations} steps / "
        f"{_median_s(peer):.3f} s, {peer[-1].n_iterations} steps"
    )
    yield at_most(f"{what}: time, engine / pycolmap", _median_s(ours) / _median_s(peer), reach, note=note)


def _median_s(solved: list[Solved]) -> float:
    return float(np.median([one.seconds for one in solved]))


def _memory(what: str, n_cameras: int, n_points: int, missing: float) -> Iterator[Row]:
    """The peak of the process, libraries and all, is what a machine must have; beside it the part of the problem."""
    (our_mb, our_peak_mb), (their_mb, their_peak_mb) = (
        in_child(memory_of, solve, n_cameras, n_points, missing) for solve in (solve_ours, _solve_colmap_one_core)
    )
    note = f"{our_peak_mb:.0f} MB / {their_peak_mb:.0f} MB"
    yield at_most(f"{what}: peak memory of the process, engine / pycolmap", our_peak_mb / their_peak_mb, 1.0, note=note)
    part = f"{our_mb / their_mb:.3g} ({our_mb:.0f} MB / {their_mb:.0f} MB)"
    yield Row(f"{what}: of that added by posing and solving the problem, engine / pycolmap", part)


def _solve_colmap_one_core(scene: Scene) -> Solved:
    return solve_colmap(scene, 1)
