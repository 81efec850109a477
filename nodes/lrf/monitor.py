"""`spotcal lrf monitor`: what scanner, tilt unit and IMU say, live."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from lrf_stereo.scan_spot import ranges_m
from lrf_stereo.scanner import ScanSteps
from network_calib.observations import FloatArray
from nodes.devices import mti, scip, tilt_unit
from nodes.devices.transport import open_transport
from nodes.report.tables import plain_table

BARS = " ▁▂▃▄▅▆▇█"
WIDTH = 72
READ_S = 0.1


@dataclass(frozen=True, slots=True)
class MonitorAddresses:
    """Where the instruments are; None: there is none."""

    scanner: str
    tilt_unit: str | None = None
    imu: str | None = None


def monitor(
    addresses: MonitorAddresses,
    *,
    duration_s: float | None,
    console: Console,
    clock: Callable[[], float] = time.monotonic,
) -> scip.ScanCounts:
    """Show until the time is over or somebody interrupts; the counts of the scanner.

    Raises:
        DeviceError: an instrument cannot be opened or fails.
    """
    with ExitStack() as stack:
        line = stack.enter_context(open_transport(addresses.scanner, baud=scip.BAUD, default_port=scip.TCP_PORT))
        scanner = scip.Scip(line)
        scanner.start()
        unit, imu = open_tilt_and_imu(addresses, stack)
        end_s = None if duration_s is None else clock() + duration_s
        state = _State()
        with Live(console=console, refresh_per_second=5, transient=False) as live:
            while end_s is None or clock() < end_s:
                state.take(scanner.read(READ_S), imu.read(0.0))
                if unit is not None and state.is_time_for_tilt(clock()):
                    state.tilt_deg = float(np.degrees(unit.tilt_rad_of(unit.steps())))
                live.update(_view(state, scanner, imu, has_imu=addresses.imu is not None))
        scanner.stop()
        return scanner.counts


@dataclass(slots=True)
class _State:
    """What was seen last."""

    scan: scip.Scan | None = None
    sample: mti.ImuSample | None = None
    tilt_deg: float | None = None
    tilt_asked_s: float = -np.inf

    def take(self, scans: list[scip.Scan], samples: list[mti.ImuSample]) -> None:
        self.scan = scans[-1] if scans else self.scan
        self.sample = samples[-1] if samples else self.sample

    def is_time_for_tilt(self, now_s: float) -> bool:
        """Once a second: every question costs a reply's time."""
        if now_s < self.tilt_asked_s + 1.0:
            return False
        self.tilt_asked_s = now_s
        return True


def open_tilt_and_imu(
    addresses: MonitorAddresses, stack: ExitStack, *, clock: Callable[[], float] = time.monotonic
) -> tuple[tilt_unit.TiltUnit | None, mti.Imu]:
    """Tilt unit and IMU, started; the stack closes their lines. None, and an IMU that gives nothing, where absent.

    Raises:
        DeviceError: one cannot be opened or does not answer.
    """
    unit: tilt_unit.TiltUnit | None = None
    imu: mti.Imu = mti.NullImu()
    if addresses.tilt_unit is not None:
        line = open_transport(addresses.tilt_unit, baud=tilt_unit.BAUD, default_port=tilt_unit.TCP_PORT)
        unit = tilt_unit.TiltUnit(stack.enter_context(line), clock=clock)
        unit.start()
    if addresses.imu is not None:
        imu = mti.Mti(stack.enter_context(open_transport(addresses.imu, baud=mti.BAUD)), clock=clock)
        imu.start()
    return unit, imu


def _view(state: _State, scanner: scip.Scip, imu: mti.Imu, *, has_imu: bool) -> Group:
    info, counts = scanner.info, scanner.counts
    table = plain_table(f"{info.product}, serial {info.serial}", "what")
    table.add_column("value")
    if state.scan is None:
        table.add_row("scan", "none yet")
        return Group(table)
    range_m = ranges_m(state.scan.readings_mm, steps=info.steps)
    gain = scanner.clock_gain
    table.add_row("scan", f"{state.scan.sequence}, {np.isfinite(range_m).sum()} of {len(range_m)} beams with a range")
    table.add_row("lost", f"{counts.missed} scans; {counts.refused} replies refused, {counts.restarts} restarts")
    if gain is not None:
        drift = f"{1e6 * (gain - 1):+.0f} ppm; stamps ± {1e3 * state.scan.sigma_s:.1f} ms"
        table.add_row("clock", drift)
    if state.tilt_deg is not None:
        table.add_row("tilt", f"{state.tilt_deg:.2f}°")
    if has_imu:
        _imu_rows(table, state.sample, imu.counts)
    return Group(table, Text(scan_bars(range_m, info.steps)))


def _imu_rows(table: Table, sample: mti.ImuSample | None, counts: mti.ImuCounts) -> None:
    if sample is not None:
        rate = ", ".join(f"{value:+.2f}" for value in np.degrees(sample.rate_rad_s))
        force = ", ".join(f"{value:+.2f}" for value in sample.acceleration_m_s2)
        table.add_row("turn", f"{rate} °/s")
        table.add_row("force", f"{force} m/s²")
    table.add_row("IMU lost", f"{counts.missed} samples; {counts.bad_sums + counts.refused} frames refused")


def scan_bars(range_m: FloatArray, steps: ScanSteps) -> str:
    """A scan (B,) as bars from left to right, taller the farther; a gap where no beam has a range."""
    # The first beam looks to the right.
    parts = np.array_split(range_m[::-1], WIDTH)
    nearest = np.array([np.nanmin(part) if np.isfinite(part).any() else np.nan for part in parts])
    farthest = np.nanmax(nearest, initial=0.0) if np.isfinite(nearest).any() else 1.0
    level = np.ceil(np.nan_to_num(nearest / farthest) * (len(BARS) - 1)).astype(int)
    left, right = np.degrees(steps.bearings_rad[[-1, 0]])
    bars = "".join(BARS[k] for k in level)
    ends = f"{left:+.0f}°".ljust(WIDTH // 2) + f"{right:+.0f}°".rjust(WIDTH - WIDTH // 2)
    return f"{bars}\n{ends}\nnearest range of each part; the tallest bar is {farthest:.2f} m"
