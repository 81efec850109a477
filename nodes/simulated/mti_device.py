"""An emulated Xsens MTi-G, or one of its successors: states, replies and samples of the real unit.

Power-up: the unit says WakeUp and, unless it is answered within half a second, measures by its stored settings.
Commands that change settings are obeyed in the configuration state only.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from lrf_stereo.tilt import ImuNoise
from network_calib.observations import FloatArray
from nodes.devices.mti_frames import DataId, FrameParser, Message, Mid, OutputMode, OutputSettings, encode

TICK_HZ = 115200
BAUD, BITS_PER_BYTE = 115200, 10
REPLY_S = 2e-3
WAKE_UP_S = 0.5
ERROR_PARAMETER, ERROR_MESSAGE = 0x03, 0x04
# Rate of turn (3,) rad/s and specific force (3,) m/s2 in the sensor's axes at a time.
Motion = Callable[[float], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, slots=True)
class MtiModel:
    """The unit.

    Attributes:
        is_successor: knows SetOutputConfiguration and MTData2; an MTi-G refuses it.
        noise: white noise of both sensors.
        gyro_bias_rad_s: (3,) of the rate when switched on.
        gyro_walk_rad_s_sqrt_s: random walk of that bias.
        acceleration_bias_m_s2: (3,), of 2000 ug published.
        clock_gain: device seconds per true second.
        device_id: as asked by ReqDID.
    """

    is_successor: bool = False
    noise: ImuNoise = field(default_factory=ImuNoise)
    gyro_bias_rad_s: tuple[float, float, float] = (0.01, -0.017, 0.006)
    gyro_walk_rad_s_sqrt_s: float = 2e-5
    acceleration_bias_m_s2: tuple[float, float, float] = (0.015, -0.01, 0.02)
    clock_gain: float = 1 + 30e-6
    device_id: int = 0x00500001


@dataclass(frozen=True, slots=True)
class _Settings:
    mode: int = OutputMode.CALIBRATED
    output: int = OutputSettings.SAMPLE_COUNTER
    ticks: int = 1152
    skip: int = 0
    packets: tuple[tuple[int, int], ...] = ((DataId.COUNTER, 0xFFFF), (DataId.RATE_OF_TURN, 100))


class MtiDevice:
    """The emulator; see `Emulator`.

    Args:
        motion: of the sensor, in true time.
        rng: draws the noise.
        model: the unit.
    """

    def __init__(self, motion: Motion, *, rng: np.random.Generator, model: MtiModel | None = None) -> None:
        self._motion, self._rng, self._model = motion, rng, model or MtiModel()
        self._parser = FrameParser()
        self._settings = _Settings()
        self._out: list[tuple[float, bytes]] = []
        self._bias = np.array(self._model.gyro_bias_rad_s)
        self._measures_from_s = math.inf
        self._next_sample_s = math.inf
        self._line_free_s = 0.0
        self._counter = 0

    def connect(self, now_s: float) -> None:
        """Power on."""
        self._parser.reset()
        self._out.clear()
        self._counter, self._line_free_s = 0, now_s
        self._next_sample_s = math.inf
        self._measures_from_s = now_s + WAKE_UP_S
        self._post(encode(Mid.WAKE_UP), now_s)

    def disconnect(self, now_s: float) -> None:
        """Power off. Settings are stored, as the real unit stores them."""
        del now_s
        self._out.clear()
        self._measures_from_s = self._next_sample_s = math.inf

    def receive(self, data: bytes, now_s: float) -> None:
        """Commands."""
        self._measure_until(now_s)
        for message in self._parser.feed(data):
            self._obey(message, now_s)

    def send(self, now_s: float) -> bytes:
        """Replies and samples that have left by now."""
        self._measure_until(now_s)
        due = [data for due_s, data in self._out if due_s <= now_s]
        self._out = [(due_s, data) for due_s, data in self._out if due_s > now_s]
        return b"".join(due)

    def next_due_s(self) -> float:
        """When the next frame has left the line."""
        first = self._out[0][0] if self._out else math.inf
        return min(first, self._measures_from_s, self._next_sample_s)

    @property
    def _is_measuring(self) -> bool:
        return math.isfinite(self._next_sample_s)

    @property
    def _period_s(self) -> float:
        """True time from sample to sample."""
        return self._settings.ticks / TICK_HZ / self._model.clock_gain

    def _measure_until(self, now_s: float) -> None:
        if self._measures_from_s <= now_s:
            self._next_sample_s, self._measures_from_s = self._measures_from_s + self._period_s, math.inf
        while self._next_sample_s <= now_s:
            self._sample(self._next_sample_s)
            self._next_sample_s += self._period_s

    def _sample(self, at_s: float) -> None:
        model, rate_hz = self._model, 1 / self._period_s
        rate, force = self._motion(at_s)
        walk = model.gyro_walk_rad_s_sqrt_s * math.sqrt(self._period_s)
        self._bias = self._bias + walk * self._rng.standard_normal(3)
        white = math.sqrt(rate_hz) * self._rng.standard_normal((2, 3))
        rate = rate + self._bias + model.noise.gyro_rad_s_sqrt_hz * white[0]
        force = force + np.array(model.acceleration_bias_m_s2) + model.noise.acceleration_m_s2_sqrt_hz * white[1]
        if model.is_successor:
            frame = encode(Mid.DATA2, self._packets(at_s, rate, force))
        else:
            frame = encode(Mid.DATA, self._legacy(rate, force))
        if self._counter % (self._settings.skip + 1) == 0:
            self._post(frame, at_s)
        self._counter = (self._counter + 1) % 65536

    def _legacy(self, rate: FloatArray, force: FloatArray) -> bytes:
        settings, magnetic = self._settings, np.array([0.5, 0.0, -0.8])
        parts = (
            (OutputSettings.NO_ACCELERATION, force),
            (OutputSettings.NO_GYROSCOPE, rate),
            (OutputSettings.NO_MAGNETOMETER, magnetic),
        )
        data = b"".join(_floats(value) for absent, value in parts if not settings.output & absent)
        data = data if settings.mode & OutputMode.CALIBRATED else b""
        return data + (struct.pack(">H", self._counter) if settings.output & OutputSettings.SAMPLE_COUNTER else b"")

    def _configuration(self) -> bytes:
        settings, device = self._settings, self._model.device_id
        length = len(self._legacy(np.zeros(3), np.zeros(3)))
        timing = (settings.ticks, settings.skip, 0, 0, 0)
        unit = (1, device, length, settings.mode, settings.output)
        return struct.pack(">IHHHHI8s8s32x32xHIHHI8x", device, *timing, b"20070802", b"12000000", *unit)

    def _packets(self, at_s: float, rate: FloatArray, force: FloatArray) -> bytes:
        time_fine = round(at_s * self._model.clock_gain * 1e4) % (1 << 32)
        known = {
            DataId.COUNTER: struct.pack(">H", self._counter),
            DataId.TIME_FINE: struct.pack(">I", time_fine),
            DataId.ACCELERATION: _floats(force),
            DataId.RATE_OF_TURN: _floats(rate),
            DataId.STATUS: struct.pack(">I", 0x81),
        }
        asked = [data_id for data_id, _ in self._settings.packets if data_id in known]
        return b"".join(struct.pack(">HB", data_id, len(known[data_id])) + known[data_id] for data_id in asked)

    def _obey(self, message: Message, now_s: float) -> None:
        mid, data = message.mid, message.data
        if mid == Mid.WAKE_UP_ACKNOWLEDGE:
            if math.isfinite(self._measures_from_s):
                self._measures_from_s = math.inf
            return
        if mid in (Mid.GO_TO_CONFIG, Mid.GO_TO_MEASUREMENT):
            self._measures_from_s = math.inf
            self._next_sample_s = math.inf if mid == Mid.GO_TO_CONFIG else now_s + self._period_s
            self._acknowledge(mid, b"", now_s)
            return
        if self._is_measuring or math.isfinite(self._measures_from_s):
            return  # a measuring unit hears nothing else
        if mid == Mid.RESET:
            self._acknowledge(mid, b"", now_s)
            self.connect(now_s)
            return
        answers = {
            Mid.REQUEST_DEVICE_ID: struct.pack(">I", self._model.device_id),
            Mid.REQUEST_CONFIGURATION: self._configuration(),
            Mid.REQUEST_DATA_LENGTH: struct.pack(">H", len(self._legacy(np.zeros(3), np.zeros(3)))),
            Mid.REQUEST_FIRMWARE: bytes([2, 4, 0]),
            Mid.REQUEST_BAUD: b"\x02",
            Mid.SET_NO_ROTATION: b"",
        }
        if mid in answers:
            self._acknowledge(mid, answers[Mid(mid)], now_s)
        elif (changed := self._changed(mid, data)) is not None:
            self._settings = changed
            self._acknowledge(mid, data if mid == Mid.SET_OUTPUT_CONFIGURATION else b"", now_s)
        else:
            known = (Mid.SET_PERIOD, Mid.SET_OUTPUT_MODE, Mid.SET_OUTPUT_SETTINGS, Mid.SET_SKIP_FACTOR)
            error = ERROR_PARAMETER if mid in known else ERROR_MESSAGE
            self._post(encode(Mid.ERROR, bytes([error])), now_s + REPLY_S)

    def _changed(self, mid: int, data: bytes) -> _Settings | None:
        """The settings after a command; None where it is refused."""
        settings = self._settings
        if mid == Mid.SET_OUTPUT_CONFIGURATION and self._model.is_successor and len(data) % 4 == 0:
            packets = tuple(struct.iter_unpack(">HH", data))
            rates = [rate for data_id, rate in packets if data_id in (DataId.ACCELERATION, DataId.RATE_OF_TURN)]
            ticks = round(TICK_HZ / rates[0]) if rates and rates[0] else settings.ticks
            return replace(settings, packets=packets, ticks=ticks)
        if self._model.is_successor:
            return None
        value = int.from_bytes(data, "big")
        if mid == Mid.SET_PERIOD and len(data) == 2 and 225 <= value <= 11520:
            return replace(settings, ticks=value)
        if mid == Mid.SET_OUTPUT_MODE and len(data) == 2:
            return replace(settings, mode=value)
        if mid == Mid.SET_OUTPUT_SETTINGS and len(data) == 4:
            return replace(settings, output=value)
        if mid == Mid.SET_SKIP_FACTOR and len(data) == 2 and value < 0xFFFF:
            return replace(settings, skip=value)
        return None

    def _acknowledge(self, mid: int, data: bytes, now_s: float) -> None:
        self._post(encode(mid + 1, data), now_s + REPLY_S)

    def _post(self, frame: bytes, ready_s: float) -> None:
        """A frame leaves when those before it have left, and takes its time on the line."""
        self._line_free_s = max(self._line_free_s, ready_s) + len(frame) * BITS_PER_BYTE / BAUD
        self._out.append((self._line_free_s, frame))


def _floats(values: FloatArray) -> bytes:
    return struct.pack(">3f", *values)
