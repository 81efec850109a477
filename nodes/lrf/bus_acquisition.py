"""One acquisition of an LRF node on the bus: what is published while it runs, and how it is hurried or ended."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from network_calib.errors import InputError
from nodes.devices.mti import ImuSample
from nodes.devices.scip import Scan
from nodes.journal import Journal
from nodes.lrf.acquisition import AcquisitionOptions, Phase, Progress
from nodes.lrf.bus_recorder import BusRecorder
from nodes.lrf.journalled import joined_tilts, read_journalled
from nodes.lrf.tilt_of_session import SessionTilts
from nodes.lrf.tilt_plan import TiltPlan
from nodes.lrf_node import LrfDevices, LrfNode
from nodes.site.model import LrfDeviceConfig


class EndedError(Exception):
    """Out of an acquisition that was told to end."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What an acquisition needs beside the instruments.

    Attributes:
        journal: of the node; tells which tilts were finished before it was started again.
        stop: set when the process ends.
        clock: the devices' clock, s.
        wait: for so many seconds.
    """

    journal: Journal
    stop: threading.Event
    clock: Callable[[], float]
    wait: Callable[[float], object]


class BusAcquisition:
    """Acquires the tilts of a plan that the journal does not hold yet.

    Attributes:
        progress: for the person; settings are counted over the whole plan.
        n_crossings: of finished tilts.
    """

    def __init__(
        self,
        plan: TiltPlan,
        config: LrfDeviceConfig,
        devices: LrfDevices,
        recorder: BusRecorder,
        around: Surroundings,
    ) -> None:
        self._plan, self._config, self._devices = plan, config, devices
        self._recorder, self._around = recorder, around
        self._is_told_to_end = self._is_told_next = False
        self._node: LrfNode | None = None
        self._n_before = self._n_told = 0
        self.progress: Progress | None = None
        self.n_crossings = 0

    def end(self) -> None:
        """Stop as soon as the tilt unit rests; for any thread."""
        self._is_told_to_end = True

    def next(self) -> None:
        """Take what there is at this tilt as enough; of an LRF that is tilted by hand: it stands. For any thread.

        Raises:
            InputError: nothing is being collected.
        """
        phase = None if self._node is None else self._node.acquisition.phase
        is_by_hand = phase is Phase.MOVING and self._config.tilt_unit is None
        if phase is not Phase.COLLECTING and not is_by_hand:
            raise InputError(f"there is nothing to finish while {phase or 'no tilt is acquired'}")
        self._is_told_next = True

    def run(self) -> None:
        """Acquire, and publish the angles of all tilts.

        Raises:
            EndedError: told to end.
            SpotcalError: an instrument failed, or what was acquired tells no angles.
        """
        held = read_journalled(self._around.journal, self._plan.session)
        self._n_before = self._n_told = len(held.rests)
        self.n_crossings = held.n_crossings
        if held.is_complete:
            return
        left_rad = self._plan.tilts_rad[self._n_before :]
        acquired = self._acquire(left_rad) if left_rad else None
        self._recorder.tilts(self._around.clock(), self._all_tilts() if acquired is None else acquired)

    def _acquire(self, tilts_rad: tuple[float, ...]) -> SessionTilts | None:
        """The angles, where these are all tilts of the plan."""
        self._recorder.setting = self._n_before
        node = self._node = self._lrf_node(tilts_rad)
        try:
            acquired = node.run(self._on_progress)
        except InputError:
            # A single tilt by hand tells no angle by itself; with those of before it may.
            if not self._n_before or node.acquisition.phase is not Phase.DONE:
                raise
            return None
        return acquired.tilts if not self._n_before else None

    def _all_tilts(self) -> SessionTilts:
        whole = read_journalled(self._around.journal, self._plan.session)
        return joined_tilts(whole, tilt=self._devices.tilt, axis_in_imu=np.array(self._config.axis))

    def _lrf_node(self, tilts_rad: tuple[float, ...]) -> LrfNode:
        config, plan = self._config, self._plan
        options = AcquisitionOptions(
            tilts_rad,
            n_crossings=plan.n_crossings,
            sigma_m=1e-3 * config.plane_sigma_mm,
            max_crossings=max(config.max_crossings, plan.n_crossings),
            rest_s=config.rest_s,
            n_background=config.n_background,
            ball_diameter_m=1e-3 * config.ball_mm,
        )
        return LrfNode(
            self._devices,
            options,
            recorder=_EndableRecorder(self._recorder, self._around.stop),
            clock=self._around.clock,
            sleep=self._sleep,
            axis_in_imu=(config.axis[0], config.axis[1], config.axis[2]),
            is_confirmed=self._take_next,
        )

    def _on_progress(self, progress: Progress) -> None:
        self.progress = replace(
            progress, setting=self._n_before + progress.setting, n_settings=self._n_before + progress.n_settings
        )
        assert self._node is not None
        acquisition = self._node.acquisition
        if acquisition.phase is Phase.COLLECTING and self._take_next():
            try:
                acquisition.finish_setting(self._around.clock())
            except InputError as error:
                self._recorder.event(self._around.clock(), error.message)
        self._tell_finished(self._node)
        self._refuse_to_go_on()

    def _tell_finished(self, node: LrfNode) -> None:
        """Publish the crossings of tilts that have ended since."""
        for data in node.acquisition.settings[self._n_told - self._n_before :]:
            self._recorder.crossings(self._n_told, data)
            self.n_crossings += len(data.crossings)
            self._n_told += 1
            self._recorder.setting = self._n_told

    def _take_next(self) -> bool:
        is_told, self._is_told_next = self._is_told_next, False
        return is_told

    def _sleep(self, seconds: float) -> None:
        self._around.wait(seconds)
        self._refuse_to_go_on()

    def _refuse_to_go_on(self) -> None:
        if self._around.stop.is_set() or self._is_told_to_end:
            raise EndedError


class _EndableRecorder:
    """Hands on; and ends the acquisition even while the tilt unit moves when the process has to end."""

    def __init__(self, recorder: BusRecorder, stop: threading.Event) -> None:
        self._recorder, self._stop = recorder, stop

    def scan(self, scan: Scan) -> None:
        self._recorder.scan(scan)
        if self._stop.is_set():
            raise EndedError

    def imu(self, sample: ImuSample) -> None:
        self._recorder.imu(sample)

    def tilt(self, now_s: float, tilt_rad: float, steps: int | None) -> None:
        self._recorder.tilt(now_s, tilt_rad, steps)

    def event(self, now_s: float, text: str) -> None:
        self._recorder.event(now_s, text)
