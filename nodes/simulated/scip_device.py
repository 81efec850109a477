"""An emulated Hokuyo scanner: the states, texts and timing of the real one, ranges from whatever room it is given.

The mirror turns by true time; a scan is sent when its turn is over. A command is answered on the next tick of the
model, one command a tick, as the URG-04LX does. Stamps are the sensor's clock at step 0, cut to whole milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from network_calib.observations import IntArray
from nodes.devices.scip_frames import STAMP_MODULUS_MS, encode_blocks, encode_number, encode_numbers, line_sum
from nodes.simulated.scip_model import URG_04LX, ScipModel

SCANS, NEWER_SCANS = ("MD", "MS", "GD", "GS"), ("ME", "GE", "ND", "NE", "HD", "HE")
MAX_COMMAND_BYTES, MAX_STRING = 64, 16
NOT_MEASURABLE, FIRST_RANGE_MM = 19, 20
# Where the next beam sees so much further, part of this one's light does too.
EDGE_MM = 100
# Speeds that SCIP has a number for; a model need not have them all.
SCIP_SPEEDS = (19200, 38400, 57600, 115200, 250000, 500000, 750000)
# Readings (B,) of the model's measurable steps in mm or error codes, of the turn that begins at a time.
ScanAt = Callable[[float], IntArray]


@dataclass(frozen=True, slots=True)
class _Stream:
    """A running MD, MS, ME, ND or NE.

    Attributes:
        request: as it was sent, without its count.
        string: what follows a ';' in the command, with it.
        remaining: scans to come; None is endless.
        next_turn: number of the turn that is sent next.
    """

    request: str
    string: str
    remaining: int | None
    next_turn: int


class ScipDevice:
    """The emulator; see `Emulator`.

    Args:
        scan_at: the room as the scanner sees it.
        model: which scanner.
        laser_faults_at_s: times at which the laser fails: status 50 is sent and the stream ends.

    Attributes:
        speed: of its RS-232 side, baud, as last set; a pty and TCP have none, so that it changes nothing else.
    """

    def __init__(
        self, scan_at: ScanAt, *, model: ScipModel = URG_04LX, laser_faults_at_s: tuple[float, ...] = ()
    ) -> None:
        self._scan_at, self._model = scan_at, model
        self._laser_faults_at_s = sorted(laser_faults_at_s)
        self._is_scip1 = model.wakes_in_scip1
        self._is_laser_on = self._is_timing = False
        self.speed = self._first_speed()
        self._stream: _Stream | None = None
        self._begin_s = 0.0
        self._heard = ""
        self._commands: list[str] = []
        self._next_tick_s = math.inf
        self._out: list[tuple[float, bytes]] = []
        self._line_free_s = 0.0

    def connect(self, now_s: float) -> None:
        """Power on."""
        self._is_scip1 = self._model.wakes_in_scip1
        self._is_laser_on = self._is_timing = False
        self.speed = self._first_speed()
        self._stream, self._begin_s, self._line_free_s = None, now_s, now_s
        self._heard, self._commands, self._next_tick_s = "", [], math.inf
        self._out.clear()

    def disconnect(self, now_s: float) -> None:
        """Power off, or the network client went: the laser goes off."""
        self.connect(now_s)

    def receive(self, data: bytes, now_s: float) -> None:
        """Commands, each ended by LF, CR or both."""
        self._advance(now_s)
        for character in data.decode("latin-1"):
            if character in "\r\n":
                if self._heard:
                    self._queue(self._heard, now_s)
                self._heard = ""
            else:
                self._heard = (self._heard + character)[:MAX_COMMAND_BYTES]

    def send(self, now_s: float) -> bytes:
        """Replies and scans that have left by now."""
        self._advance(now_s)
        due = [data for due_s, data in self._out if due_s <= now_s]
        self._out = [(due_s, data) for due_s, data in self._out if due_s > now_s]
        return b"".join(due)

    def next_due_s(self) -> float:
        """When the next reply or scan has left."""
        first = self._out[0][0] if self._out else math.inf
        turn_s = self._turn_end_s(self._stream.next_turn) if self._stream else math.inf
        return min(first, self._next_tick_s, turn_s)

    def sensor_ms(self, time_s: float) -> int:
        """The sensor's clock at a true time."""
        return int(1e3 * self._model.clock_gain * (time_s - self._begin_s)) % STAMP_MODULUS_MS

    def turn_begin_s(self, turn: int) -> float:
        """True time of step 0 of a turn."""
        return self._begin_s + turn * self._model.steps.turn_s

    def _turn_end_s(self, turn: int) -> float:
        return self.turn_begin_s(turn + 1)

    def _queue(self, command: str, now_s: float) -> None:
        if len(self._commands) < 8:  # what its buffer holds; more are lost
            self._commands.append(command)
        if math.isinf(self._next_tick_s):
            self._next_tick_s = self._tick_after(now_s)

    def _tick_after(self, now_s: float) -> float:
        tick_s = self._model.reply_tick_s
        return self._begin_s + (math.floor((now_s - self._begin_s) / tick_s + 1e-9) + 1) * tick_s

    def _advance(self, now_s: float) -> None:
        """Everything that happens until now, in its order."""
        while True:
            turn_s = self._turn_end_s(self._stream.next_turn) if self._stream else math.inf
            if min(turn_s, self._next_tick_s) > now_s:
                return
            if turn_s <= self._next_tick_s:
                self._send_scan(turn_s)
            else:
                tick_s = self._next_tick_s
                self._obey(self._commands.pop(0), tick_s)
                self._next_tick_s = self._tick_after(tick_s) if self._commands else math.inf

    def _send_scan(self, at_s: float) -> None:
        assert self._stream is not None
        stream = self._stream
        if self._laser_faults_at_s and self._laser_faults_at_s[0] <= at_s:
            self._laser_faults_at_s.pop(0)
            self._stream, self._is_laser_on = None, False
            self._post(f"{stream.request}00{stream.string}\n{_summed('50')}\n\n", at_s)
            return
        remaining = None if stream.remaining is None else stream.remaining - 1
        text = self._scan_text(stream.request, stream.next_turn)
        self._post(f"{stream.request}{remaining or 0:02d}{stream.string}\n{_summed('99')}\n{text}\n", at_s)
        skipped = int(stream.request[12])
        if remaining == 0:
            self._stream, self._is_laser_on = None, False
        else:
            self._stream = _Stream(stream.request, stream.string, remaining, stream.next_turn + 1 + skipped)

    def _scan_text(self, request: str, turn: int) -> str:
        """Stamp and blocks of a turn, for a request with first and last step and cluster."""
        begin_s, model = self.turn_begin_s(turn), self._model
        readings = np.full(model.steps.steps_per_turn, NOT_MEASURABLE)
        readings[model.steps.first_step : model.steps.last_step + 1] = self._scan_at(begin_s)
        asked = _clustered(readings[int(request[2:6]) : int(request[6:10]) + 1], int(request[10:12]))
        width = 2 if request[1] == "S" else 3
        beams = np.stack([asked, _strength(asked)], axis=1) if request[1] == "E" else asked[:, None]
        data = encode_numbers(beams.ravel(), width)
        if request[0] in "NH":
            data = _with_second_echoes(data, beams, width)
        stamp = encode_number(self.sensor_ms(begin_s), 4)
        return f"{_summed(stamp)}\n{encode_blocks(data)}"

    def _obey(self, command: str, now_s: float) -> None:
        body, _, string = command.partition(";")
        if self._is_scip1:
            self._obey_scip1(command, now_s)
        elif len(string) > MAX_STRING:
            self._answer(command, "0G", now_s)
        elif body == "%ST" and self._model.has_intensity:
            # Standby, adjusting time, single scans, a stream.
            state = "002" if self._is_timing else "004" if self._stream else "003" if self._is_laser_on else "000"
            self._answer(command, "00", now_s, (_summed(state),))
        elif self._is_timing and not body.startswith("TM"):
            self._answer(command, "0B", now_s)
        elif body in ("VV", "PP", "II"):
            lines = {"VV": self._model.version, "PP": self._model.parameters(), "II": self._state(now_s)}[body]
            self._answer(command, "00", now_s, tuple(f"{line};{line_sum(line)}" for line in lines))
        elif body in ("BM", "QT", "RS"):
            self._switch(command, body, now_s)
        elif body in ("TM0", "TM1", "TM2"):
            self._time(command, body, now_s)
        elif body[:2] in SCANS or (body[:2] in NEWER_SCANS and self._model.has_intensity):
            self._measure(command, body, string, now_s)
        elif body[:2] == "SS":
            self._set_speed(command, body[2:], now_s)
        elif body[:2] in ("CR", "HS"):
            self._answer(command, "03", now_s)
        else:
            self._answer(command, "0E", now_s)

    def _obey_scip1(self, command: str, now_s: float) -> None:
        if command == "SCIP2.0":
            self._is_scip1 = False
            self._post("SCIP2.0\n0\n\n", now_s)
        elif command == "V":
            lines = "".join(f"{line}\n" for line in self._model.version)
            self._post(f"V\n0\n{lines}\n", now_s)
        else:
            self._post(f"{command}\nE\n\n", now_s)

    def _switch(self, command: str, name: str, now_s: float) -> None:
        status = "02" if name == "BM" and self._is_laser_on else "00"
        if name != "BM":
            self._stream = None
        self._is_laser_on = name == "BM"
        if name == "RS":
            self._is_timing, self.speed = False, self._first_speed()
        self._answer(command, status, now_s)

    def _first_speed(self) -> int:
        return self._model.speeds[0] if self._model.speeds else 0

    def _set_speed(self, command: str, text: str, now_s: float) -> None:
        if len(text) != 6 or not (text.isascii() and text.isdigit()):
            status = "01"
        elif not self._model.speeds or (int(text) in SCIP_SPEEDS and int(text) not in self._model.speeds):
            status = "04"
        elif int(text) not in SCIP_SPEEDS:
            status = "02"
        else:
            status = "03" if int(text) == self.speed else "00"
            self.speed = int(text)
        self._answer(command, status, now_s)

    def _time(self, command: str, name: str, now_s: float) -> None:
        wanted = {"TM0": True, "TM1": self._is_timing, "TM2": False}[name]
        if name == "TM1":
            stamp = encode_number(self.sensor_ms(now_s), 4)
            if self._is_timing:
                self._answer(command, "00", now_s, (_summed(stamp),))
            else:
                self._answer(command, "04", now_s)
            return
        status = "00" if wanted != self._is_timing else ("02" if wanted else "03")
        self._is_timing, self._is_laser_on, self._stream = wanted, False, None
        self._answer(command, status, now_s)

    def _measure(self, command: str, body: str, string: str, now_s: float) -> None:
        is_stream = body[0] in "MN"
        if len(body) != (15 if is_stream else 12) or not body[2:].isdigit():
            self._answer(command, "0C", now_s)
            return
        first, last = int(body[2:6]), int(body[6:10])
        if last >= self._model.steps.steps_per_turn:
            self._answer(command, "04", now_s)
        elif last < first:
            self._answer(command, "05", now_s)
        elif is_stream:
            self._is_laser_on = True
            count = int(body[13:15])
            turn = math.ceil((now_s - self._begin_s) / self._model.steps.turn_s - 1e-9)
            self._stream = _Stream(body[:13], f";{string}" if string else "", count or None, turn)
            self._answer(command, "00", now_s)
        elif not self._is_laser_on:
            self._answer(command, "10", now_s)
        else:
            turn = math.floor((now_s - self._begin_s) / self._model.steps.turn_s + 1e-9) - 1
            self._post(f"{command}\n{_summed('00')}\n{self._scan_text(body, max(turn, 0))}\n", now_s)

    def _state(self, now_s: float) -> tuple[str, ...]:
        by_default = "<-Default setting by user" if self.speed == self._first_speed() else ""
        speed = (f"SBPS:{self.speed}[bps]{by_default}",) if self.speed else ()
        return (
            f"MODL:{self._model.name}",
            f"LASR:{'ON' if self._is_laser_on else 'OFF'}",
            f"SCSP:Initial({round(60 / self._model.steps.turn_s)}[rpm])<-Default setting by user",
            f"MESM:{'MEASURING' if self._stream else 'IDLE'}",
            *speed,
            f"TIME:{self.sensor_ms(now_s):06X}",
            "STAT:Sensor works well.",
        )

    def _answer(self, command: str, status: str, now_s: float, lines: tuple[str, ...] = ()) -> None:
        rest = "".join(f"{line}\n" for line in lines)
        self._post(f"{command}\n{_summed(status)}\n{rest}\n", now_s)

    def _post(self, text: str, ready_s: float) -> None:
        data = text.encode("latin-1")
        self._line_free_s = max(self._line_free_s, ready_s) + len(data) / self._model.bytes_per_s
        self._out.append((self._line_free_s, data))


def _summed(text: str) -> str:
    return text + line_sum(text)


def _strength(readings: IntArray) -> IntArray:
    """(B,) of echoes: the nearer the stronger."""
    return np.where(readings >= FIRST_RANGE_MM, 4000 - np.minimum(readings // 10, 3000), 0)


def _with_second_echoes(data: str, beams: IntArray, width: int) -> str:
    """The numbers (B, 1 or 2) of beams, a '&' and those of the next beam after each that stands at an edge."""
    n_characters = width * beams.shape[1]
    parts = [data[begin : begin + n_characters] for begin in range(0, len(data), n_characters)]
    near = beams[:-1, 0]
    is_edge = (near >= FIRST_RANGE_MM) & (beams[1:, 0] > near + EDGE_MM)
    return "".join(
        f"{part}&{behind}" if k < len(is_edge) and is_edge[k] else part
        for k, (part, behind) in enumerate(zip(parts, [*parts[1:], ""], strict=True))
    )


def _clustered(readings: IntArray, cluster: int) -> IntArray:
    """The least distance of every group; an error code where a group has none."""
    if cluster < 2:
        return readings
    groups = [readings[begin : begin + cluster] for begin in range(0, len(readings), cluster)]
    ranges = [group[group >= FIRST_RANGE_MM] for group in groups]
    return np.array([good.min() if len(good) else group[0] for good, group in zip(ranges, groups, strict=True)])
