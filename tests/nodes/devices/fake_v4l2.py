"""A kernel that answers V4L2 ioctls from a description: laid out as in linux/videodev2.h, independently of the code."""

from __future__ import annotations

import errno
import struct
from dataclasses import dataclass, field

SizePx = tuple[int, int]
# Request numbers as the C compiler gives them for x86-64 and ARM.
QUERYCAP, ENUM_FMT, ENUM_FRAMESIZES, ENUM_FRAMEINTERVALS = 0x80685600, 0xC0405602, 0xC02C564A, 0xC034564B


@dataclass
class FakeKernel:
    """One video device.

    Attributes:
        card: name.
        capabilities: of the whole device and of this node.
        modes: for each four-character code, sizes with their frame intervals in s as (above, below).
        ranges: for each code, smallest and largest size of a continuous choice.
    """

    card: bytes = b"HD Webcam"
    capabilities: tuple[int, int] = (0x85200001, 0x04200001)
    modes: dict[bytes, dict[SizePx, list[tuple[int, int]]]] = field(default_factory=dict)
    ranges: dict[bytes, tuple[SizePx, SizePx]] = field(default_factory=dict)

    def __call__(self, _device: int, request: int, buffer: bytearray) -> int:
        answers = {
            QUERYCAP: self._capability,
            ENUM_FMT: self._format,
            ENUM_FRAMESIZES: self._size,
            ENUM_FRAMEINTERVALS: self._interval,
        }
        if request not in answers:
            raise OSError(errno.ENOTTY, "unknown request")
        assert len(buffer) == request >> 16 & 0x3FFF
        answers[request](buffer)
        return 0

    def _capability(self, buffer: bytearray) -> None:
        struct.pack_into("16s32s32s", buffer, 0, b"uvcvideo", self.card, b"usb-0000:00:14.0-1")
        struct.pack_into("III", buffer, 80, 0x60000, *self.capabilities)

    def _format(self, buffer: bytearray) -> None:
        index, kind = struct.unpack_from("II", buffer)
        assert kind == 1
        buffer[44:48] = _item([*self.modes, *self.ranges], index)

    def _size(self, buffer: bytearray) -> None:
        index, code = struct.unpack_from("I4s", buffer)
        if code in self.ranges:
            (min_width, min_height), (max_width, max_height) = _item([self.ranges[code]], index)
            struct.pack_into("I6I", buffer, 8, 3, min_width, max_width, 2, min_height, max_height, 2)
        else:
            struct.pack_into("III", buffer, 8, 1, *_item(list(self.modes[code]), index))

    def _interval(self, buffer: bytearray) -> None:
        index, code, width, height = struct.unpack_from("I4sII", buffer)
        if code in self.ranges:
            struct.pack_into("I6I", buffer, 16, 2, *_item([(1, 60, 1, 5, 1, 60)], index))
        else:
            struct.pack_into("III", buffer, 16, 1, *_item(self.modes[code][width, height], index))


def _item(items: list, index: int):
    if index >= len(items):
        raise OSError(errno.EINVAL, "end of list")
    return items[index]
