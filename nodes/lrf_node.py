"""The LRF node without the bus: reads scanner, tilt unit and IMU, lets the acquisition decide, records everything.

One thread reads all devices in turn, also while the tilt unit moves: every scan and every sample is recorded as it
came. A device that is unplugged is waited for and opened again; what was lost meanwhile is counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from nodes.devices.clock_fit import ClockFit
from nodes.devices.errors import DeviceError, LineLostError
from nodes.devices.mti import Imu, ImuCounts, ImuSample
from nodes.devices.scip import Scan, ScanCounts, Scip
from nodes.devices.tilt_unit import TiltDrive, TiltUnit
from nodes.devices.transport import Transport
from nodes.lrf.acquisition import Acquisition, AcquisitionOptions, Phase, Progress, SettingData
from nodes.lrf.tilt_of_session import ImuSeries, SessionTilts, StepCounts, session_tilts

READ_S = 0.05
REOPEN_FIRST_S, REOPEN_LONGEST_S = 0.5, 10.0


class Recorder(Protocol):
    """Keeps what the devices sent."""

    def scan(self, scan: Scan) -> None:
        """A scan, as it came."""
        ...

    def imu(self, sample: ImuSample) -> None:
        """A sample, as it came."""
        ...

    def tilt(self, now_s: float, tilt_rad: float, steps: int | None) -> None:
        """The tilt unit arrived."""
        ...

    def event(self, now_s: float, text: str) -> None:
        """Something happened: a phase, a loss, a return."""
        ...


class NullRecorder:
    """Keeps nothing."""

    def scan(self, scan: Scan) -> None:
        """See `Recorder`."""

    def imu(self, sample: ImuSample) -> None:
        """See `Recorder`."""

    def tilt(self, now_s: float, tilt_rad: float, steps: int | None) -> None:
        """See `Recorder`."""

    def event(self, now_s: float, text: str) -> None:
        """See `Recorder`."""


@dataclass(frozen=True, slots=True)
class LrfDevices:
    """The instruments of one platform, started.

    Attributes:
        scanner: the scanner.
        tilt: what tilts it.
        imu: what measures the tilt.
        reopen_scanner: opens the scanner's line again after it was lost; None: a loss is final.
    """

    scanner: Scip
    tilt: TiltDrive
    imu: Imu
    reopen_scanner: Callable[[], Transport] | None = None


@dataclass(frozen=True, slots=True)
class Acquired:
    """What an acquisition gave.

    Attributes:
        settings: crossings and rests, by tilt.
        tilts: the angles, with what they rest on.
        scan_counts: of the scanner.
        imu_counts: of the IMU.
        n_reopened: how often the scanner's line was opened again.
    """

    settings: tuple[SettingData, ...]
    tilts: SessionTilts
    scan_counts: ScanCounts
    imu_counts: ImuCounts
    n_reopened: int


@dataclass(slots=True)
class _ImuLog:
    """Samples with the clock that places them."""

    fit: ClockFit = field(default_factory=ClockFit)
    samples: list[ImuSample] = field(default_factory=list)

    def add(self, sample: ImuSample) -> None:
        self.fit.add(sample.device_s, sample.arrival_s)
        self.samples.append(sample)

    def series(self) -> ImuSeries | None:
        if not self.samples:
            return None
        # One line for all samples: an integral needs times that grow as the device's do.
        line = self.fit.line()
        device_s = np.array([sample.device_s for sample in self.samples])
        return ImuSeries(
            line.offset_s + line.gain * (device_s - line.reference_s),
            np.array([sample.rate_rad_s for sample in self.samples]),
            np.array([sample.acceleration_m_s2 for sample in self.samples]),
        )


class LrfNode:
    """Runs one acquisition.

    Args:
        devices: started.
        options: what to acquire.
        recorder: keeps everything.
        clock: this machine's clock, s.
        sleep: waits; a simulation lets its own time run.
        axis_in_imu: (3,) the tilt axis in the IMU's axes.
    """

    def __init__(
        self,
        devices: LrfDevices,
        options: AcquisitionOptions,
        *,
        recorder: Recorder | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        axis_in_imu: tuple[float, float, float] = (0.0, 1.0, 0.0),
    ) -> None:
        self._devices, self._options = devices, options
        self._recorder = recorder or NullRecorder()
        self._clock, self._sleep = clock, sleep
        self._axis_in_imu = np.array(axis_in_imu)
        self.acquisition = Acquisition(options, steps=devices.scanner.info.steps)
        self._imu_log = _ImuLog()
        self._steps: list[int | None] = []
        self._n_reopened = 0

    def run(self, on_progress: Callable[[Progress], None] | None = None) -> Acquired:
        """Acquire all tilts.

        Args:
            on_progress: told after every reading.

        Raises:
            DeviceError: a device failed for good.
        """
        phase = None
        while (now := self.acquisition.phase) is not Phase.DONE:
            if now is not phase:
                self._recorder.event(self._clock(), str(now))
                phase = now
            if now is Phase.MOVING:
                self._move()
            else:
                self._pump(READ_S)
            if on_progress is not None:
                on_progress(self.acquisition.progress())
        self._recorder.event(self._clock(), str(Phase.DONE))
        return self._acquired()

    def _move(self) -> None:
        tilt_rad = self.acquisition.next_tilt_rad
        steps = self._devices.tilt.go_to(tilt_rad, meanwhile=lambda: self._pump(0.0))
        self._steps.append(steps)
        self._recorder.tilt(self._clock(), tilt_rad, steps)
        self.acquisition.moved(self._clock())

    def _pump(self, timeout_s: float) -> None:
        """Take what the devices sent."""
        try:
            scans = self._devices.scanner.read(timeout_s)
        except LineLostError as error:
            self._recorder.event(self._clock(), error.message)
            self._reopen(error)
            return
        for scan in scans:
            self._recorder.scan(scan)
            self.acquisition.scan(scan.stamp_s, scan.readings_mm)
        self._pump_imu()

    def _pump_imu(self) -> None:
        for sample in self._devices.imu.read(0.0):
            self._recorder.imu(sample)
            self._imu_log.add(sample)

    def _reopen(self, error: LineLostError) -> None:
        """Wait for the scanner to come back, longer each time, while the other devices go on."""
        if self._devices.reopen_scanner is None:
            raise error
        wait_s = REOPEN_FIRST_S
        while True:
            self._sleep(wait_s)
            self._pump_imu()
            try:
                self._devices.scanner.resume(self._devices.reopen_scanner())
            except DeviceError:
                wait_s = min(2 * wait_s, REOPEN_LONGEST_S)
                continue
            self._n_reopened += 1
            self._recorder.event(self._clock(), "the scanner is back")
            return

    def _acquired(self) -> Acquired:
        settings, tilt = self.acquisition.settings, self._devices.tilt
        counted = [steps for steps in self._steps if steps is not None]
        steps = None
        if isinstance(tilt, TiltUnit) and len(counted) == len(settings):
            mounting = tilt.options
            steps = StepCounts(np.array(counted), tilt.info.arcsec_per_step, mounting.zero_steps, mounting.tilt_sign)
        tilts = session_tilts(
            [(setting.rest_begin_s, setting.rest_end_s) for setting in settings],
            steps=steps,
            imu=self._imu_log.series(),
            axis_in_imu=self._axis_in_imu,
        )
        scan_counts, imu_counts = self._devices.scanner.counts, self._devices.imu.counts
        return Acquired(settings, tilts, scan_counts, imu_counts, self._n_reopened)
