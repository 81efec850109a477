"""`python -m benchmarks [NAME ...] [--quick] [--out FOLDER]`: run benchmarks, print and write one table."""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.report import Row, Run, markdown_table
from network_calib.errors import SpotcalError

NAMES = (
    "recordings",
    "against_colmap_sfm",
    "engine",
    "statistics",
    "growth",
    "lrf_accuracy",
    "lrf_projection",
    "lrf_instruments",
    "lrf_acquisition",
    "hand_tilt",
    "spot_detector",
    "spot_profile",
    "detect_end_to_end",
    "rtsp_4k",
    "bus_latency",
    "bus_load",
    "projection_service",
    "projection_stream",
    "faults",
    "startup",
)


def main() -> int:
    """Run the named benchmarks; the exit status is that of the machinery, not of the figures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--quick", action="store_true", help="few seeds and small sizes: does everything work?")
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="folder for bench.md and plots")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in NAMES]
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(NAMES)}")
    run = Run(arguments.quick, arguments.out)
    run.out.mkdir(parents=True, exist_ok=True)
    sections = [_section(name, run) for name in arguments.names or NAMES]
    text = "\n".join([f"# Measured {_conditions(run)}", "", *sections])
    (run.out / "bench.md").write_text(text, encoding="utf-8")
    print(f"\n{text}")
    return 0


def _section(name: str, run: Run) -> str:
    begin = time.perf_counter()
    rows: list[Row] = []
    for row in _measured(name, run):
        rows.append(row)
        print(f"{name}: {row.what}: {row.measured} [{row.reach}] {row.verdict}", flush=True)
    return f"## {name} ({time.perf_counter() - begin:.0f} s)\n\n{markdown_table(rows)}"


def _measured(name: str, run: Run) -> Iterator[Row]:
    """The rows of a benchmark; a refusal to calibrate is one of them, and the next benchmark goes on."""
    try:
        yield from importlib.import_module(f"benchmarks.{name}").measure(run)
    except SpotcalError as error:
        yield Row(f"{name} stopped", error.message, "no refusal", False)


def _conditions(run: Run) -> str:
    kind = "quick" if run.is_quick else "full"
    return f"({kind}; {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()})"


if __name__ == "__main__":
    sys.exit(main())
