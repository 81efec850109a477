"""What every node does on the bus: observations, status, presence, commands, and replay from its journal.

Nothing here waits for the network but one thread, which opens the session and looks after status and presence. A node
so starts before its router, observes without one, and is found again when one comes back.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Protocol

import zenoh

from nodes.bus import keys as bus_keys
from nodes.bus import qos, replay
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MAX_TEXT, SCHEMA, TYPES
from nodes.bus.command_desk import CommandDesk, Handler
from nodes.bus.keys import Keys, Kind, Role, check_name
from nodes.bus.presence_token import PresenceToken
from nodes.bus.query_worker import QueryWorker
from nodes.bus.seal import seal
from nodes.bus.session import RETRY_S, BusOptions, client_config, open_bus
from nodes.devices.errors import DeviceError
from nodes.journal import Journal

STATUS_S = 1.0
# Closing a session may wait for a router that hangs; a node that was told to end does not.
LEAVE_S = 1.5


class Observed(Protocol):
    """An observation: a protobuf message with a header."""

    @property
    def header(self) -> pb.Header: ...

    def SerializeToString(self) -> bytes: ...


class BusNode:
    """One node on the bus; `with`. Its methods may be called from any thread, and never wait for the network.

    Attributes:
        node: its id.
        journal: its journal; the caller opens and closes it.
        status: gives what the node says of itself, each second; header and journal counts are filled in here.
        on_command: does what a command asks, in a thread of the bus; see `CommandDesk`.

    Raises:
        InputError: a name that cannot stand in a key, or an endpoint that is none.
    """

    def __init__(
        self,
        node: str,
        role: Role,
        options: BusOptions,
        journal: Journal,
        *,
        clock_ns: Callable[[], int] = time.time_ns,
        clock: pb.ClockQuality | None = None,
    ) -> None:
        client_config(options)
        self.node = check_name(node, of="node")
        self.journal = journal
        self.status: Callable[[], pb.NodeStatus] | None = None
        self.on_command: Handler | None = None
        self._role, self._options, self._clock_ns = role, options, clock_ns
        self._clock = clock or pb.ClockQuality()
        self._keys = Keys(options.site)
        self._presence = PresenceToken(self._keys.live(node, role))
        self._publishers: dict[Kind, zenoh.Publisher] = {}
        self._n_sent = 0
        self._fault = ""
        self._stop, self._wake = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"bus {node}", daemon=True)

    def __enter__(self) -> BusNode:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._wake.set()
        self._thread.join(LEAVE_S)

    @property
    def session(self) -> str:
        """The session that is running; empty outside of one. A node that was started again finds itself in it."""
        return self.journal.session

    def observe(self, kind: Kind, message: Observed, *, stamp_ns: int) -> None:
        """Fill the message's header, journal it, publish it.

        A journal that cannot be written is told in the status; the message is published nevertheless.

        Args:
            kind: of the message.
            message: header empty.
            stamp_ns: acquisition of the first thing in it.
        """
        payload = b""

        def build(sequence: int) -> bytes:
            nonlocal payload
            self._fill(message.header, sequence, stamp_ns)
            payload = message.SerializeToString()
            return payload

        try:
            self.journal.append(kind, self._keys.observation(self.node, kind), build)
            self._fault = ""
        except DeviceError as error:
            self._fault = error.message
        publisher = self._publishers.get(kind)
        if publisher is not None:
            self._try_put(publisher, payload, attachment=seal(payload))

    def beat(self) -> None:
        """Data flows: called with each frame or scan. Without a beat for 5 s the node counts as gone."""
        self._presence.beat()
        if not self._presence.is_shown:
            self._wake.set()

    def set_alive(self, is_alive: bool) -> None:
        """As `beat`, or the end of it until the next beat."""
        if is_alive:
            self.beat()
        else:
            self._presence.withdraw()
            self._wake.set()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with open_bus(self._options, stop=self._stop) as session, self._declared(session) as send_status:
                    self._serve(session, send_status)
            except (zenoh.ZError, DeviceError):
                self._stop.wait(RETRY_S)

    @contextmanager
    def _declared(self, session: zenoh.Session) -> Iterator[zenoh.Publisher]:
        """Everything the node has on the bus but its presence."""
        keys, node = self._keys, self.node
        desk = CommandDesk(self.journal, self.on_command)
        with (
            QueryWorker(f"commands {node}", lambda query: self._answer_command(desk, query)) as commands,
            QueryWorker(f"replay {node}", self._answer_replay) as replays,
        ):
            for key, worker in (
                (keys.all_commands(node), commands),
                (keys.replay_rows(node), replays),
                (keys.replay_summary(node), replays),
            ):
                # The callback only enqueues, so it may run in Zenoh's own thread: one thread less for each.
                session.declare_queryable(key, zenoh.handlers.Callback(worker.put, indirect=False))
            self._publishers = {kind: self._publisher(session, kind) for kind in Kind}
            try:
                yield session.declare_publisher(
                    keys.status(node),
                    encoding=qos.encoding_of(pb.NodeStatus),
                    congestion_control=qos.CONGESTION,
                    priority=qos.STATUS.priority,
                )
            finally:
                self._publishers = {}
                self._presence.forget()

    def _publisher(self, session: zenoh.Session, kind: Kind) -> zenoh.Publisher:
        return session.declare_publisher(
            self._keys.observation(self.node, kind),
            encoding=qos.encoding_of(TYPES[kind]),
            congestion_control=qos.CONGESTION,
            priority=qos.OBSERVATION.priority,
        )

    def _serve(self, session: zenoh.Session, send_status: zenoh.Publisher) -> None:
        next_status_s = time.monotonic()
        while not self._stop.is_set():
            self._presence.follow(session)
            if time.monotonic() >= next_status_s:
                self._try_put(send_status, self._status_now().SerializeToString())
                next_status_s = max(next_status_s + STATUS_S, time.monotonic())
                self._flush_journal()
            self._wake.wait(max(next_status_s - time.monotonic(), 0))
            self._wake.clear()

    def _status_now(self) -> pb.NodeStatus:
        try:
            status = self.status() if self.status is not None else pb.NodeStatus()
        except Exception as error:  # a status that cannot be had is told as one
            status = pb.NodeStatus(state="fault", message=f"no status: {type(error).__name__}: {error}")
        self._fill(status.header, self._next_sent(), self._clock_ns())
        status.role = self._role
        try:
            status.journal_rows, status.journal_dropped = self.journal.n_rows, self.journal.n_dropped
        except DeviceError as error:
            self._fault = error.message
        if self._fault:
            status.message = f"{self._fault}; {status.message}".removesuffix("; ")
        status.message = status.message[:MAX_TEXT]
        return status

    def _flush_journal(self) -> None:
        try:
            self.journal.flush()
        except DeviceError as error:
            self._fault = error.message

    def _answer_command(self, desk: CommandDesk, query: zenoh.Query) -> None:
        verb = bus_keys.parse_verb(str(query.key_expr))
        payload, call = query.payload, query.attachment
        reply = desk.answer(
            verb,
            b"" if payload is None else payload.to_bytes(),
            call=b"" if call is None else call.to_bytes(),
            now_ns=self._clock_ns(),
        )
        self._fill(reply.header, self._next_sent(), self._clock_ns())
        key = query.key_expr if verb is None else self._keys.command(self.node, verb)
        query.reply(key, reply.SerializeToString(), encoding=qos.encoding_of(pb.Reply))

    def _answer_replay(self, query: zenoh.Query) -> None:
        rows_key, summary_key = self._keys.replay_rows(self.node), self._keys.replay_summary(self.node)
        if str(query.key_expr) == rows_key:
            for rows in replay.packed(self.journal, replay.parse_rows_wanted(query.parameters)):
                query.reply(rows_key, rows.SerializeToString(), encoding=qos.encoding_of(pb.JournalRows))
            return
        summary = pb.JournalSummary()
        self._fill(summary.header, self._next_sent(), self._clock_ns())
        for span in self.journal.spans(replay.parse_session(query.parameters)):
            summary.spans.add(boot=span.boot, first=span.first, last=span.last, n_dropped=span.n_dropped)
        query.reply(summary_key, summary.SerializeToString(), encoding=qos.encoding_of(pb.JournalSummary))

    def _fill(self, header: pb.Header, sequence: int, stamp_ns: int) -> None:
        header.schema = SCHEMA
        header.node = self.node
        header.boot = self.journal.boot
        header.sequence = sequence
        header.stamp_ns = stamp_ns
        header.clock.CopyFrom(self._clock)
        header.session = self.journal.session

    def _next_sent(self) -> int:
        self._n_sent += 1
        return self._n_sent - 1

    def _try_put(self, publisher: zenoh.Publisher, payload: bytes, *, attachment: bytes | None = None) -> None:
        try:
            publisher.put(payload, attachment=attachment)
        except zenoh.ZError:
            return  # the session is closing; the journal has it
