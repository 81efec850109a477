"""The LRF node without the bus: reads scanner, tilt unit and IMU, lets the acquisition decide, records everything.

One thread reads all devices in turn, also while the tilt unit moves: every scan and every sample is recorded as it
came. A device that is unplugged is waited for and opened again; what was lost meanwhile is counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from network_calib.errors import InputError
from nodes.devices.errors import DeviceError, LineLostError
from nodes.devices.mti import Imu, ImuCounts, NullImu
from nodes.devices.scip import ScanCounts, Scip
from nodes.devices.tilt_unit import NullTiltUnit, TiltDrive, TiltUnit
from nodes.devices.transport import Transport
from nodes.lrf.acquisition import Acquisition, AcquisitionOptions, Phase, Progress, SettingData
from nodes.lrf.hand_tilt import HandTilt
from nodes.lrf.imu_log import ImuLog
from nodes.lrf.recorder import NullRecorder, Recorder
from nodes.lrf.tilt_of_session import SessionTilts, StepCounts, session_tilts

READ_S = 0.05
REOPEN_FIRST_S, REOPEN_LONGEST_S = 0.5, 10.0


@dataclass(frozen=True, slots=True)
class LrfDevices:
    """The instruments of one platform, started.

    Attributes:
        scanner: the scanner.
        tilt: what tilts it; a NullTiltUnit where somebody does so by hand.
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


class LrfNode:
    """Runs one acquisition.

    Args:
        devices: started.
        options: what to acquire.
        recorder: keeps everything.
        clock: this machine's clock, s.
        sleep: waits; a simulation lets its own time run.
        axis_in_imu: (3,) the tilt axis in the IMU's axes.
        is_confirmed: of an LRF that is tilted by hand: whether the operator has just said that it stands.

    Raises:
        InputError: it is tilted by hand, and neither an IMU nor anybody tells when it stands.
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
        is_confirmed: Callable[[], bool] | None = None,
    ) -> None:
        self._devices, self._options = devices, options
        self._recorder = recorder or NullRecorder()
        self._clock, self._sleep = clock, sleep
        self._axis_in_imu = np.array(axis_in_imu)
        self.acquisition = Acquisition(options, steps=devices.scanner.info.steps)
        self._imu_log = ImuLog()
        self._hand: HandTilt | None = None
        self._is_confirmed = is_confirmed or (lambda: False)
        if isinstance(devices.tilt, NullTiltUnit):
            if isinstance(devices.imu, NullImu) and is_confirmed is None:
                raise InputError("no tilt unit, no IMU and nobody to ask: nothing tells when the LRF stands")
            self._hand = HandTilt(axis_in_imu=self._axis_in_imu)
        self._steps: list[int | None] = []
        self._n_reopened = 0
        # After a bump it need not be turned any further.
        self._is_resettling = False

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
            if now is Phase.MOVING and self._hand is None:
                self._move()
            else:
                self._pump(READ_S)
            if self._hand is not None:
                self._look_at_hand(self._hand)
            if on_progress is not None:
                on_progress(self._progress())
        self._recorder.event(self._clock(), str(Phase.DONE))
        return self._acquired()

    def _move(self) -> None:
        tilt_rad = self.acquisition.next_tilt_rad
        steps = self._devices.tilt.go_to(tilt_rad, meanwhile=lambda: self._pump(0.0))
        self._steps.append(steps)
        self._recorder.tilt(self._clock(), tilt_rad, steps)
        self.acquisition.moved(self._clock())

    def _look_at_hand(self, hand: HandTilt) -> None:
        """Go on when the person has tilted the LRF and let go; begin the tilt anew when it was bumped."""
        acquisition = self.acquisition
        if acquisition.phase not in (Phase.MOVING, Phase.DONE) and hand.is_bumped:
            turned_deg = float(np.degrees(hand.turned_rad))
            self._recorder.event(self._clock(), f"the LRF was turned by {turned_deg:.1f} deg: this tilt begins anew")
            acquisition.begin_anew()
            self._is_resettling = True
        if acquisition.phase is not Phase.MOVING:
            return
        target_rad, is_first = acquisition.next_tilt_rad, not acquisition.settings
        is_still_again = self._is_resettling and hand.still_since_s is not None
        if is_still_again or hand.has_arrived(target_rad, is_first=is_first) or self._is_confirmed():
            now_s = self._clock()
            if hand.left_s is not None and not self._is_resettling:
                acquisition.left_rest(hand.left_s)
            self._steps.append(None)
            self._recorder.tilt(now_s, target_rad, None)
            acquisition.moved(now_s if hand.still_since_s is None else hand.still_since_s)
            self._is_resettling = False
            hand.begin()

    def _progress(self) -> Progress:
        progress, hand = self.acquisition.progress(), self._hand
        if hand is None or progress.phase is not Phase.MOVING:
            return progress
        tilt_rad = hand.tilt_rad
        stands = "" if tilt_rad is None else f" (it stands at {np.degrees(tilt_rad):.1f})"
        target_deg = np.degrees(self.acquisition.next_tilt_rad)
        return replace(progress, message=f"tilt the LRF to about {target_deg:.1f} deg{stands}, then let go")

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
            if self._hand is not None:
                self._hand.add(sample)

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
