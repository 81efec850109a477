"""What nodes are told, so that they do what the session's phase asks: begun again for whoever comes late or comes back.

Nothing is remembered but which boot of which node has taken which order; so nodes, router and coordinator may fall
out in any order, and what is due follows from the state of the session and the nodes' own status.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from network_calib.errors import SpotcalError
from nodes.bus.keys import Role, Verb
from nodes.coordinator.phases import Phase

RETRY_S = 2.0
# An LRF node that took the order for tilts says so in its next status; one whose acquisition failed is asked again.
TILTS_AGAIN_S = 5.0
N_THREADS = 8
# States of an LRF node that is at its tilts already: a coordinator that came back does not begin them anew.
TILTING = ("moving", "collecting")


@dataclass(frozen=True, slots=True)
class NodeNow:
    """A node as the orders see it.

    Attributes:
        node: its name.
        role: what it is.
        boot: of its newest status.
        session: that it says it is in; empty: none.
        state: that it says it is in.
        is_through: its tilts came in, so that it is not asked for them again.
    """

    node: str
    role: Role
    boot: bytes
    session: str
    state: str
    is_through: bool = False


@dataclass(frozen=True, slots=True)
class Order:
    """One command to one node; `boot` is that of the node when it became due."""

    node: str
    boot: bytes
    verb: Verb


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of an order: empty where the node took it, else why not."""

    order: Order
    refusal: str = ""


def due(phase: Phase, session: str, nodes: Iterable[NodeNow], taken: frozenset[Order]) -> tuple[Order, ...]:
    """Orders that the nodes have not taken yet.

    Args:
        phase: of the session.
        session: its id.
        nodes: that are there.
        taken: orders that their nodes took.
    """
    orders = (_of_node(phase, session, node, taken) for node in nodes)
    return tuple(order for order in orders if order is not None)


def _of_node(phase: Phase, session: str, node: NodeNow, taken: frozenset[Order]) -> Order | None:
    start, tilts = (Order(node.node, node.boot, verb) for verb in (Verb.START, Verb.TILTS))
    if not phase.is_observing:
        is_ours = phase is not Phase.IDLE and node.session == session
        return Order(node.node, node.boot, Verb.STOP) if is_ours else None
    if start not in taken:
        return start
    is_asked = phase is Phase.TILTS and node.role is Role.LRF and not node.is_through
    return tilts if is_asked and node.state not in TILTING else None


class Orders:
    """Gives orders from threads of its own, each until the node takes it.

    Args:
        send: gives a command and returns when the node took it.
        clock_s: monotonic.
    """

    def __init__(self, send: Callable[[str, Verb], None], *, clock_s: Callable[[], float]) -> None:
        self._send, self._clock_s = send, clock_s
        self._pool = ThreadPoolExecutor(N_THREADS, thread_name_prefix="orders")
        self._lock = threading.Lock()
        self._taken: set[Order] = set()
        self._not_before_s: dict[Order, float] = {}
        self._refusals: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._pool.shutdown(cancel_futures=True)

    def step(self, phase: Phase, session: str, nodes: Iterable[NodeNow]) -> None:
        """Give what is due, and not under way."""
        now_s = self._clock_s()
        with self._lock:
            orders = due(phase, session, nodes, frozenset(self._taken))
            begun = [order for order in orders if self._not_before_s.get(order, 0.0) <= now_s]
            self._not_before_s.update(dict.fromkeys(begun, float("inf")))
        for order in begun:
            self._pool.submit(self._give, order)

    def once(self, verb: Verb, nodes: Iterable[str]) -> list[Future[None]]:
        """Give a command that is not repeated: relearn, next, and stop at the end."""
        return [self._pool.submit(self._give, Order(node, b"", verb)) for node in nodes]

    @property
    def refusals(self) -> tuple[str, ...]:
        """Orders that nodes have not taken so far, in words."""
        with self._lock:
            return tuple(f"{node}: {reason}" for node, reason in sorted(self._refusals.items()))

    def _give(self, order: Order) -> None:
        refusal = ""
        try:
            self._send(order.node, order.verb)
        except SpotcalError as error:
            refusal = f"{order.verb}: {error.message}"
        with self._lock:
            is_tilts = order.verb is Verb.TILTS and not refusal
            self._not_before_s[order] = self._clock_s() + (TILTS_AGAIN_S if is_tilts else RETRY_S)
            if refusal:
                self._refusals[order.node] = refusal
                return
            self._refusals.pop(order.node, None)
            # A node that was told to stop has to be told to start again, and to be stopped again where it did not.
            if order.verb is Verb.STOP:
                self._taken = {one for one in self._taken if one.node != order.node}
            elif not is_tilts:
                self._taken.add(order)
