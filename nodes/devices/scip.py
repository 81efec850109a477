"""Driver of a Hokuyo scanner: SCIP 2.0 over USB or RS-232, SCIP 2.2 over TCP.

A scan's time is the sensor's own stamp, put into this machine's clock by `clock_fit.py`; when it arrived is only a
hint. Nothing with a wrong checksum is believed, and every scan that is missing is counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from lrf_stereo.scanner import ScanSteps
from network_calib.observations import IntArray
from nodes.devices.clock_fit import ClockFit
from nodes.devices.errors import DeviceError
from nodes.devices.scip_frames import (
    STAMP_MODULUS_MS,
    STATUS_DATA,
    STATUS_OK,
    Reply,
    ReplyParser,
    decode_scan,
    decode_stamp,
)
from nodes.devices.transport import Transport

BAUD, TCP_PORT = 115200, 10940
# A command waits for the scan tick, and may find one scan more in the way.
REPLY_TIMEOUT_S = 1.0
ATTEMPTS = 3
# A stream that is silent for so many turns has stopped, and is asked for again.
SILENT_TURNS = 8
MAX_RESTARTS = 5
SETTLE_S = 0.15
LASER_FAULT = "01"


@dataclass(frozen=True, slots=True)
class ScannerInfo:
    """What the scanner says of itself.

    Attributes:
        product: name of the model.
        serial: serial number.
        firmware: version.
        protocol: such as "SCIP 2.0".
        steps: its steps, reach and speed.
        status: its own words on its health.
    """

    product: str
    serial: str
    firmware: str
    protocol: str
    steps: ScanSteps
    status: str


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan.

    Attributes:
        sequence: number of the scan by the sensor's clock, from 0; a gap means scans that were lost.
        device_s: the sensor's clock at step 0, wraps undone.
        stamp_s: this machine's clock at step 0, from the fit of all arrivals so far.
        sigma_s: standard deviation of `stamp_s`.
        arrival_s: this machine's clock when the scan had come.
        readings_mm: (B,) distances, or error codes below 20.
        intensity: (B,) strength of the echo, None unless asked for.
    """

    sequence: int
    device_s: float
    stamp_s: float
    sigma_s: float
    arrival_s: float
    readings_mm: IntArray
    intensity: IntArray | None


@dataclass(frozen=True, slots=True)
class ScanCounts:
    """What came since the driver was made.

    Attributes:
        scans: good ones.
        missed: scans that the sensor's clock shows to be lost.
        refused: replies with a wrong sum, or content that is none.
        restarts: how often a stream that had stopped was asked for again.
        laser_faults: stops of the laser that the sensor told of.
    """

    scans: int = 0
    missed: int = 0
    refused: int = 0
    restarts: int = 0
    laser_faults: int = 0


class Scip:
    """A scanner on an open line.

    Args:
        transport: the line.
        clock: this machine's clock, s.
        with_intensity: ask for the strength of echoes too; newer models only.
        latency_s: from a scan's stamp to its earliest arrival; None: one turn, as it is sent when it is whole.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        clock: Callable[[], float] = time.monotonic,
        with_intensity: bool = False,
        latency_s: float | None = None,
    ) -> None:
        self._line, self._clock = transport, clock
        self._with_intensity, self._latency_s = with_intensity, latency_s
        self._parser = ReplyParser()
        self._replies: list[Reply] = []
        self._info: ScannerInfo | None = None
        self._request = ""
        self._times, self._sequence = _SensorTime(), -1
        self._fit = ClockFit()
        self._counts = ScanCounts()
        self._heard_s = 0.0
        self._n_silent = 0
        self._last_stamp_s: float | None = None

    @property
    def info(self) -> ScannerInfo:
        """As read by `start`."""
        if self._info is None:
            raise DeviceError(f"{self._line.name}: the scanner was not started")
        return self._info

    @property
    def counts(self) -> ScanCounts:
        """So far."""
        return replace(self._counts, refused=self._counts.refused + self._parser.n_bad)

    @property
    def clock_gain(self) -> float | None:
        """Sensor seconds per second of this machine; None before the first scan."""
        return 1 / self._fit.line().gain if self._counts.scans else None

    def start(self) -> ScannerInfo:
        """Bring the scanner into SCIP 2, read what it is, let it scan.

        Raises:
            DeviceError: no answer, no scanner's answers, or a fault that it tells of.
            LineLostError: it is gone.
        """
        info = self.identify()
        self._stream()
        return info

    def identify(self) -> ScannerInfo:
        """Read what the scanner is; its laser is off afterwards.

        Raises:
            DeviceError: no answer, or no scanner's answers.
            LineLostError: it is gone.
        """
        self._quiet()
        self._to_scip2()
        version, parameters, state = self._parameters("VV"), self._parameters("PP"), self._parameters("II")
        steps = _steps(self._line.name, parameters)
        self._info = ScannerInfo(
            product=version.get("PROD", parameters.get("MODL", "unknown")),
            serial=version.get("SERI", "unknown"),
            firmware=version.get("FIRM", "unknown"),
            protocol=version.get("PROT", "unknown"),
            steps=steps,
            status=state.get("STAT", "unknown"),
        )
        return self._info

    def resume(self, transport: Transport) -> ScannerInfo:
        """Go on with the same scanner on a line that was opened anew; counts and sequence numbers continue.

        Raises:
            DeviceError: as `start`.
            LineLostError: as `start`.
        """
        self._line = transport
        return self.start()

    def sensor_clock_ms(self) -> int:
        """The sensor's clock now, modulo 2**24 ms; the laser is off afterwards.

        Raises:
            DeviceError: it does not answer.
        """
        self._command("TM0")
        try:
            return decode_stamp(self._command("TM1").lines[0])
        except IndexError:
            raise DeviceError(f"{self._line.name}: the scanner's clock came without a number") from None
        finally:
            self._command("TM2")

    def read(self, timeout_s: float) -> list[Scan]:
        """The scans that have come; waits for bytes at most so long. A stream that stopped is asked for again.

        Raises:
            DeviceError: the laser failed, or the stream does not come back.
            LineLostError: the scanner is gone.
        """
        replies, self._replies = self._replies, []
        replies += self._parser.feed(self._line.read(timeout_s))
        arrival_s = self._clock()
        scans = [scan for reply in replies if (scan := self._scan(reply, arrival_s)) is not None]
        if scans:
            self._heard_s, self._n_silent = arrival_s, 0
        elif arrival_s - self._heard_s > SILENT_TURNS * self.info.steps.turn_s:
            self._restart()
        return scans

    def stop(self) -> None:
        """Laser off."""
        self._quiet()

    def _scan(self, reply: Reply, arrival_s: float) -> Scan | None:
        """The scan in a reply to the stream's request; None for anything else."""
        # A streamed scan repeats the request but for its last two digits, which count down.
        if reply.echo[:-2] != self._request[:-2] or reply.status == STATUS_OK:
            return None
        if reply.status != STATUS_DATA:
            self._fault(reply.status)
            return None
        steps = self.info.steps
        try:
            raw = decode_scan(reply, n_characters=3, n_beams=steps.n_measured, with_intensity=self._with_intensity)
        except DeviceError:
            self._counts = replace(self._counts, refused=self._counts.refused + 1)
            return None
        device_s, n_turns = self._times.place(raw.stamp_ms, steps.turn_s)
        self._fit.add(device_s, arrival_s)
        line = self._fit.line()
        # The sensor cuts its clock to whole milliseconds.
        stamp_s = line.host_s(device_s + 5e-4)
        if n_turns is None and self._last_stamp_s is not None:
            n_turns = max(round((stamp_s - self._last_stamp_s) / steps.turn_s), 1)
        self._sequence += n_turns or 1
        n_missed, self._last_stamp_s = (n_turns or 1) - 1, stamp_s
        self._counts = replace(self._counts, scans=self._counts.scans + 1, missed=self._counts.missed + n_missed)
        sigma_s = line.sigma_s(device_s)
        return Scan(self._sequence, device_s, stamp_s, sigma_s, arrival_s, raw.readings_mm, raw.intensity)

    def _fault(self, status: str) -> None:
        self._counts = replace(self._counts, laser_faults=self._counts.laser_faults + 1)
        if status.isdigit() and 50 <= int(status) <= 97:
            raise DeviceError(
                f"{self._line.name}: the scanner reports a hardware fault, status {status}",
                advice="Switch it off and on; if that does not help, it needs service.",
            )

    def _restart(self) -> None:
        self._n_silent += 1
        if self._n_silent > MAX_RESTARTS:
            raise DeviceError(
                f"{self._line.name}: the scanner sends no scans, though it was asked {MAX_RESTARTS} times"
            )
        self._counts = replace(self._counts, restarts=self._counts.restarts + 1)
        self._quiet()
        self._to_scip2()
        self._stream()

    def _stream(self) -> None:
        laser = self._command("BM")
        if laser.status == LASER_FAULT:
            raise DeviceError(
                f"{self._line.name}: the laser does not come on", advice="Is its supply strong enough (5 V, 0.8 A)?"
            )
        steps = self.info.steps
        name = "ME" if self._with_intensity else "MD"
        self._request = f"{name}{steps.first_step:04d}{steps.last_step:04d}00000"
        status = self._command(self._request).status
        if status != STATUS_OK:
            raise DeviceError(f"{self._line.name}: the scanner refuses to scan ({self._request}: status {status})")
        # Whatever happened before, the sensor may have been switched off and on: its clock is learnt anew.
        self._fit = ClockFit(latency_s=steps.turn_s if self._latency_s is None else self._latency_s)
        self._times = _SensorTime()
        self._heard_s = self._clock()

    def _quiet(self) -> None:
        """Stop whatever it does, and throw away what is still on the way."""
        # The first LF ends a half command that somebody left.
        self._line.write(b"\nQT\n")
        end_s = self._clock() + REPLY_TIMEOUT_S
        while self._line.read(SETTLE_S) and self._clock() < end_s:
            pass
        self._parser.reset()
        self._replies.clear()

    def _to_scip2(self) -> None:
        """An URG-04LX wakes up in SCIP 1; one that is in SCIP 2 refuses this, which does no harm."""
        self._command("SCIP2.0", may_be_silent=True)
        self._replies.clear()

    def _parameters(self, name: str) -> dict[str, str]:
        """The lines `KEY:value;` of VV, PP or II."""
        pairs = (line.rstrip(";").partition(":") for line in self._command(name).lines)
        return {key: value for key, _, value in pairs}

    def _command(self, command: str, *, may_be_silent: bool = False) -> Reply:
        """The reply to a command; scans of a stream that is still running are passed over.

        Raises:
            DeviceError: none comes.
        """
        for _ in range(1 if may_be_silent else ATTEMPTS):
            self._line.write(f"{command}\n".encode("ascii"))
            end_s = self._clock() + REPLY_TIMEOUT_S
            while (left_s := end_s - self._clock()) > 0:
                replies = self._parser.feed(self._line.read(left_s))
                for k, reply in enumerate(replies):
                    if reply.echo == command and reply.status != STATUS_DATA:
                        self._replies = replies[k + 1 :]
                        return reply
        if may_be_silent:
            return Reply(command, "", ())
        raise DeviceError(
            f"{self._line.name}: no answer from the scanner to {command}",
            advice="Is this the scanner's port? On RS-232 its speed must be set first; USB and TCP have none.",
        )


class _SensorTime:
    """The sensor's clock without wraps, from stamps in ms modulo 2**24."""

    def __init__(self) -> None:
        self._last_ms: int | None = None
        self._device_ms = 0

    def place(self, stamp_ms: int, turn_s: float) -> tuple[float, int | None]:
        """Device time in s, and turns since the last stamp; None for the first."""
        turns = None
        if self._last_ms is None:
            self._device_ms = stamp_ms
        else:
            step_ms = (stamp_ms - self._last_ms) % STAMP_MODULUS_MS
            self._device_ms += step_ms
            turns = max(round(step_ms / (1e3 * turn_s)), 1)
        self._last_ms = stamp_ms
        return self._device_ms / 1e3, turns


def _steps(name: str, parameters: dict[str, str]) -> ScanSteps:
    try:
        value = {key: int(parameters[key]) for key in ("ARES", "AMIN", "AMAX", "AFRT", "SCAN", "DMIN", "DMAX")}
    except (KeyError, ValueError) as error:
        raise DeviceError(f"{name}: the scanner's parameters lack a number: {error}") from error
    is_sane = (
        0 < value["ARES"] <= 65536
        and 0 <= value["AMIN"] < value["AMAX"] < value["ARES"]
        and 0 < value["SCAN"] <= 60000
        and 0 < value["DMIN"] < value["DMAX"]
    )
    if not is_sane:
        raise DeviceError(f"{name}: the scanner's parameters make no sense: {value}")
    return ScanSteps(
        front_step=value["AFRT"],
        steps_per_turn=value["ARES"],
        first_step=value["AMIN"],
        last_step=value["AMAX"],
        range_min_m=value["DMIN"] / 1e3,
        range_max_m=value["DMAX"] / 1e3,
        turn_s=60 / value["SCAN"],
    )
