"""What a coordinator asks of nodes: commands, and what their journals hold.

An answer of nothing is Zenoh's word for "nobody there, or not now": it is asked again until the time is over.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import TypeVar

import zenoh

from nodes.bus import qos
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.check_calls import parse_reply, parse_rows, parse_summary
from nodes.bus.checks import MAX_TEXT, MessageError
from nodes.bus.keys import Keys, Verb
from nodes.bus.replay import RowsWanted, sequences_of
from nodes.devices.errors import DeviceError

T = TypeVar("T")
AGAIN_S = 0.2
# A request or its answer may get lost on a full line, and then nobody tells: it is asked again after this.
ASK_S = 3.0
# Zenoh's reply when the time of a request is over.
TIMEOUT = b"Timeout"


def send_command(
    session: zenoh.Session, keys: Keys, node: str, verb: Verb, command: pb.Command, *, timeout_s: float
) -> pb.Reply:
    """A node's reply to a command. The node runs it once, though it may be asked several times.

    Args:
        session: open.
        keys: of the site.
        node: its id.
        verb: what to do; written into the command.
        command: its header filled by the caller.
        timeout_s: for the answer, the node's work included.

    Raises:
        DeviceError: no answer, or none that can be believed.
    """
    command.verb = verb
    call = os.urandom(16)
    request = command.SerializeToString()

    def ask(left_s: float) -> pb.Reply | None:
        return _first(
            session.get(
                keys.command(node, verb),
                payload=request,
                attachment=call,
                timeout=left_s,
                congestion_control=qos.CONGESTION,
                priority=qos.COMMAND.priority,
                express=qos.COMMAND.express,
            ),
            lambda payload: parse_reply(payload, node=node, now_ns=time.time_ns()),
        )

    reply = _until(ask, timeout_s)
    if reply is None:
        raise DeviceError(
            f"node {node} gave no answer to {verb} within {timeout_s:g} s",
            advice="Does it run, and does it reach the router? See its own output.",
        )
    return reply


def fetch_summary(
    session: zenoh.Session, keys: Keys, node: str, of_session: str, *, timeout_s: float
) -> pb.JournalSummary | None:
    """What a node's journal holds of a session; None when it does not answer.

    Raises:
        DeviceError: its answer is an error, or cannot be believed.
    """

    def ask(left_s: float) -> pb.JournalSummary | None:
        return _first(
            session.get(
                f"{keys.replay_summary(node)}?session={of_session}",
                timeout=left_s,
                congestion_control=qos.CONGESTION,
                priority=qos.COMMAND.priority,
            ),
            lambda payload: parse_summary(payload, node=node, now_ns=time.time_ns()),
        )

    return _until(ask, timeout_s)


def fetch_rows(
    session: zenoh.Session, keys: Keys, node: str, wanted: RowsWanted, *, timeout_s: float
) -> Iterator[pb.JournalRow]:
    """Rows of a node's journal, each once, nearly by sequence; ends when all are there or no more come.

    Args:
        session: open.
        keys: of the site.
        node: its id.
        wanted: which rows; those that the journal lacks are left out.
        timeout_s: since the last row that came.

    Raises:
        DeviceError: the node's answer is an error, or cannot be believed.
    """
    missing = [(wanted.first, wanted.last)]
    end_s = time.monotonic() + timeout_s
    while missing and time.monotonic() < end_s:
        first, last = missing.pop(0)
        part = RowsWanted(wanted.session, wanted.boot, first, last)
        came: set[int] = set()
        is_answered = False
        for rows in _replies(session, keys, node, part, timeout_s=end_s - time.monotonic()):
            is_answered = True
            for sequence, row in sequences_of(rows.rows, part):
                if sequence not in came:
                    came.add(sequence)
                    yield row
            if len(came) > last - first:
                break
        if came:
            end_s = time.monotonic() + timeout_s
            missing = [*_gaps(sorted(came), first, last), *missing]
        elif not is_answered:
            missing.insert(0, (first, last))
            time.sleep(AGAIN_S)


def _replies(
    session: zenoh.Session, keys: Keys, node: str, wanted: RowsWanted, *, timeout_s: float
) -> Iterator[pb.JournalRows]:
    """One request for rows. Replies must not be consolidated: that would hold and shuffle them."""
    answers = session.get(
        f"{keys.replay_rows(node)}?{wanted.parameters}",
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=min(max(timeout_s, AGAIN_S), ASK_S),
        congestion_control=qos.CONGESTION,
        priority=qos.REPLAY.priority,
    )
    for answer in answers:
        payload = _payload(answer)
        if payload is not None:
            yield _believed(parse_rows, payload)


def _gaps(came: list[int], first: int, last: int) -> list[tuple[int, int]]:
    """Ranges of first to last that did not come."""
    edges = [first - 1, *came, last + 1]
    return [(low + 1, high - 1) for low, high in pairwise(edges) if high - low > 1]


def _until(ask: Callable[[float], T | None], timeout_s: float) -> T | None:
    """Ask again until there is an answer or the time is over."""
    end_s = time.monotonic() + timeout_s
    while (left_s := end_s - time.monotonic()) > 0:
        answer = ask(min(left_s, ASK_S))
        if answer is not None:
            return answer
        time.sleep(min(AGAIN_S, max(end_s - time.monotonic(), 0)))
    return None


def _first(answers: Iterable[zenoh.Reply], parse: Callable[[bytes], T]) -> T | None:
    for answer in answers:
        payload = _payload(answer)
        if payload is not None:
            return _believed(parse, payload)
    return None


def _payload(answer: zenoh.Reply) -> bytes | None:
    """Of an answer; None when the time was over.

    Raises:
        DeviceError: the node answered with an error.
    """
    if answer.ok is not None:
        return answer.ok.payload.to_bytes()
    told = b"" if answer.err is None else answer.err.payload.to_bytes()
    if told == TIMEOUT:
        return None
    raise DeviceError(f"a node refused: {told[:MAX_TEXT].decode(errors='replace')}")


def _believed(parse: Callable[[bytes], T], payload: bytes) -> T:
    try:
        return parse(payload)
    except MessageError as error:
        raise DeviceError(f"a node's answer is refused: {error.reason}") from None
