"""`spotcal lrf acquire`: the paper's acquisition on real or emulated instruments, recorded, with its crossings."""

from __future__ import annotations

import select
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

from network_calib.errors import InputError
from nodes.devices import scip
from nodes.devices.tilt_unit import NullTiltUnit
from nodes.devices.transport import Transport, open_transport
from nodes.lrf.acquired_tables import write_acquired
from nodes.lrf.acquisition import AcquisitionOptions, Progress
from nodes.lrf.monitor import MonitorAddresses, open_tilt_and_imu
from nodes.lrf.recorder import JsonlRecorder
from nodes.lrf_node import Acquired, LrfDevices, LrfNode


@dataclass(frozen=True, slots=True)
class AcquirePlan:
    """What is acquired, and how it is called.

    Attributes:
        name: of the LRF in the tables.
        tilts_deg: angles.
        n_crossings: at every tilt, at least.
        out: folder of recording and tables.
    """

    name: str
    tilts_deg: tuple[float, ...]
    n_crossings: int
    out: Path


def parse_tilts(text: str) -> tuple[float, ...]:
    """Angles in degrees from "12.1,23.2,50".

    Raises:
        InputError: one is no number within a right angle.
    """
    out = []
    for part in text.split(","):
        try:
            value = float(part)
        except ValueError:
            value = np.nan
        if not abs(value) <= 90:
            raise InputError(f"--tilts {text}: {part!r} is no angle of -90 to 90 degrees", advice="As in 12.1,23.2,50")
        out.append(value)
    return tuple(out)


def acquire(addresses: MonitorAddresses, plan: AcquirePlan, *, console: Console) -> Acquired:
    """Acquire all tilts unattended, but for the person with the spot, and write recording and tables.

    Raises:
        InputError: neither tilt unit nor IMU, or a folder that holds a recording.
        DeviceError: an instrument cannot be opened, or fails for good.
    """
    if addresses.tilt_unit is None and addresses.imu is None:
        raise InputError("no --tilt-unit and no --imu: nothing would tell the tilt angles")
    options = AcquisitionOptions(tuple(np.radians(plan.tilts_deg)), n_crossings=plan.n_crossings)
    epoch_s = time.time() - time.monotonic()

    def clock() -> float:
        # Wall time that does not jump while this runs: the cameras' stamps are wall time too.
        return time.monotonic() + epoch_s

    def open_scanner() -> Transport:
        return open_transport(addresses.scanner, baud=scip.BAUD, default_port=scip.TCP_PORT)

    with ExitStack() as stack:
        scanner = scip.Scip(stack.enter_context(open_scanner()), clock=clock)
        scanner.start()
        unit, imu = open_tilt_and_imu(addresses, stack, clock=clock)
        tilt = unit or NullTiltUnit()
        recorder = stack.enter_context(JsonlRecorder(plan.out))
        live = stack.enter_context(Live(console=console, refresh_per_second=4, transient=True))
        node = LrfNode(
            LrfDevices(scanner, tilt, imu, open_scanner),
            options,
            recorder=recorder,
            clock=clock,
            is_confirmed=_is_enter_pressed if sys.stdin.isatty() else None,
        )
        acquired = node.run(lambda progress: live.update(_told(progress)))
        scanner.stop()
    write_acquired(plan.out, plan.name, acquired)
    return acquired


def _is_enter_pressed() -> bool:
    """Whether there is a line to read; it is taken away."""
    is_there = bool(select.select([sys.stdin], [], [], 0)[0])
    if is_there:
        sys.stdin.readline()
    return is_there


def _told(progress: Progress) -> Text:
    sigma = f"; plane to {1e3 * progress.sigma_m:.1f} mm" if np.isfinite(progress.sigma_m) else ""
    return Text(f"tilt {progress.setting + 1} of {progress.n_settings}: {progress.message}{sigma}")
