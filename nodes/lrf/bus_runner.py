"""The loop of an LRF node on the bus: reads its instruments all the time, and acquires when it is told to.

Commands come from a thread of the bus and only leave a note; the loop heeds it between two readings.
"""

from __future__ import annotations

import math
import time
from typing import Protocol

from network_calib.errors import SpotcalError
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.host_temperature import temperature_c
from nodes.bus.keys import Verb
from nodes.devices.errors import DeviceError, LineLostError
from nodes.lrf.acquisition import Phase, Progress
from nodes.lrf.bus_acquisition import BusAcquisition, EndedError, Surroundings
from nodes.lrf.bus_recorder import BusRecorder
from nodes.lrf.tilt_plan import TiltPlan, plan_of
from nodes.lrf_node import READ_S, REOPEN_FIRST_S, REOPEN_LONGEST_S, LrfDevices
from nodes.site.model import LrfDeviceConfig

IDLE, WATCHING, MOVING, COLLECTING, FAULT = "waiting", "watching", "moving", "collecting", "fault"
_STATES = {
    Phase.MOVING: MOVING,
    Phase.RESTING: MOVING,
    Phase.BACKGROUND: COLLECTING,
    Phase.COLLECTING: COLLECTING,
    Phase.DONE: WATCHING,
}


class HasSession(Protocol):
    """The part of `nodes.bus.node.BusNode` that is used here."""

    @property
    def session(self) -> str: ...


class LrfRunner:
    """Runs one LRF.

    Args:
        config: of the LRF.
        devices: started.
        bus: tells the session.
        recorder: puts things onto the bus.
        around: what an acquisition needs; its `stop` ends `run`.
    """

    def __init__(
        self,
        config: LrfDeviceConfig,
        devices: LrfDevices,
        bus: HasSession,
        recorder: BusRecorder,
        around: Surroundings,
    ) -> None:
        self._config, self._devices, self._bus = config, devices, bus
        self._recorder, self._around = recorder, around
        self._plan: TiltPlan | None = None
        self._acquisition: BusAcquisition | None = None
        self._begun = ""
        self._n_crossings = 0
        self._trouble = self._failure = ""

    def run(self) -> None:
        """Until told to stop.

        Raises:
            DeviceError: an instrument failed for good.
        """
        while not self._around.stop.is_set():
            self._begin_session_if_new()
            plan = self._plan
            if plan is not None and plan.session == self._bus.session:
                self._acquire(plan)
            else:
                self._pump()

    def command(self, verb: Verb, command: pb.Command) -> pb.Reply:
        """See `nodes.bus.command_desk`."""
        match verb:
            case Verb.START | Verb.STOP:
                self._plan, self._trouble = None, ""
                if (acquisition := self._acquisition) is not None:
                    acquisition.end()
            case Verb.TILTS:
                return self._tilts(command)
            case Verb.NEXT if (acquisition := self._acquisition) is not None:
                acquisition.next()
            case Verb.NEXT:
                return pb.Reply(code="FAILED", message="there is nothing to finish: no tilt is being acquired")
            case _:
                return pb.Reply(code="UNSUPPORTED", message=f"an LRF node knows no {verb}")
        return pb.Reply(code="OK")

    def status(self) -> pb.NodeStatus:
        """What the node says of itself."""
        acquisition, heat_c = self._acquisition, temperature_c()
        progress = None if acquisition is None else acquisition.progress
        out = pb.NodeStatus(
            state=self._state(progress),
            message=self._failure or self._trouble or ("" if progress is None else progress.message),
            rate_hz=self._recorder.rate.rate_hz(time.monotonic()),
            n_frames=self._recorder.n_scans,
            n_detections=self._n_crossings if acquisition is None else acquisition.n_crossings,
            n_dropped=self._devices.scanner.counts.missed,
            temperature_c=heat_c or 0.0,
            has_temperature=heat_c is not None,
        )
        if progress is not None:
            out.setting, out.n_settings, out.n_crossings = progress.setting, progress.n_settings, progress.n_crossings
            out.plane_sigma_m = progress.sigma_m if math.isfinite(progress.sigma_m) else 0.0
        return out

    def fail(self, error: DeviceError) -> None:
        """Tell of an instrument that failed for good."""
        self._failure = error.message

    def _tilts(self, command: pb.Command) -> pb.Reply:
        session = self._bus.session
        if not session:
            return pb.Reply(code="FAILED", message="no session is running: start one first")
        if self._plan is not None:
            return pb.Reply(code="OK", message="the tilts are under way")
        self._plan, self._trouble = plan_of(command, self._config, session), ""
        return pb.Reply(code="OK")

    def _begin_session_if_new(self) -> None:
        session = self._bus.session
        if session != self._begun:
            self._begun, self._n_crossings = session, 0
            if session:
                self._recorder.begin_session(self._around.clock(), self._devices.scanner.info)

    def _acquire(self, plan: TiltPlan) -> None:
        acquisition = BusAcquisition(plan, self._config, self._devices, self._recorder, self._around)
        self._acquisition, self._recorder.is_sparse = acquisition, False
        try:
            acquisition.run()
        except EndedError:
            self._recorder.event(self._around.clock(), "the acquisition was ended before it was done")
        except DeviceError:
            raise
        except SpotcalError as error:
            self._trouble = error.message
            self._recorder.event(self._around.clock(), error.message)
        finally:
            self._n_crossings = acquisition.n_crossings
            self._acquisition, self._recorder.is_sparse = None, True
            # Another one may have been asked for meanwhile.
            self._plan = None if self._plan is plan else self._plan

    def _pump(self) -> None:
        """Take what the devices sent."""
        try:
            scans = self._devices.scanner.read(READ_S)
        except LineLostError as error:
            self._reopen(error)
            return
        for scan in scans:
            self._recorder.scan(scan)
        for sample in self._devices.imu.read(0.0):
            self._recorder.imu(sample)

    def _reopen(self, error: LineLostError) -> None:
        """Wait for the scanner to come back, longer each time."""
        if self._devices.reopen_scanner is None:
            raise error
        self._trouble, wait_s = error.message, REOPEN_FIRST_S
        self._recorder.event(self._around.clock(), error.message)
        while not self._around.stop.is_set():
            self._around.wait(wait_s)
            try:
                self._devices.scanner.resume(self._devices.reopen_scanner())
            except DeviceError:
                wait_s = min(2 * wait_s, REOPEN_LONGEST_S)
                continue
            self._trouble = ""
            self._recorder.event(self._around.clock(), "the scanner is back")
            return

    def _state(self, progress: Progress | None) -> str:
        if self._failure:
            return FAULT
        if not self._bus.session:
            return IDLE
        return WATCHING if progress is None else _STATES[progress.phase]
