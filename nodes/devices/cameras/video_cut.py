"""Whether a video file is shorter than its own header says: the sign of a copy or a recording that was broken off.

Matroska, MP4 and AVI state the length of their outermost parts; other containers do not, and are never called cut.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"


def is_cut(path: Path) -> bool:
    """True when a part of the file reaches beyond its end."""
    n_bytes = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        file.seek(0)
        if head[:4] == _EBML:
            return _matroska_end(file) > n_bytes
        if head[4:8] in {b"ftyp", b"moov", b"mdat", b"wide", b"free"}:
            return _mp4_end(file, n_bytes) > n_bytes
        if head[:4] == b"RIFF":
            return _riff_end(file, n_bytes) > n_bytes
    return False


def _matroska_end(file: BinaryIO) -> int:
    """Where the segment ends; 0 where it was written live, without a length."""
    file.seek(4)
    header = _vint(file)
    file.seek(header or 0, 1)
    if file.read(4) != _SEGMENT:
        return 0
    size = _vint(file)
    return 0 if size is None else file.tell() + size


def _vint(file: BinaryIO) -> int | None:
    """A length of 1 to 8 bytes, its first bits telling how many; None when all others are ones: unknown."""
    first = file.read(1)
    if not first or not first[0]:
        return None
    n_more = 8 - first[0].bit_length()
    n_bits = 7 * (n_more + 1)
    value = int.from_bytes(first + file.read(n_more), "big") & ((1 << n_bits) - 1)
    return None if value == (1 << n_bits) - 1 else value


def _mp4_end(file: BinaryIO, n_bytes: int) -> int:
    """Where the last box ends; a length of 0 means up to the end of the file, of 1 that 64 bits follow."""
    place = 0
    while place + 8 <= n_bytes:
        file.seek(place)
        head = file.read(16)
        size = int.from_bytes(head[:4], "big")
        if size == 1:
            size = int.from_bytes(head[8:16], "big")
        if size < 8:
            return n_bytes
        place += size
    return place


def _riff_end(file: BinaryIO, n_bytes: int) -> int:
    """Where the last list ends; long AVI files have several. Padding to whole words is not missed at the end."""
    place = 0
    while place + 8 <= n_bytes:
        file.seek(place)
        head = file.read(8)
        size = int.from_bytes(head[4:8], "little")
        if head[:4] != b"RIFF" or size in (0, 0xFFFFFFFF):
            return n_bytes
        place += 8 + size
        if place < n_bytes:
            place += size % 2
    return place
