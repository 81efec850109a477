"""How long a person waits for `--help`."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.measure import command_time
from benchmarks.report import Row, Run, at_most


def measure(run: Run) -> Iterator[Row]:
    """Wall time of `spotcal --help`."""
    took = command_time(["--help"], repeats=run.pick(5, 3))
    yield at_most("`spotcal --help`, wall time", took.wall_s, 1.0, unit=" s", note=f"CPU {took.cpu_s:.2f} s")
