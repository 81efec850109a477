"""The few questions to Linux' video devices that FFmpeg does not ask (linux/videodev2.h): who are you, what can you do.

Struct layouts are those of 64- and 32-bit Linux alike; request numbers those of x86, ARM and RISC-V.
"""

from __future__ import annotations

import errno
import fcntl
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

# Fills the buffer for a request to an open device; raises OSError as the kernel says.
Ioctl = Callable[[int, int, bytearray], object]

_WRITE, _READ = 1, 2
_CAPTURE_BUFFER = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
_CAN_CAPTURE, _HAS_DEVICE_CAPS = 0x1, 0x80000000
_DISCRETE = 1
EXPOSURE_ABSOLUTE = 0x009A0902  # V4L2_CID_EXPOSURE_ABSOLUTE, in 100 µs
GAIN = 0x00980913  # V4L2_CID_GAIN, in steps whose meaning only the camera's maker knows

_CAPABILITY = struct.Struct("=16s32s32sIII12x")
_FORMAT = struct.Struct("=III32s4s16x")
_FRAME_SIZE = struct.Struct("=I4sI6I8x")
_FRAME_INTERVAL = struct.Struct("=I4sIII6I8x")
_CONTROL = struct.Struct("=Ii")
# A driver that never says "no more" must not hold us for ever.
_MAX_LISTED = 256
_END_OF_LIST = (errno.EINVAL, errno.ENOTTY, errno.ENODATA)


def _request(direction: int, number: int, layout: struct.Struct) -> int:
    return direction << 30 | layout.size << 16 | ord("V") << 8 | number


QUERY_CAPABILITY = _request(_READ, 0, _CAPABILITY)
ENUMERATE_FORMATS = _request(_READ | _WRITE, 2, _FORMAT)
GET_CONTROL = _request(_READ | _WRITE, 27, _CONTROL)
ENUMERATE_FRAME_SIZES = _request(_READ | _WRITE, 74, _FRAME_SIZE)
ENUMERATE_FRAME_INTERVALS = _request(_READ | _WRITE, 75, _FRAME_INTERVAL)


@dataclass(frozen=True, slots=True)
class Capability:
    """What a device says of itself."""

    driver: str
    card: str
    bus: str
    can_capture: bool


def kernel_ioctl(device: int, request: int, buffer: bytearray) -> object:
    """The real one."""
    return fcntl.ioctl(device, request, buffer, True)


def capability(device: int, ioctl: Ioctl = kernel_ioctl) -> Capability:
    """VIDIOC_QUERYCAP.

    Raises:
        OSError: no video device, or it is gone.
    """
    buffer = bytearray(_CAPABILITY.size)
    ioctl(device, QUERY_CAPABILITY, buffer)
    driver, card, bus, _, capabilities, device_capabilities = _CAPABILITY.unpack(buffer)
    of_node = device_capabilities if capabilities & _HAS_DEVICE_CAPS else capabilities
    return Capability(_text(driver), _text(card), _text(bus), bool(of_node & _CAN_CAPTURE))


def codings(device: int, ioctl: Ioctl = kernel_ioctl) -> list[str]:
    """Four-character codes of the pixel formats, VIDIOC_ENUM_FMT."""
    listed = _listed(lambda k: _FORMAT.pack(k, _CAPTURE_BUFFER, 0, b"", b""), ENUMERATE_FORMATS, device, ioctl)
    return [_FORMAT.unpack(buffer)[4].decode("ascii", "replace") for buffer in listed]


def sizes_px(device: int, coding: str, ioctl: Ioctl = kernel_ioctl) -> list[tuple[int, int]]:
    """Widths and heights of a pixel format, VIDIOC_ENUM_FRAMESIZES; of a range, the smallest and the largest."""
    code = coding.encode("ascii", "replace")
    listed = _listed(lambda k: _FRAME_SIZE.pack(k, code, 0, *[0] * 6), ENUMERATE_FRAME_SIZES, device, ioctl)
    found: list[tuple[int, int]] = []
    for buffer in listed:
        _, _, kind, *numbers = _FRAME_SIZE.unpack(buffer)
        if kind != _DISCRETE:
            min_width, max_width, _, min_height, max_height, _ = numbers
            return [(min_width, min_height), (max_width, max_height)]
        found.append((numbers[0], numbers[1]))
    return found


def rates_hz(device: int, coding: str, size_px: tuple[int, int], ioctl: Ioctl = kernel_ioctl) -> list[float]:
    """Frames a second of a format and size, VIDIOC_ENUM_FRAMEINTERVALS; of a range, the fastest and the slowest."""
    code = coding.encode("ascii", "replace")
    listed = _listed(
        lambda k: _FRAME_INTERVAL.pack(k, code, *size_px, 0, *[0] * 6), ENUMERATE_FRAME_INTERVALS, device, ioctl
    )
    found: list[float] = []
    for buffer in listed:
        _, _, _, _, kind, *numbers = _FRAME_INTERVAL.unpack(buffer)
        intervals = [numbers[:2]] if kind == _DISCRETE else [numbers[:2], numbers[2:4]]
        found += [below / above for above, below in intervals if above > 0]
        if kind != _DISCRETE:
            break
    return found


def control(device: int, number: int, ioctl: Ioctl = kernel_ioctl) -> int | None:
    """The value of a control, VIDIOC_G_CTRL; None where the device has no such control, or does not tell now."""
    buffer = bytearray(_CONTROL.pack(number, 0))
    try:
        ioctl(device, GET_CONTROL, buffer)
    except OSError:
        return None
    return _CONTROL.unpack(buffer)[1]


def _listed(query: Callable[[int], bytes], request: int, device: int, ioctl: Ioctl) -> Iterator[bytearray]:
    for index in range(_MAX_LISTED):
        buffer = bytearray(query(index))
        try:
            ioctl(device, request, buffer)
        except OSError as error:
            if error.errno in _END_OF_LIST:
                return
            raise
        yield buffer


def _text(raw: bytes) -> str:
    text = raw.split(b"\0", 1)[0].decode("utf-8", "replace")
    return "".join(character if character.isprintable() else "?" for character in text).strip()
