"""The paper's acquisition in real time, by the commands that a user would give, on emulated instruments.

`emulate` runs in a process of its own; `lrf acquire` talks to its ports, unattended; what the cameras of the same room
saw is joined to it by `lrf join`, and `calibrate` solves cameras and LRF together. The result is held against the
truth.
"""

from __future__ import annotations

import multiprocessing
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import StringIO
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console

from benchmarks.measure import SPOTCAL
from benchmarks.report import Row, Run, at_most
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.study import PROBE_TILTS_DEG, accuracy
from lrf_stereo.synthetic import PAPER_TILTS_DEG
from lrf_stereo.tilt import ARCSEC_RAD
from network_calib.formats.calibration_json import load
from network_calib.result import CalibratedLrf
from nodes.emulate import TILT_AXIS, emulated_devices, run_emulators

SEED = 0
START_S, STOP_S = 30.0, 120.0
LONGEST_S = 1800.0


@dataclass(frozen=True, slots=True)
class Step:
    """A command that was run: its exit status, its time, and what it said."""

    status: int
    took_s: float
    said: str


def measure(run: Run) -> Iterator[Row]:
    """All rows."""
    n_crossings = run.pick(22, 10)
    with TemporaryDirectory() as name:
        folder = Path(name)
        with _emulated(folder):
            ports = [folder / "ports" / each for each in ("urg", "ptu", "mti")]
            acquired = _spotcal(
                *("lrf", "acquire", ports[0], "--tilt-unit", ports[1], "--imu", ports[2], "--crossings", n_crossings),
                *("--tilts", ",".join(f"{tilt:g}" for tilt in PAPER_TILTS_DEG), "--out", folder / "lrf"),
            )
        yield _row(f"acquisition, N = {n_crossings} at three tilts, real time, unattended", acquired)
        session = folder / "session"
        joined = _spotcal("lrf", "join", folder / "lrf", "--session", session)
        yield _row("crossings joined to the cameras' frames", joined)
        calibrated = _spotcal(
            *("calibrate", session, "--config", session / "room.toml", "--out", folder / "out.json", "--quiet")
        )
        yield _row("cameras and LRF calibrated", calibrated)
        if calibrated.status == 0:
            yield from _error_rows(folder / "out.json")


def _error_rows(path: Path) -> Iterator[Row]:
    """Points of the LRF in the left image against the truth, at every tilt of the probes."""
    (lrf,) = load(path).lrfs
    scene = emulated_devices(seed=SEED).platform.scene
    errors = accuracy(_scanner(lrf), scene)
    note = f"{lrf.n_inliers} of {lrf.n_sightings} crossings used"
    for tilt_deg, px, space_m in zip(PROBE_TILTS_DEG, errors.px, errors.space_m, strict=True):
        what = f"LRF points in the left image at {tilt_deg:g}°: median error"
        yield at_most(what, float(np.median(px)), 0.5, unit=" px", note=f"{1e3 * np.median(space_m):.1f} mm; {note}")


def _scanner(lrf: CalibratedLrf) -> TiltingScanner:
    # Users give reported tilts, from which the load stays behind by half the play of the gear.
    lag_rad = TILT_AXIS.play / 2 * TILT_AXIS.arcsec_per_step * ARCSEC_RAD
    gain, bias_m, scale, zero_rad, offset_s = lrf.instrument.tolist()
    return TiltingScanner(
        lrf.world_from_lrf,
        lrf.axis_direction_in_world,
        lrf.axis_point_in_world,
        lrf.reference_tilt_rad - lag_rad,
        gain,
        bias_m,
        scale,
        zero_rad,
        offset_s,
    )


@contextmanager
def _emulated(folder: Path) -> Iterator[None]:
    """Instruments on ports below a folder, in another process; at the end the cameras' session is there."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    process = context.Process(target=_emulate, args=(folder, stop), daemon=True)
    process.start()
    try:
        end_s = time.monotonic() + START_S
        while not (folder / "ports" / "mti").is_symlink():
            if not process.is_alive() or time.monotonic() > end_s:
                raise RuntimeError("the emulated instruments did not start")
            time.sleep(0.1)
        yield
        stop.set()
        process.join(STOP_S)
    finally:
        process.kill()
        process.join()


def _emulate(folder: Path, stop: Event) -> None:
    def wait(_server: object) -> None:
        stop.wait()

    console = Console(file=StringIO())
    run_emulators(
        *("platform", folder / "ports"),
        is_tcp=False,
        is_newer=False,
        seed=SEED,
        console=console,
        session=folder / "session",
        wait=wait,
    )


def _spotcal(*arguments: object) -> Step:
    begin_s = time.perf_counter()
    done = subprocess.run(
        [*SPOTCAL, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST_S,
        stdin=subprocess.DEVNULL,
    )
    return Step(done.returncode, time.perf_counter() - begin_s, " ".join((done.stdout + done.stderr).split()))


def _row(what: str, step: Step) -> Row:
    return Row(what, f"{step.took_s:.0f} s; {step.said or 'no complaint'}", "exit status 0", step.status == 0)
