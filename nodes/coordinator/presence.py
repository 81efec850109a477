"""Who is there: liveliness tokens (data flows) and the status that each node tells every second.

Zenoh's threads only note; whoever asks for `nodes` has the statuses parsed.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import zenoh

from nodes.bus import checks
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Role, parse_live, parse_status
from nodes.coordinator.refusals import Refusals

# When the coordinator's own router goes away, all tokens are withdrawn at once, and come back with the next one.
GRACE_S = 3.0
MAX_NODES = 4096
MAX_STATUSES, MAX_STATUS_BYTES = 4096, 65536


@dataclass(frozen=True, slots=True)
class NodeSeen:
    """What is known of a node.

    Attributes:
        role: None when neither its token nor its status told.
        is_alive: its data flows.
        status: the newest; None before the first.
        since_s: for how long it has been alive, or has not.
    """

    node: str
    role: Role | None
    is_alive: bool
    status: pb.NodeStatus | None
    since_s: float


@dataclass(slots=True)
class _Entry:
    changed_s: float
    role: Role | None = None
    has_token: bool = False
    is_alive: bool = False
    withdrawn_s: float = 0.0
    status: pb.NodeStatus | None = None

    def look(self, now_s: float) -> None:
        """Believe that a token is gone when it has been for a while."""
        is_alive = self.has_token or (self.is_alive and now_s < self.withdrawn_s + GRACE_S)
        if is_alive != self.is_alive:
            self.is_alive, self.changed_s = is_alive, now_s


class Presence:
    """Runs within a `with` block; from any thread.

    Args:
        zenoh_session: a client's; stays the caller's.
        keys: of the site.
        refusals: where statuses that are refused are counted.
        on_node: called once for each node that is heard of, in Zenoh's thread: must not wait.
        clock_s: monotonic.
    """

    def __init__(
        self,
        zenoh_session: zenoh.Session,
        keys: Keys,
        *,
        refusals: Refusals | None = None,
        on_node: Callable[[str], None] | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.refusals = Refusals() if refusals is None else refusals
        self._zenoh, self._keys, self._on_node, self._clock_s = zenoh_session, keys, on_node, clock_s
        self._entries: dict[str, _Entry] = {}
        self._statuses: deque[tuple[str, bytes, int]] = deque(maxlen=MAX_STATUSES)
        self._lock = threading.Lock()
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def __enter__(self) -> Self:
        self._subscribers = [
            self._zenoh.liveliness().declare_subscriber(self._keys.all_live, self._on_token, history=True),
            self._zenoh.declare_subscriber(self._keys.all_status, self._on_status),
        ]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def nodes(self) -> tuple[NodeSeen, ...]:
        """All that were heard of, by name."""
        with self._lock:
            while self._statuses:
                self._enter_status(*self._statuses.popleft())
            now_s = self._clock_s()
            for entry in self._entries.values():
                entry.look(now_s)
            return tuple(
                NodeSeen(node, entry.role, entry.is_alive, entry.status, now_s - entry.changed_s)
                for node, entry in sorted(self._entries.items())
            )

    def _on_token(self, sample: zenoh.Sample) -> None:
        live = parse_live(str(sample.key_expr))
        if live is None:
            return self.refusals.count(str(sample.key_expr), "key: no node's presence")
        with self._lock:
            entry = self._entry(live.node)
            if entry is None:
                return None
            entry.look(self._clock_s())
            entry.role, entry.has_token = live.role, sample.kind == zenoh.SampleKind.PUT
            entry.withdrawn_s = self._clock_s()
            entry.look(entry.withdrawn_s)
            return None

    def _on_status(self, sample: zenoh.Sample) -> None:
        if len(sample.payload) > MAX_STATUS_BYTES:
            return self.refusals.count(str(sample.key_expr), "status: too large")
        self._statuses.append((str(sample.key_expr), sample.payload.to_bytes(), time.time_ns()))
        return None

    def _enter_status(self, key: str, payload: bytes, arrival_ns: int) -> None:
        node = parse_status(key)
        if node is None:
            return self.refusals.count(key, "key: no status")
        try:
            status = checks.parse_status(payload, node=node, now_ns=arrival_ns)
        except checks.MessageError as error:
            return self.refusals.count(node, error.reason)
        entry = self._entry(node)
        if entry is None:
            return None
        if entry.status is not None and status.header.stamp_ns < entry.status.header.stamp_ns:
            return self.refusals.count(node, "status: older than the one before")
        entry.status = status
        if entry.role is None and status.role in tuple(Role):
            entry.role = Role(status.role)
        return None

    def _entry(self, node: str) -> _Entry | None:
        entry = self._entries.get(node)
        if entry is None:
            if len(self._entries) >= MAX_NODES:
                self.refusals.count(node, "node: too many")
                return None
            entry = self._entries[node] = _Entry(self._clock_s())
            if self._on_node is not None:
                self._on_node(node)
        return entry
