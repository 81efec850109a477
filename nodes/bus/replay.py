"""What a journal gives back: how rows are asked for, how they are packed, and how the asker knows what came."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import zenoh
from google.protobuf.message import DecodeError

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import BOOT_BYTES, MAX_SEQUENCE, MessageError
from nodes.bus.keys import NAME
from nodes.journal import Journal

# A reply beyond this would hold up what else is on the line.
REPLY_BYTES = 256 * 1024
# So much for one request, so that its replies come within its time; the asker goes on from there.
REQUEST_BYTES = 2**20
# Key and framing of a row, rounded up.
ROW_BYTES = 256


@dataclass(frozen=True, slots=True)
class RowsWanted:
    """A request for rows of a journal.

    Attributes:
        session: its id; empty for what was observed outside of one.
        boot: 16 bytes.
        first: sequence.
        last: sequence, included.
    """

    session: str
    boot: bytes
    first: int
    last: int

    @property
    def parameters(self) -> str:
        return f"session={self.session};boot={self.boot.hex()};from={self.first};to={self.last}"


def parse_rows_wanted(parameters: zenoh.Parameters) -> RowsWanted:
    """The request that a query's parameters make.

    Raises:
        MessageError: none.
    """
    try:
        boot = bytes.fromhex(parameters.get("boot", "") or "")
        first, last = int(parameters.get("from", "") or ""), int(parameters.get("to", "") or "")
    except ValueError:
        raise MessageError("boot, from, to: no request for rows") from None
    if len(boot) != BOOT_BYTES or not 0 <= first <= last <= MAX_SEQUENCE:
        raise MessageError("boot, from, to: no request for rows")
    return RowsWanted(parse_session(parameters), boot, first, last)


def parse_session(parameters: zenoh.Parameters) -> str:
    """The session that a query's parameters name; may be empty.

    Raises:
        MessageError: none.
    """
    session = parameters.get("session", "") or ""
    if session and NAME.fullmatch(session) is None:
        raise MessageError("session: no name")
    return session


def packed(journal: Journal, wanted: RowsWanted) -> Iterator[pb.JournalRows]:
    """The rows of a request as replies, by sequence; one without rows when there are none, so that the asker knows.

    Raises:
        DeviceError: the journal cannot be read.
    """
    rows = pb.JournalRows()
    n_bytes = n_replies = 0
    for _, key, payload in journal.rows(
        wanted.session, wanted.boot, wanted.first, wanted.last, max_bytes=REQUEST_BYTES
    ):
        if rows.rows and n_bytes + len(payload) + ROW_BYTES > REPLY_BYTES:
            yield rows
            rows, n_bytes, n_replies = pb.JournalRows(), 0, n_replies + 1
        rows.rows.add(key=key, payload=payload)
        n_bytes += len(payload) + ROW_BYTES
    if rows.rows or n_replies == 0:
        yield rows


def header_of(payload: bytes) -> pb.Header | None:
    """The header of any observation; None when there is none to be read.

    All observations begin with a header and a text, so the smallest of them reads it from any.
    """
    try:
        return pb.NodeEvent.FromString(payload).header
    except DecodeError:
        return None


def sequences_of(rows: Iterable[pb.JournalRow], wanted: RowsWanted) -> Iterator[tuple[int, pb.JournalRow]]:
    """The rows that were asked for, with their sequences; others are left out."""
    for row in rows:
        header = header_of(row.payload)
        if header is not None and header.boot == wanted.boot and wanted.first <= header.sequence <= wanted.last:
            yield header.sequence, row
