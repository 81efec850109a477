"""Driver of an Xsens MTi-G, its successors, and the IMU that is not there: rates of turn and specific force.

Configuration is tried in the successors' way first (SetOutputConfiguration); a device that refuses it is asked in the
legacy way. Samples carry the device's own time; `clock_fit.py` turns it into the host's.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from network_calib.errors import InputError
from network_calib.observations import FloatArray
from nodes.devices.errors import DeviceError
from nodes.devices.mti_frames import (
    DataId,
    FrameParser,
    ImuReading,
    Message,
    Mid,
    OutputMode,
    OutputSettings,
    decode_data2,
    decode_legacy,
    encode,
)
from nodes.devices.transport import Transport

BAUD = 115200
# The device counts its sampling period in ticks of this rate.
TICK_HZ = 115200
REPLY_TIMEOUT_S = 0.5
# A device that is still measuring answers between its data; one that just woke may miss the first command.
ATTEMPTS = 4
LEGACY_SETTINGS = OutputSettings.SAMPLE_COUNTER | OutputSettings.NO_MAGNETOMETER
COUNTER_MODULUS, TIME_FINE_MODULUS, TIME_FINE_S = 1 << 16, 1 << 32, 1e-4


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One sample.

    Attributes:
        sequence: sample number since the first, wraps undone; a gap means samples that were lost.
        device_s: time of the sample on the device's clock, from its first sample.
        arrival_s: this machine's clock when the sample came.
        rate_rad_s: (3,) rate of turn in the sensor's axes.
        acceleration_m_s2: (3,) specific force, +9.81 upwards at rest.
    """

    sequence: int
    device_s: float
    arrival_s: float
    rate_rad_s: FloatArray
    acceleration_m_s2: FloatArray


@dataclass(frozen=True, slots=True)
class ImuCounts:
    """What came since the driver was made.

    Attributes:
        samples: good ones.
        missed: samples that the counter shows to be lost.
        bad_sums: frames refused for their checksum.
        skipped_bytes: bytes that belonged to no frame.
        refused: frames with a good checksum whose content is none.
        restarts: times at which the device began to count anew.
    """

    samples: int = 0
    missed: int = 0
    bad_sums: int = 0
    skipped_bytes: int = 0
    refused: int = 0
    restarts: int = 0


class Imu(Protocol):
    """An inertial sensor."""

    def start(self) -> None:
        """Configure it and let it measure."""
        ...

    def read(self, timeout_s: float) -> list[ImuSample]:
        """The samples that have come; waits for the first at most so long."""
        ...

    @property
    def counts(self) -> ImuCounts:
        """So far."""
        ...


class NullImu:
    """No inertial sensor: the tilt unit's step count is the only source of the tilt angle."""

    @property
    def counts(self) -> ImuCounts:
        """Nothing, ever."""
        return ImuCounts()

    def start(self) -> None:
        """Nothing to configure."""

    def read(self, timeout_s: float) -> list[ImuSample]:
        """Never a sample, and no waiting."""
        del timeout_s
        return []


class Mti:
    """An MTi-G or one of its successors on an open line.

    Args:
        transport: the line.
        rate_hz: samples a second; TICK_HZ must be a multiple of it within 1 %.
        clock: this machine's clock, s.

    Raises:
        InputError: a rate that the device cannot do.
    """

    def __init__(
        self, transport: Transport, *, rate_hz: float = 100.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        ticks = round(TICK_HZ / rate_hz) if rate_hz > 0 else 0
        if not 225 <= ticks <= 65535 or abs(TICK_HZ / ticks / rate_hz - 1) > 0.01:
            raise InputError(f"IMU rate {rate_hz} Hz, expected 2 to 512, such as 100 or 200")
        self._line, self._clock, self._ticks = transport, clock, ticks
        self._parser = FrameParser()
        self._is_legacy = False
        self._waiting: list[Message] = []
        self._sequence = _Sequence(ticks / TICK_HZ)
        self._n_samples = self._n_refused = 0

    @property
    def counts(self) -> ImuCounts:
        """So far."""
        parser, sequence = self._parser, self._sequence
        return ImuCounts(
            self._n_samples,
            sequence.n_missed,
            parser.n_bad_sums,
            parser.n_skipped,
            self._n_refused,
            sequence.n_restarts,
        )

    def start(self) -> None:
        """Configure the device and let it measure.

        Raises:
            DeviceError: it does not answer, or refuses the configuration.
            LineLostError: it is gone.
        """
        self._command(Mid.GO_TO_CONFIG)
        rate = round(TICK_HZ / self._ticks)
        # Counter and time come with every sample, whatever rate is asked for them.
        asked = ((DataId.COUNTER, 0xFFFF), (DataId.TIME_FINE, 0xFFFF), (DataId.ACCELERATION, rate))
        wanted = b"".join(struct.pack(">HH", *pair) for pair in (*asked, (DataId.RATE_OF_TURN, rate)))
        self._is_legacy = self._command(Mid.SET_OUTPUT_CONFIGURATION, wanted, may_refuse=True) is None
        if self._is_legacy:
            self._command(Mid.SET_OUTPUT_MODE, struct.pack(">H", OutputMode.CALIBRATED))
            self._command(Mid.SET_OUTPUT_SETTINGS, struct.pack(">I", LEGACY_SETTINGS))
            self._command(Mid.SET_PERIOD, struct.pack(">H", self._ticks))
            self._command(Mid.SET_SKIP_FACTOR, struct.pack(">H", 0))
        self._command(Mid.GO_TO_MEASUREMENT)
        self._sequence.restart()

    def identify(self) -> str:
        """The device's number; it does not measure afterwards.

        Raises:
            DeviceError: it does not answer.
            LineLostError: it is gone.
        """
        self._command(Mid.GO_TO_CONFIG)
        return (self._command(Mid.REQUEST_DEVICE_ID) or b"").hex().upper()

    def read(self, timeout_s: float) -> list[ImuSample]:
        """The samples that have come; waits for bytes at most so long.

        Raises:
            LineLostError: the device is gone.
        """
        messages, self._waiting = self._waiting, []
        if not messages:
            messages = self._parser.feed(self._line.read(timeout_s))
        arrival_s = self._clock()
        samples = [self._sample(message, arrival_s) for message in messages]
        return [sample for sample in samples if sample is not None]

    def _sample(self, message: Message, arrival_s: float) -> ImuSample | None:
        if message.mid != (Mid.DATA if self._is_legacy else Mid.DATA2):
            return None
        try:
            if self._is_legacy:
                reading = decode_legacy(message.data, OutputMode.CALIBRATED, LEGACY_SETTINGS)
            else:
                reading = decode_data2(message.data)
        except DeviceError:
            self._n_refused += 1
            return None
        if reading.rate_rad_s is None or reading.acceleration_m_s2 is None:
            self._n_refused += 1
            return None
        sequence, device_s = self._sequence.place(reading)
        self._n_samples += 1
        return ImuSample(sequence, device_s, arrival_s, reading.rate_rad_s, reading.acceleration_m_s2)

    def _command(self, mid: int, data: bytes = b"", *, may_refuse: bool = False) -> bytes | None:
        """The acknowledgement's data, or None where the device refuses and may."""
        for _ in range(ATTEMPTS):
            self._line.write(encode(mid, data))
            reply = self._reply(mid)
            if reply is None:
                continue
            if reply.mid == mid + 1:
                return reply.data
            if may_refuse:
                return None
            raise DeviceError(
                f"{self._line.name}: the IMU refuses command {mid:02X} with error {reply.data.hex() or 'unknown'}"
            )
        raise DeviceError(
            f"{self._line.name}: no answer from the IMU to command {mid:02X}",
            advice=f"Is this the IMU's port, and its speed {BAUD} baud?",
        )

    def _reply(self, mid: int) -> Message | None:
        end_s = self._clock() + REPLY_TIMEOUT_S
        while (left_s := end_s - self._clock()) > 0:
            messages = self._parser.feed(self._line.read(left_s))
            for k, message in enumerate(messages):
                if message.mid == Mid.WAKE_UP:  # it has just been switched on, and waits for this to be configured
                    self._line.write(encode(Mid.WAKE_UP_ACKNOWLEDGE))
                if message.mid in (mid + 1, Mid.ERROR):
                    # Data may follow the last acknowledgement at once.
                    self._waiting = messages[k + 1 :]
                    return message
        return None


class _Sequence:
    """Sample numbers and device times without wraps."""

    # A counter that jumps by more than this was restarted: 5 s at 100 Hz lost in one go reads as one gap.
    MAX_GAP = 4096

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._last: ImuReading | None = None
        self._number, self._device_s = -1, 0.0
        self.n_missed = self.n_restarts = 0

    def restart(self) -> None:
        """The device was configured anew: its counter may be anything. Numbers and times here only grow."""
        self._last = None

    def place(self, reading: ImuReading) -> tuple[int, float]:
        """Sequence number and device time of the next reading."""
        step, span_s = 1, self._period_s
        if self._last is not None:
            step = (reading.counter - self._last.counter) % COUNTER_MODULUS
            span_s = self._span_s(self._last, reading, step)
            if not 0 < step <= self.MAX_GAP:
                self.n_restarts += 1
                step, span_s = 1, self._period_s
            self.n_missed += step - 1
        elif self._number < 0:
            span_s = 0.0
        else:
            self.n_restarts += 1
        self._last = reading
        self._number += step
        self._device_s += span_s
        return self._number, self._device_s

    def _span_s(self, last: ImuReading, reading: ImuReading, step: int) -> float:
        if reading.time_fine is None or last.time_fine is None:
            return step * self._period_s
        return (reading.time_fine - last.time_fine) % TIME_FINE_MODULUS * TIME_FINE_S
