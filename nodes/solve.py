"""One calibration run with its progress on the terminal."""

from __future__ import annotations

import os
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from network_calib.calibrate import calibrate
from network_calib.errors import InputError
from network_calib.result import Calibration
from nodes.config import Resolved


def solve(resolved: Resolved, *, seed: int, input_name: str, input_sha256: str, console: Console) -> Calibration:
    """Calibrate, with a progress bar on the console that vanishes at the end.

    Raises:
        SpotcalError: the input does not determine the answer, or the solve failed.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=console.quiet) as bar:
        task = bar.add_task("starting", total=1.0)

        def report(step: str, fraction: float) -> None:
            bar.update(task, description=step, completed=fraction)

        return calibrate(
            resolved.observations,
            resolved.setups,
            anchor=resolved.anchor,
            options=resolved.options,
            seed=seed,
            input_name=input_name,
            input_sha256=input_sha256,
            progress=report,
        )


def check_writable(path: Path) -> None:
    """Refuse, before a long solve, a result file that cannot be written after it.

    Raises:
        InputError: the path is a folder, or lies where the user may not write.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder, expected a file name for the result")
    parent = path.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise InputError(f"{path} cannot be written: {parent} is no folder that you may write to")
