"""Driver of a Hokuyo scanner: SCIP 2.0 over USB or RS-232, SCIP 2.2 over TCP.

A scan's time is the sensor's own stamp, put into this machine's clock by `clock_fit.py`, from when scans arrive and
from what the sensor tells of its clock before it scans (`scip_time.py`). Nothing with a wrong checksum is believed, and
every scan that is missing is counted.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from network_calib.errors import InputError
from network_calib.observations import IntArray
from nodes.devices.clock_fit import GAIN_SIGMA, ClockFit, ClockLine
from nodes.devices.errors import DeviceError
from nodes.devices.scip_frames import RawScan, Reply, decode_scan, decode_stamp
from nodes.devices.scip_info import ScannerInfo, read_info
from nodes.devices.scip_line import ScipLine
from nodes.devices.scip_modes import ScanMode
from nodes.devices.scip_status import LASER_FAULT, LASER_OFF, SAME_SPEED, STATUS_DATA, STATUS_OK, status_words
from nodes.devices.scip_time import STAMP_S, SensorTime, exchange_times, time_bounds
from nodes.devices.transport import Transport

BAUD, TCP_PORT = 115200, 10940
# A stream that is silent for so many turns has stopped, and is asked for again.
SILENT_TURNS = 8
MAX_RESTARTS = 5
# A scan is sent when its turn is over, or when its last step is: so far a guess, until the sensor's clock teaches it.
LATENCY_SIGMA_TURNS = 0.15
# A resonator's drift follows its warmth by so much at most from one start to the next.
WARMTH_GAIN = 1e-4
RESYNC_FIRST_S = 4.0
# The sensor's stamps are cut to whole milliseconds.
CUT_SIGMA_S = STAMP_S / math.sqrt(12)


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan.

    Attributes:
        sequence: number of the scan by the sensor's clock, from 0; a gap means scans that were not read.
        device_s: the sensor's clock at step 0, wraps undone.
        stamp_s: this machine's clock at step 0, from all that is known of the sensor's so far.
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
        resyncs: how often the stream was left to ask for the sensor's clock.
        laser_faults: stops of the laser that the sensor told of.
    """

    scans: int = 0
    missed: int = 0
    refused: int = 0
    restarts: int = 0
    resyncs: int = 0
    laser_faults: int = 0


class Scip:
    """A scanner on an open line.

    Args:
        transport: the line.
        clock: this machine's clock, s.
        mode: what every beam tells.
        stamp_sigma_s: where arrivals scatter so much that stamps are less certain than this after some seconds, the
            stream is left for one or two to ask for the sensor's clock again, first after RESYNC_FIRST_S and then after
            ever longer times. Infinite: never.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        clock: Callable[[], float] = time.monotonic,
        mode: ScanMode = ScanMode.DISTANCES,
        stamp_sigma_s: float = 1e-3,
    ) -> None:
        self._line, self._clock = ScipLine(transport, clock), clock
        self._mode, self._stamp_sigma_s = mode, stamp_sigma_s
        self._info: ScannerInfo | None = None
        self._request: str | None = None
        self._time, self._fit = SensorTime(), ClockFit()
        self._before: ClockLine | None = None
        self._last: Scan | None = None
        # A sensor that was switched off counts from 0 again: only stamps of one run tell turns.
        self._is_same_run = False
        self._sequence, self._counts, self._n_bad_before = -1, ScanCounts(), 0
        self._heard_s = 0.0
        self._n_silent = 0
        self._resync_s, self._resync_wait_s = math.inf, RESYNC_FIRST_S

    @property
    def info(self) -> ScannerInfo:
        """As read by `start` or `identify`."""
        if self._info is None:
            raise DeviceError(f"{self._line.name}: the scanner was not started")
        return self._info

    @property
    def counts(self) -> ScanCounts:
        """So far."""
        return replace(self._counts, refused=self._counts.refused + self._n_bad_before + self._line.n_bad)

    @property
    def clock_gain(self) -> float | None:
        """Sensor seconds per second of this machine; None before the first scan."""
        return 1 / self._fit.line().gain if self._fit.is_known else None

    def start(self) -> ScannerInfo:
        """Bring the scanner into SCIP 2, read what it is and its clock, let it scan.

        Raises:
            DeviceError: no answer, no scanner's answers, or a fault that it tells of.
            LineLostError: it is gone.
        """
        info = self.identify()
        self._learn_clock()
        self._stream()
        return info

    def identify(self) -> ScannerInfo:
        """Read what the scanner is; its laser is off afterwards.

        Raises:
            DeviceError: no answer, or no scanner's answers.
            LineLostError: it is gone.
        """
        self._request = None
        self._line.quiet()
        self._line.to_scip2()
        self._info = read_info(self._line)
        return self._info

    def resume(self, transport: Transport) -> ScannerInfo:
        """Go on with the same scanner on a line that was opened anew; counts and sequence numbers continue.

        Raises:
            DeviceError: as `start`.
            LineLostError: as `start`.
        """
        self._n_bad_before += self._line.n_bad
        self._line = ScipLine(transport, self._clock)
        return self.start()

    def set_speed(self, baud: int) -> None:
        """Set the speed of the scanner's RS-232 side and of the line; nothing streams afterwards.

        Raises:
            InputError: no speed of six digits.
            DeviceError: the scanner refuses it, in words.
            LineLostError: it is gone.
        """
        if not 0 < baud < 1_000_000:
            raise InputError(f"speed of {baud} baud", advice="URG scanners know 19200, 57600, 115200, 250000 and more.")
        self._request = None
        self._line.quiet()
        command = f"SS{baud:06d}"
        # The answer comes at the old speed.
        status = self._line.command(command).status
        if status not in (STATUS_OK, SAME_SPEED):
            raise DeviceError(f"{self._line.name}: the scanner refuses {baud} baud, {status_words(command, status)}")
        self._line.transport.set_baud(baud)

    def sensor_clock_ms(self) -> int:
        """The sensor's clock now, modulo 2**24 ms; the laser is off afterwards.

        Raises:
            DeviceError: it does not answer.
        """
        self._line.command("TM0")
        try:
            return decode_stamp(self._line.command("TM1").lines[0])
        except IndexError:
            raise DeviceError(f"{self._line.name}: the scanner's clock came without a number") from None
        finally:
            self._line.command("TM2")

    def read(self, timeout_s: float) -> list[Scan]:
        """The scans that have come; waits for bytes at most so long. A stream that stopped is asked for again.

        Raises:
            DeviceError: the laser failed, or the stream does not come back.
            LineLostError: the scanner is gone.
        """
        replies = self._line.read(timeout_s)
        arrival_s = self._clock()
        scans = [scan for reply in replies if (scan := self._streamed(reply, arrival_s)) is not None]
        if scans:
            self._heard_s, self._n_silent = arrival_s, 0
            if arrival_s > self._resync_s and scans[-1].sigma_s > self._stamp_sigma_s:
                self.synchronise()
        elif self._request is not None and arrival_s - self._heard_s > SILENT_TURNS * self.info.steps.turn_s:
            self._restart()
        return scans

    def scan_once(self) -> Scan:
        """The latest scan, by a single request; a stream is stopped for it and the laser stays on.

        Raises:
            DeviceError: no answer, a refusal in words, or a scan that is none.
            LineLostError: it is gone.
        """
        if self._info is None:
            self.identify()
        if self._request is not None or not self._is_same_run:
            self._request = None
            self._line.quiet()
            self._learn_clock()
            self._laser_on()
        request = self._mode.single_request(self.info.steps)
        reply = self._line.command(request)
        if reply.status == LASER_OFF:
            self._laser_on()
            reply = self._line.command(request)
        if reply.status != STATUS_OK:
            raise DeviceError(f"{self._line.name}: no scan, {status_words(request, reply.status)}")
        return self._placed(self._decoded(reply), self._clock())

    def synchronise(self) -> None:
        """Ask for the sensor's clock again; takes a second or two, of which no scans are read.

        Raises:
            DeviceError: the scanner does not come back.
            LineLostError: it is gone.
        """
        self._resync_wait_s *= 2
        self._counts = replace(self._counts, resyncs=self._counts.resyncs + 1)
        self._line.command("QT")
        self._ask_clock()
        self._stream()

    def stop(self) -> None:
        """Laser off."""
        self._request = None
        self._line.quiet()

    def _streamed(self, reply: Reply, arrival_s: float) -> Scan | None:
        """The scan in a reply to the stream's request; None for anything else."""
        # A streamed scan repeats the request but for its last two digits, which count down.
        if self._request is None or reply.echo[:-2] != self._request[:-2] or reply.status == STATUS_OK:
            return None
        if reply.status.isdigit() and reply.status != STATUS_DATA:
            self._fault(reply.status)
            return None
        try:
            if reply.status != STATUS_DATA:
                raise DeviceError(f"a scan of status {reply.status}")
            return self._placed(self._decoded(reply), arrival_s)
        except DeviceError:
            self._counts = replace(self._counts, refused=self._counts.refused + 1)
            return None

    def _decoded(self, reply: Reply) -> RawScan:
        mode, n_beams = self._mode, self.info.steps.n_measured
        return decode_scan(reply, n_characters=mode.n_characters, n_beams=n_beams, with_intensity=mode.has_intensity)

    def _placed(self, raw: RawScan, arrival_s: float) -> Scan:
        """The scan with its time and number."""
        turn_s, last = self.info.steps.turn_s, self._last
        device_s = self._time.seconds(raw.stamp_ms)
        self._fit.add(device_s, arrival_s)
        line = self._fit.line()
        stamp_s = line.host_s(device_s + STAMP_S / 2)
        n_turns = 1
        if last is not None:
            past_s = device_s - last.device_s if self._is_same_run else stamp_s - last.stamp_s
            n_turns = max(round(past_s / turn_s), 1)
        self._is_same_run = True
        self._sequence += n_turns
        counts = self._counts
        self._counts = replace(counts, scans=counts.scans + 1, missed=counts.missed + n_turns - 1)
        sigma_s = math.hypot(line.sigma_s(device_s), CUT_SIGMA_S)
        self._last = Scan(self._sequence, device_s, stamp_s, sigma_s, arrival_s, raw.readings_mm, raw.intensity)
        return self._last

    def _fault(self, status: str) -> None:
        self._counts = replace(self._counts, laser_faults=self._counts.laser_faults + 1)
        if 50 <= int(status) <= 97:
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
        self._line.quiet()
        self._line.to_scip2()
        self._learn_clock()
        self._stream()

    def _learn_clock(self) -> None:
        """Begin the fit anew: the sensor may have been switched off and on, and counts from 0 then."""
        turn_s = self.info.steps.turn_s
        if self._fit.is_known:
            self._before = self._fit.line()
        self._fit = _fit_like(self._before, turn_s)
        self._time, self._is_same_run = SensorTime(), False
        self._resync_wait_s = RESYNC_FIRST_S
        self._ask_clock()

    def _ask_clock(self) -> None:
        turn_s = self.info.steps.turn_s
        exchanges = exchange_times(self._line, self._time, clock=self._clock, turn_s=turn_s)
        if exchanges:
            for bounds in time_bounds(exchanges, turn_s):
                self._fit.bound(bounds)
        self._resync_s = self._clock() + self._resync_wait_s if exchanges else math.inf

    def _laser_on(self) -> None:
        if self._line.command("BM").status == LASER_FAULT:
            raise DeviceError(
                f"{self._line.name}: the laser does not come on", advice="Is its supply strong enough (5 V, 0.8 A)?"
            )

    def _stream(self) -> None:
        self._laser_on()
        request = self._mode.stream_request(self.info.steps)
        status = self._line.command(request).status
        if status != STATUS_OK:
            raise DeviceError(
                f"{self._line.name}: the scanner refuses to scan: {request}, {status_words(request, status)}"
            )
        self._request, self._heard_s = request, self._clock()


def _fit_like(before: ClockLine | None, turn_s: float) -> ClockFit:
    """A fit that knows the drift and latency of one before, or what can be known of any scanner."""
    if before is None:
        return ClockFit(latency_s=turn_s, latency_sigma_s=LATENCY_SIGMA_TURNS * turn_s, resolution_s=STAMP_S)
    return ClockFit(
        latency_s=before.latency_s,
        latency_sigma_s=before.latency_sigma_s,
        gain=before.gain,
        gain_sigma=min(math.hypot(float(before.covariance[1, 1]) ** 0.5, WARMTH_GAIN), GAIN_SIGMA),
        resolution_s=STAMP_S,
    )
