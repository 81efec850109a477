"""Times and peak memory, so that two programs are compared under the same conditions."""

from __future__ import annotations

import multiprocessing
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Self, TypeVar

import numpy as np

T = TypeVar("T")
ROOT = Path(__file__).resolve().parents[1]
# What the console script `spotcal` runs; works whether or not the script is installed beside this interpreter.
SPOTCAL = (sys.executable, "-c", "from nodes.cli import main; main()")


@dataclass(frozen=True, slots=True)
class Timed(Generic[T]):
    """Wall times of several runs, and what the last one returned."""

    all_s: tuple[float, ...]
    value: T

    @property
    def seconds(self) -> float:
        """The median."""
        return float(np.median(self.all_s))


def timed(run: Callable[[], T], *, repeats: int = 1) -> Timed[T]:
    """Run something several times."""
    all_s, values = [], []
    for _ in range(repeats):
        begin = time.perf_counter()
        values.append(run())
        all_s.append(time.perf_counter() - begin)
    return Timed(tuple(all_s), values[-1])


def interleaved(runs: Sequence[Callable[[], T]], *, repeats: int) -> list[Timed[T]]:
    """Run several things in turn, A B A B, so that a slow moment of the machine hits all of them.

    Each run returns what it made; a first round that is not counted fills caches and imports what is imported late.
    """
    rounds = [[timed(run) for run in runs] for _ in range(repeats + 1)][1:]
    return [Timed(tuple(one[k].seconds for one in rounds), rounds[-1][k].value) for k in range(len(runs))]


@dataclass(frozen=True, slots=True)
class CommandTime:
    """Medians over runs of a command: from its start to its end, and what it took of the processors."""

    wall_s: float
    cpu_s: float


def command_time(arguments: Sequence[str], *, repeats: int) -> CommandTime:
    """Time `spotcal` with arguments, the start of the process included.

    Raises:
        CalledProcessError: the command failed.
    """

    def run() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*SPOTCAL, *arguments], cwd=ROOT, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    runs = [timed(run) for _ in range(repeats)]
    return CommandTime(float(np.median([one.seconds for one in runs])), float(np.median([one.value for one in runs])))


class MemoryPeak:
    """The peak of this process's resident memory within a `with` block.

    The kernel's `VmHWM` is reset on entry. `getrusage` would not do: its peak survives an exec, so that a child never
    shows less than its parent had.
    """

    before_mb = peak_mb = 0.0

    def __enter__(self) -> Self:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        self.before_mb = _status_mb("VmRSS")
        return self

    def __exit__(self, *_: object) -> None:
        self.peak_mb = _status_mb("VmHWM")

    @property
    def added_mb(self) -> float:
        return self.peak_mb - self.before_mb


def in_child(function: Callable[..., T], *arguments: object) -> T:
    """Call a module-level function in a fresh process, whose memory is its own."""
    pool = multiprocessing.get_context("spawn").Pool(1)
    try:
        return pool.apply(function, arguments)
    finally:
        # To the end of the process by itself: a pool's `with` would kill it, and libraries complain of that.
        pool.close()
        pool.join()


def _status_mb(field: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(field)) / 1024
