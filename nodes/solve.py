"""One calibration run: cameras, cameras with LRFs, or LRFs added to cameras."""

from __future__ import annotations

import os
from hashlib import sha256
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from lrf_stereo.network import add_lrfs, calibrate_with_lrfs
from lrf_stereo.session import LrfSession
from network_calib.calibrate import InputId, calibrate
from network_calib.errors import InputError
from network_calib.formats.calibration_json import load
from network_calib.formats.recording import Recording
from network_calib.result import Calibration
from nodes.config import Resolved
from nodes.lrf.session import joint_digest
from nodes.matching import observations_of


def solve(
    resolved: Resolved,
    *,
    seed: int,
    input_name: str,
    input_sha256: str,
    console: Console,
    lrfs: LrfSession | None = None,
) -> Calibration:
    """Calibrate, with the LRFs if there are any, with a progress bar on the console that vanishes at the end.

    Raises:
        SpotcalError: the input does not determine the answer, or the solve failed.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=console.quiet) as bar:
        task = bar.add_task("starting", total=1.0)

        def report(step: str, fraction: float) -> None:
            bar.update(task, description=step, completed=fraction)

        if lrfs is None:
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
        return calibrate_with_lrfs(
            resolved.observations,
            resolved.setups,
            lrfs,
            anchor=resolved.anchor,
            options=resolved.options,
            seed=seed,
            source=InputId(input_name, joint_digest(input_sha256, lrfs)),
            progress=report,
        )


def solve_lrfs(cameras: Path, recording: Recording, lrfs: LrfSession, *, rejection: float, seed: int) -> Calibration:
    """Add LRFs to the cameras of a calibration.json, which are held.

    Raises:
        SpotcalError: the files do not fit together, or the sightings do not determine the LRFs.
    """
    calibration = load(cameras)
    observations, _ = observations_of(calibration, recording)
    digest = joint_digest(recording.sha256, lrfs)
    # The result rests on both: the spots that the cameras were calibrated from, and these.
    source = InputId(recording.name, sha256(f"{calibration.provenance.input_sha256}\n{digest}".encode()).hexdigest())
    return add_lrfs(calibration, observations, lrfs, rejection=rejection, seed=seed, source=source)


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
