"""Watching a recorded H.264 stream for pictures that its recorder never got, such as those lost on the network.

Files hold H.264 in two ways: with start codes (Annex B; transport streams, AVI), or with the length before each unit
and the parameters apart (ISO/IEC 14496-15, 5.3; MP4 and Matroska). `FrameNumbers` reads the first; the second is turned
into it here, as far as it is needed: up to the head of the first slice.
"""

from __future__ import annotations

from collections.abc import Iterator

from av.packet import Packet
from av.video.stream import VideoStream

from nodes.devices.cameras.h264_gaps import FrameNumbers

_START = b"\x00\x00\x01"
_SLICES = (1, 5)
_HEAD_BYTES = 8192  # parameter sets and supplemental data before the first slice; a packet with more is not judged
_UNIT_BYTES = 400  # of each unit: more than the longest parameter set or slice head that is read


class H264Watch:
    """Watches the packets of one stream, in decoding order.

    Args:
        extradata: of the decoder: parameter sets in Annex B, or a decoder configuration record.
    """

    def __init__(self, extradata: bytes | None) -> None:
        self._n_length_bytes = 0
        if extradata and extradata[0] == 1 and len(extradata) > 6:
            self._n_length_bytes = (extradata[4] & 3) + 1
            extradata = b"".join(_START + unit for unit in _parameter_sets(extradata))
        self._numbers = FrameNumbers(extradata)

    @classmethod
    def of(cls, stream: VideoStream) -> H264Watch | None:
        """The watch of a stream; None where it is not H.264. H.265 needs none: its decoder misses what is missing."""
        context = stream.codec_context
        return cls(context.extradata) if context.codec.canonical_name == "h264" else None

    def is_gap_before(self, packet: Packet) -> bool:
        """Whether a picture that others refer to is missing between this packet and the one before it."""
        head = bytes(memoryview(packet)[:_HEAD_BYTES])
        if self._n_length_bytes:
            head = b"".join(_START + unit for unit in _units(head, self._n_length_bytes))
        return self._numbers.is_gap_before(head)


def _parameter_sets(record: bytes) -> Iterator[bytes]:
    """The sequence parameter sets of a decoder configuration record (ISO/IEC 14496-15, 5.3.3.1)."""
    place = 6
    for _ in range(record[5] & 31):
        length = int.from_bytes(record[place : place + 2], "big")
        yield record[place + 2 : place + 2 + length]
        place += 2 + length


def _units(head: bytes, n_length_bytes: int) -> Iterator[bytes]:
    """The beginning of each unit, up to the first slice."""
    place = 0
    while place + n_length_bytes < len(head):
        length = int.from_bytes(head[place : place + n_length_bytes], "big")
        place += n_length_bytes
        yield head[place : place + min(length, _UNIT_BYTES)]
        if head[place] & 31 in _SLICES:
            return
        place += length
