"""How long a person waits for `--help`."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.measure import command_seconds
from benchmarks.report import Row, Run, at_most


def measure(run: Run) -> Iterator[Row]:
    """Wall time of `spotcal --help`."""
    yield at_most("`spotcal --help`, wall time", command_seconds(["--help"], repeats=run.pick(5, 3)), 1.0, unit=" s")
