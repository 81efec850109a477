"""Records of an MCAP file that may be cut off, damaged, or from elsewhere.

The stock readers want a footer, and allocate what a length field says. Here a record counts when it is whole: the file
is framed by its 9-byte prefixes, nothing longer than the file is believed, and of a chunk that is cut off everything
that still unpacks is read.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema

from network_calib.errors import InputError

MAGIC: Final = b"\x89MCAP0\r\n"
PREFIX: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_CHUNK: Final = struct.Struct("<QQQII")
# A chunk is a few MiB in every writer; one that claims more is not unpacked.
MAX_CHUNK_BYTES: Final = 256 * 2**20
_DECODERS: dict[int, Callable[[ReadDataStream], Schema | Channel | Attachment | Metadata]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
}


@dataclass(frozen=True, slots=True)
class Message:
    """A message record.

    Attributes:
        channel: id of its channel in the file.
        log_ns: when it arrived.
        publish_ns: when what it tells happened.
        data: as it was published.
    """

    channel: int
    log_ns: int
    publish_ns: int
    data: bytes


Record = Schema | Channel | Attachment | Metadata | Message
# What stands beside the messages: never in a chunk, so that reading it costs no unpacking.
REMARKS: Final = frozenset({Opcode.ATTACHMENT, Opcode.METADATA})


def records(path: Path, faults: Counter[str], *, only: frozenset[Opcode] | None = None) -> Iterator[Record]:
    """All whole records up to the end of the data, or to where the file is cut off.

    Args:
        path: of the file; one that is still being written is read as far as it is now.
        faults: counts what was left out, by reason; a cut is none.
        only: kinds of records; the others are passed over unread.

    Raises:
        InputError: no MCAP file.
    """
    with path.open("rb") as file:
        size = path.stat().st_size
        magic = file.read(len(MAGIC))
        if not MAGIC.startswith(magic):
            raise InputError(f"{path} is no MCAP file", advice="Give a session folder, or a .mcap recording.")
        for opcode, body, is_whole in _framed(file, size, only=only):
            if opcode == Opcode.CHUNK:
                yield from _unpacked(body, faults, is_whole=is_whole)
            elif is_whole:
                yield from _decoded(opcode, body, faults)


def whole_bytes(path: Path) -> int:
    """How many bytes of an unchunked file are whole records of its data; 0: not even its magic is whole."""
    with path.open("rb") as file:
        size = path.stat().st_size
        if file.read(len(MAGIC)) != MAGIC:
            return 0
        end = len(MAGIC)
        while len(prefix := file.read(PREFIX.size)) == PREFIX.size:
            opcode, length = PREFIX.unpack(prefix)
            if opcode == Opcode.DATA_END or length > size - file.tell():
                break
            end = file.seek(length, 1)
        return end


def _framed(stream: BinaryIO, size: int, *, only: frozenset[Opcode] | None = None) -> Iterator[tuple[int, bytes, bool]]:
    """Opcode and body of each record, and whether it is whole; only the last one may not be."""
    while len(prefix := stream.read(PREFIX.size)) == PREFIX.size:
        opcode, length = PREFIX.unpack(prefix)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        is_whole = length <= size - stream.tell()
        if is_whole and only is not None and opcode not in only:
            stream.seek(length, 1)
            continue
        yield opcode, stream.read(length if is_whole else -1), is_whole
        if not is_whole:
            return


def _decoded(opcode: int, body: bytes, faults: Counter[str]) -> Iterator[Record]:
    if opcode == Opcode.MESSAGE:
        if len(body) < _MESSAGE.size:
            faults["recording: damaged record"] += 1
            return
        channel, _, log_ns, publish_ns = _MESSAGE.unpack_from(body)
        yield Message(channel, log_ns, publish_ns, body[_MESSAGE.size :])
    elif opcode in _DECODERS:
        try:
            record = _DECODERS[opcode](ReadDataStream(BytesIO(body)))
        except (McapError, struct.error, ValueError, OverflowError):
            faults["recording: damaged record"] += 1
            return
        yield record


def _unpacked(body: bytes, faults: Counter[str], *, is_whole: bool) -> Iterator[Record]:
    """The records of a chunk; of one that is cut off, those that unpack."""
    if len(body) < _CHUNK.size:
        return
    _, _, n_bytes, _, name_length = _CHUNK.unpack_from(body)
    if n_bytes > MAX_CHUNK_BYTES or name_length > 64:
        faults["recording: chunk of an impossible size"] += 1
        return
    data = _plain(body, faults, is_whole=is_whole)
    for opcode, inner, is_inner_whole in _framed(BytesIO(data), len(data)):
        if is_inner_whole and opcode != Opcode.CHUNK:
            yield from _decoded(opcode, inner, faults)


def _plain(body: bytes, faults: Counter[str], *, is_whole: bool) -> bytes:
    import lz4.frame
    import zstandard

    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(body)))
        limit = min(chunk.uncompressed_size, MAX_CHUNK_BYTES)
        match chunk.compression:
            case "":
                data = chunk.data
            case "zstd":
                data = zstandard.ZstdDecompressor().stream_reader(BytesIO(chunk.data)).read(limit)
            case "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=limit)
            case _:
                faults["recording: unknown compression"] += 1
                return b""
    except (McapError, struct.error, ValueError, OverflowError, RuntimeError, EOFError, zstandard.ZstdError):
        if is_whole:
            faults["recording: damaged chunk"] += 1
        return b""
    return data if _is_sound(chunk, data, faults, is_whole=is_whole) else b""


def _is_sound(chunk: Chunk, data: bytes, faults: Counter[str], *, is_whole: bool) -> bool:
    """False where a whole chunk is not what was written: numbers that changed in silence are worse than a gap."""
    from zlib import crc32

    if not is_whole or chunk.uncompressed_crc in (0, crc32(data)):
        return True
    faults["recording: damaged chunk"] += 1
    return False
