"""Frames of the Xsens MTi family: one layout for commands, legacy data (MTData) and its successor (MTData2).

    FA FF MID LEN DATA... CS          LEN below 255
    FA FF MID FF LEN_HI LEN_LO DATA... CS

The sum of everything after FA, checksum included, is 0 modulo 256. Numbers are big-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from network_calib.observations import FloatArray
from nodes.devices.errors import DeviceError

PREAMBLE, BUS_ID, EXTENDED = 0xFA, 0xFF, 0xFF
# The longest frame that is believed. MTData2 of every quantity is some 300 bytes; without a bound one flipped length
# would swallow seconds of good frames.
MAX_DATA_BYTES = 1024


class Mid(IntEnum):
    """Message identifiers; the acknowledgement of a command is its identifier plus one."""

    REQUEST_DEVICE_ID = 0x00
    SET_PERIOD = 0x04
    REQUEST_DATA_LENGTH = 0x0A
    REQUEST_CONFIGURATION = 0x0C
    CONFIGURATION = 0x0D
    GO_TO_MEASUREMENT = 0x10
    REQUEST_FIRMWARE = 0x12
    REQUEST_BAUD = 0x18
    SET_NO_ROTATION = 0x22
    GO_TO_CONFIG = 0x30
    DATA = 0x32
    REQUEST_DATA = 0x34
    DATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACKNOWLEDGE = 0x3F
    RESET = 0x40
    ERROR = 0x42
    SET_OUTPUT_CONFIGURATION = 0xC0
    SET_OUTPUT_MODE = 0xD0
    SET_OUTPUT_SETTINGS = 0xD2
    SET_SKIP_FACTOR = 0xD4


class OutputMode:
    """Bits of SET_OUTPUT_MODE that are asked for, in the order in which the data stand in a frame."""

    TEMPERATURE = 0x0001
    CALIBRATED = 0x0002


class OutputSettings:
    """Bits of SET_OUTPUT_SETTINGS."""

    SAMPLE_COUNTER = 0x00000001
    NO_ACCELERATION = 0x00000010
    NO_GYROSCOPE = 0x00000020
    NO_MAGNETOMETER = 0x00000040


class DataId:
    """Quantities of MTData2."""

    COUNTER = 0x1020
    TIME_FINE = 0x1060  # 0.1 ms
    ACCELERATION = 0x4020
    RATE_OF_TURN = 0x8020
    STATUS = 0xE020


@dataclass(frozen=True, slots=True)
class Message:
    """One frame: identifier 0..255 and data."""

    mid: int
    data: bytes


@dataclass(frozen=True, slots=True)
class ImuReading:
    """One sample as the device sent it.

    Attributes:
        counter: sample counter, modulo 65536.
        time_fine: MTData2's clock in 0.1 ms, modulo 2**32; None in legacy data.
        rate_rad_s: (3,) rate of turn; None where the frame has none.
        acceleration_m_s2: (3,) specific force; None where the frame has none.
    """

    counter: int
    time_fine: int | None
    rate_rad_s: FloatArray | None
    acceleration_m_s2: FloatArray | None


def encode(mid: int, data: bytes = b"") -> bytes:
    """A whole frame."""
    n = len(data)
    length = bytes([n]) if n < EXTENDED else struct.pack(">BH", EXTENDED, n)
    body = bytes([BUS_ID, mid]) + length + data
    return bytes([PREAMBLE]) + body + bytes([-sum(body) & 0xFF])


class FrameParser:
    """Frames out of a stream of bytes, in any pieces, through garbage.

    Attributes:
        n_bad_sums: frames that were refused for their checksum.
        n_skipped: bytes that belonged to no frame.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.n_bad_sums = 0
        self.n_skipped = 0

    def feed(self, data: bytes) -> list[Message]:
        """The frames that are complete now. After a refused frame the search goes on behind its preamble."""
        self._bytes += data
        out: list[Message] = []
        while (end := self._next(out)) > 0:
            del self._bytes[:end]
        return out

    def reset(self) -> None:
        """Forget an unfinished frame: the line was opened anew."""
        self._bytes.clear()

    def _next(self, out: list[Message]) -> int:
        """How many bytes are done with; 0 when more are needed."""
        held = self._bytes
        begin = held.find(PREAMBLE)
        if begin != 0:
            skipped = len(held) if begin < 0 else begin
            self.n_skipped += skipped
            return skipped
        if len(held) < 4:
            return 0
        header, n = (4, held[3]) if held[3] != EXTENDED else (6, int.from_bytes(held[4:6], "big"))
        if len(held) < header:
            return 0
        if held[1] != BUS_ID or n > MAX_DATA_BYTES:
            self.n_skipped += 1
            return 1
        if len(held) < header + n + 1:
            return 0
        if sum(held[1 : header + n + 1]) & 0xFF:
            self.n_bad_sums += 1
            self.n_skipped += 1
            return 1
        out.append(Message(held[2], bytes(held[header : header + n])))
        return header + n + 1


def decode_legacy(data: bytes, mode: int, settings: int) -> ImuReading:
    """One MTData under the given output mode and settings.

    Raises:
        DeviceError: the length is not that of the mode and settings, or a number is not finite.
    """
    at = 4 if mode & OutputMode.TEMPERATURE else 0
    parts: dict[int, FloatArray] = {}
    if mode & OutputMode.CALIBRATED:
        for absent in (OutputSettings.NO_ACCELERATION, OutputSettings.NO_GYROSCOPE, OutputSettings.NO_MAGNETOMETER):
            if not settings & absent:
                parts[absent] = _vector(data, at)
                at += 12
    n_expected = at + (2 if settings & OutputSettings.SAMPLE_COUNTER else 0)
    if len(data) != n_expected or not settings & OutputSettings.SAMPLE_COUNTER:
        raise DeviceError(f"MTData of {len(data)} bytes, expected {n_expected} with a sample counter at the end")
    return ImuReading(
        counter=int.from_bytes(data[-2:], "big"),
        time_fine=None,
        rate_rad_s=parts.get(OutputSettings.NO_GYROSCOPE),
        acceleration_m_s2=parts.get(OutputSettings.NO_ACCELERATION),
    )


def decode_data2(data: bytes) -> ImuReading:
    """One MTData2; quantities that are not asked for are passed over.

    Raises:
        DeviceError: a packet is cut off, has the wrong length, or there is no counter.
    """
    packets: dict[int, bytes] = {}
    at = 0
    while at < len(data):
        n = data[at + 2] if at + 3 <= len(data) else len(data)
        if at + 3 + n > len(data):
            raise DeviceError(f"MTData2 of {len(data)} bytes ends inside a packet that begins at byte {at}")
        packets[int.from_bytes(data[at : at + 2], "big")] = data[at + 3 : at + 3 + n]
        at += 3 + n
    counter = packets.get(DataId.COUNTER, b"")
    time_fine = packets.get(DataId.TIME_FINE)
    if len(counter) != 2 or (time_fine is not None and len(time_fine) != 4):
        raise DeviceError("MTData2 without a whole sample counter and time")
    return ImuReading(
        counter=int.from_bytes(counter, "big"),
        time_fine=None if time_fine is None else int.from_bytes(time_fine, "big"),
        rate_rad_s=_packet_vector(packets, DataId.RATE_OF_TURN),
        acceleration_m_s2=_packet_vector(packets, DataId.ACCELERATION),
    )


def _packet_vector(packets: dict[int, bytes], data_id: int) -> FloatArray | None:
    data = packets.get(data_id)
    if data is None:
        return None
    if len(data) != 12:
        raise DeviceError(f"MTData2 packet {data_id:04X} of {len(data)} bytes, expected three 4-byte floats")
    return _vector(data, 0)


def _vector(data: bytes, at: int) -> FloatArray:
    if len(data) < at + 12:
        raise DeviceError(f"data of {len(data)} bytes, expected three 4-byte floats from byte {at}")
    out = np.array(struct.unpack_from(">3f", data, at))
    if not np.isfinite(out).all():
        raise DeviceError(f"a sample that is not finite: {out}")
    return out
