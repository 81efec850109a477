"""SCIP 2.0 and 2.2 on the wire: commands, checksums, numbers in 6-bit characters, blocks of data.

    reply   = echo LF  status sum LF  line LF ...  LF           an empty line ends it
    scan    = echo LF  "99b" LF  stamp sum LF  block sum LF ...  LF

Numbers are big-endian 6-bit groups plus 0x30. Data stand in blocks of 64 characters with a sum each; a number may begin
in one block and end in the next. The sum of a line is that of its characters, 6 bits of it, plus 0x30; of parameter
lines that end in ';' some firmware counts the ';' and some does not, so either is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.observations import IntArray
from nodes.devices.errors import DeviceError

BLOCK = 64
# 1081 steps of distance and intensity make 103 blocks and 6.7 kB; with three echoes a beam three times that. Without a
# bound, a lost LF would collect scans for ever.
MAX_REPLY_BYTES = 65536
STAMP_MODULUS_MS = 1 << 24
STATUS_DATA, STATUS_OK = "99", "00"


@dataclass(frozen=True, slots=True)
class Reply:
    """One reply or scan whose every sum was right.

    Attributes:
        echo: the command it answers; of streamed scans with the count of scans that remain.
        status: two characters; empty where the command has none (SCIP 1's version reply).
        lines: what follows, without sums.
    """

    echo: str
    status: str
    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RawScan:
    """The numbers of one scan.

    Attributes:
        stamp_ms: the sensor's clock, modulo 2**24 ms.
        readings_mm: (B,) distances, or error codes below the sensor's least distance. Of several echoes the first.
        intensity: (B,) strength of the echo where it was asked for, else None.
    """

    stamp_ms: int
    readings_mm: IntArray
    intensity: IntArray | None = None


def line_sum(text: str) -> str:
    """The checksum character of a line."""
    return chr((sum(text.encode("latin-1")) & 0x3F) + 0x30)


def is_sum_right(line: str) -> bool:
    """Whether a line's last character is the sum of those before it, counting a ';' before it or not."""
    body, given = line[:-1], line[-1:]
    return bool(body) and (given == line_sum(body) or (body.endswith(";") and given == line_sum(body[:-1])))


def encode_number(value: int, n_characters: int) -> str:
    """A number in 6-bit characters.

    Raises:
        ValueError: it is negative or needs more characters.
    """
    if not 0 <= value < 1 << (6 * n_characters):
        raise ValueError(f"{value} does not fit {n_characters} characters of 6 bits")
    return "".join(chr((value >> shift & 0x3F) + 0x30) for shift in range(6 * (n_characters - 1), -1, -6))


def encode_numbers(values: IntArray, n_characters: int) -> str:
    """Numbers (n,) one after another; what does not fit is cut to the greatest that does."""
    shifts = np.arange(6 * (n_characters - 1), -1, -6)
    kept = np.clip(values, 0, (1 << 6 * n_characters) - 1)
    return ((kept[:, None] >> shifts & 0x3F) + 0x30).astype(np.uint8).tobytes().decode("ascii")


def decode_numbers(text: str, n_characters: int) -> IntArray:
    """(n,) the numbers in a text.

    Raises:
        DeviceError: its length is no multiple, or a character is none of the 64.
    """
    values = np.frombuffer(text.encode("latin-1", errors="replace"), dtype=np.uint8).astype(np.int64) - 0x30
    if len(values) % n_characters:
        raise DeviceError(f"{len(values)} characters of data, expected a multiple of {n_characters}")
    if len(values) and (values.min() < 0 or values.max() > 0x3F):
        raise DeviceError("a character of the data is outside 0x30..0x6F")
    weights = 1 << np.arange(6 * (n_characters - 1), -1, -6)
    return values.reshape(-1, n_characters) @ weights


def encode_blocks(text: str) -> str:
    """Data as blocks of 64 characters with sums, each ended by LF."""
    blocks = [text[begin : begin + BLOCK] for begin in range(0, len(text), BLOCK)]
    return "".join(f"{block}{line_sum(block)}\n" for block in blocks)


class ReplyParser:
    """Replies out of a stream of bytes, in any pieces, through garbage.

    A reply with a wrong sum anywhere is refused as a whole: nothing of a damaged scan is believed.

    Attributes:
        n_bad: replies that were refused.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.n_bad = 0

    def feed(self, data: bytes) -> list[Reply]:
        """The replies that are complete now."""
        self._bytes += data.replace(b"\r", b"")
        if b"\n\n" not in self._bytes:
            self._bound()
            return []
        *whole, rest = bytes(self._bytes).split(b"\n\n")
        self._bytes = bytearray(rest)
        self._bound()
        out: list[Reply] = []
        for text in whole:
            lines = text.decode("latin-1").lstrip("\n").split("\n")
            reply = _checked(lines)
            if reply is not None:
                out.append(reply)
            elif any(lines):
                self.n_bad += 1
        return out

    def reset(self) -> None:
        """Forget an unfinished reply."""
        self._bytes.clear()

    def _bound(self) -> None:
        if len(self._bytes) > MAX_REPLY_BYTES:
            self._bytes.clear()
            self.n_bad += 1


def _checked(lines: list[str]) -> Reply | None:
    # A sum counts six bits of every character; everything that a scanner says has the eighth clear.
    if len(lines) < 2 or not lines[0] or not all(line.isascii() for line in lines):
        return None
    echo, status, rest = lines[0], lines[1], lines[2:]
    # SCIP 1 answers a version request, and the change to SCIP 2, by a bare status without sum.
    if len(status) == 1 and echo in ("V", "SCIP2.0"):
        return Reply(echo, status, tuple(rest))
    if len(status) != 3 or not all(is_sum_right(line) for line in lines[1:]):
        return None
    return Reply(echo, status[:2], tuple(line[:-1] for line in rest))


def decode_stamp(text: str) -> int:
    """A stamp in ms.

    Raises:
        DeviceError: it is not four characters of data.
    """
    if len(text) != 4:
        raise DeviceError(f"a stamp of {len(text)} characters, expected 4")
    return int(decode_numbers(text, 4)[0])


def decode_scan(reply: Reply, *, n_characters: int, n_beams: int, with_intensity: bool) -> RawScan:
    """The scan in a reply.

    Args:
        reply: to MD, MS, GD, GS, ME or GE, or to HD or HE with several echoes a beam.
        n_characters: of each number: 2 for MS and GS, 3 otherwise.
        n_beams: how many beams were asked for.
        with_intensity: whether every distance is followed by an intensity.

    Raises:
        DeviceError: the numbers are not what was asked for.
    """
    if not reply.lines:
        raise DeviceError("a scan without a stamp")
    stamp_ms, text = decode_stamp(reply.lines[0]), "".join(reply.lines[1:])
    width = n_characters * (2 if with_intensity else 1)
    if "&" in text:
        text = _first_echoes(text, width)
    numbers = decode_numbers(text, n_characters)
    if with_intensity:
        numbers = numbers[: len(numbers) // 2 * 2].reshape(-1, 2).T
    readings, intensity = (numbers[0], numbers[1]) if with_intensity else (numbers, None)
    if len(readings) != n_beams:
        raise DeviceError(f"a scan of {len(readings)} beams, expected {n_beams}")
    return RawScan(stamp_ms, readings, intensity)


def _first_echoes(text: str, width: int) -> str:
    """Of beams joined by '&' the first echo: '&' binds the number after it to the beam before it."""
    parts = text.split("&")
    # Of every part but the first, the leading number is a further echo of the beam before.
    return parts[0] + "".join(part[width:] for part in parts[1:])
