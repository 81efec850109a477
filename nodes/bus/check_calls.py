"""The same door for what is asked and answered: commands, replies, and what a journal tells and gives."""

from __future__ import annotations

import math

from google.protobuf.message import DecodeError

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import BOOT_BYTES, MAX_MESSAGE_BYTES, MAX_SEQUENCE, MAX_TEXT, MAX_TILTS, MessageError, parse

MAX_SPANS = 65536
CODES = ("OK", "BUSY", "UNKNOWN", "UNSUPPORTED", "FAILED")


def parse_command(payload: bytes, *, now_ns: int) -> pb.Command:
    """A command to a node.

    Raises:
        MessageError: refused.
    """
    command = parse(pb.Command, payload, node=None, now_ns=now_ns)
    if not math.isfinite(command.number):
        raise MessageError("number: none")
    if len(command.tilts_rad) > MAX_TILTS or not all(abs(tilt_rad) <= 2 * math.pi for tilt_rad in command.tilts_rad):
        raise MessageError("tilts_rad: too many, or out of bounds")
    return command


def parse_reply(payload: bytes, *, node: str, now_ns: int) -> pb.Reply:
    """A node's answer to a command.

    Raises:
        MessageError: refused.
    """
    reply = parse(pb.Reply, payload, node=node, now_ns=now_ns)
    if reply.code not in CODES:
        raise MessageError("code: unknown")
    if len(reply.message) > MAX_TEXT:
        raise MessageError("message: too long")
    return reply


def parse_summary(payload: bytes, *, node: str, now_ns: int) -> pb.JournalSummary:
    """What a node's journal holds of a session.

    Raises:
        MessageError: refused.
    """
    summary = parse(pb.JournalSummary, payload, node=node, now_ns=now_ns)
    if len(summary.spans) > MAX_SPANS:
        raise MessageError("spans: too many")
    for span in summary.spans:
        if len(span.boot) != BOOT_BYTES:
            raise MessageError("spans.boot: not 16 bytes")
        # An emptied span ends just before its first row.
        if not 0 < span.first + 1 <= span.last + 2 <= MAX_SEQUENCE:
            raise MessageError("spans.first, last: no span")
    return summary


def parse_rows(payload: bytes) -> pb.JournalRows:
    """Rows of a journal; each payload goes through its own check.

    Raises:
        MessageError: refused.
    """
    if len(payload) > MAX_MESSAGE_BYTES:
        raise MessageError("message: too large")
    try:
        return pb.JournalRows.FromString(payload)
    except DecodeError:
        raise MessageError("message: no protobuf of its type") from None
