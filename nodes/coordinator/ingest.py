"""From the bus into the session: every row of every journal once, whatever the network, the nodes and strangers do.

Zenoh's threads only queue. One worker checks, enters and hands on, and asks the nodes for what is missing; an answer
comes back into the same queue, so that no node is ever waited for.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from types import TracebackType
from typing import Self

import zenoh

from nodes.bus.checks import MAX_MESSAGE_BYTES
from nodes.bus.keys import Keys
from nodes.bus.ledger import Ledger
from nodes.coordinator.asker import Asker
from nodes.coordinator.books import Ask
from nodes.coordinator.catch_up import CatchUp, Completing
from nodes.coordinator.intake import Intake
from nodes.coordinator.missing import MissingReport
from nodes.coordinator.received import Received
from nodes.coordinator.refusals import Refusals
from nodes.devices.errors import DeviceError

TICK_S = 0.05
BATCH = 512
# More than this waits only when the processor cannot follow; then the journals are the queue.
MAX_QUEUED_BYTES = 64 * 2**20
MAX_QUEUED = 200_000
Live = tuple[str, bytes, bytes | None, int]


class Ingest:
    """Runs within a `with` block.

    Args:
        zenoh_session: a client's; stays the caller's.
        keys: of the site.
        session: id of the running session; messages of others are refused.
        sink: gets each row once, in the ingest's own thread; what it raises ends the ingest, and `complete` raises it.
        ledger: rows that are here already, such as those of a recording that goes on.
        refusals: where refusals are counted.
        nodes: who may send; None: whoever does.

    Attributes:
        refusals: by (node or key, reason).
        ledger: belongs to the ingest's thread while it runs.
    """

    def __init__(
        self,
        zenoh_session: zenoh.Session,
        keys: Keys,
        session: str,
        sink: Callable[[Received], None],
        *,
        ledger: Ledger | None = None,
        refusals: Refusals | None = None,
        nodes: Collection[str] | None = None,
    ) -> None:
        self.refusals = Refusals() if refusals is None else refusals
        self.ledger = Ledger() if ledger is None else ledger
        self._zenoh, self._keys = zenoh_session, keys
        self._intake = Intake(session, self._take, ledger=self.ledger, refusals=self.refusals, nodes=nodes)
        self._sink = sink
        asker = Asker(zenoh_session, keys, session, post=self._post, on_answer=self._on_answer, on_end=self._on_end)
        self._catch_up = CatchUp(self._intake, asker.ask)
        self._queue: queue.SimpleQueue[Live | Callable[[], None]] = queue.SimpleQueue()
        # Each of the two is written by one thread only.
        self._n_bytes_in = self._n_bytes_out = 0
        self._n_rows = 0
        self._next_tick_s = 0.0
        self._failure: BaseException | None = None
        self._stop = threading.Event()
        self._worker = threading.Thread(target=self._run, name="ingest", daemon=True)
        self._subscriber: zenoh.Subscriber[None] | None = None

    def __enter__(self) -> Self:
        self._subscriber = self._zenoh.declare_subscriber(self._keys.all_observations, self._on_sample)
        self._worker.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._subscriber is not None:
            self._subscriber.undeclare()
        self._stop.set()
        self._worker.join()

    @property
    def n_rows(self) -> int:
        """Rows that were handed to the sink since the start."""
        return self._n_rows

    @property
    def failure(self) -> BaseException | None:
        """What the sink raised; the ingest takes nothing more then."""
        return self._failure

    def expect(self, node: str) -> None:
        """A node of which something was heard elsewhere, such as its presence; its journal is asked, too."""
        self._post(lambda: self._catch_up.expect(node, time.monotonic()))

    def complete(self, timeout_s: float) -> MissingReport:
        """Fetch what is missing, until nothing is or the time is over.

        Raises:
            DeviceError: the ingest does not run.
        """
        completing = Completing(time.monotonic(), timeout_s)
        self._post(lambda: self._catch_up.complete(completing))
        while not completing.done.wait(TICK_S):
            if not self._worker.is_alive():
                break
        if self._failure is not None:
            raise self._failure
        if completing.report is None:
            raise DeviceError("the ingest does not run, so that nothing can be asked of the nodes")
        return completing.report

    def _on_sample(self, sample: zenoh.Sample) -> None:
        """In Zenoh's thread."""
        arrival_ns = time.time_ns()
        n_bytes = len(sample.payload)
        if n_bytes > MAX_MESSAGE_BYTES:
            self.refusals.count(str(sample.key_expr), "message: too large")
        elif self._n_bytes_in - self._n_bytes_out > MAX_QUEUED_BYTES or self._queue.qsize() > MAX_QUEUED:
            self.refusals.count("(all)", "queue: full")
        else:
            self._n_bytes_in += n_bytes
            attachment = sample.attachment
            seal = None if attachment is None else attachment.to_bytes()
            self._queue.put((str(sample.key_expr), sample.payload.to_bytes(), seal, arrival_ns))

    def _post(self, action: Callable[[], None]) -> None:
        self._queue.put(action)

    def _on_answer(self, ask: Ask, payload: bytes) -> None:
        self._catch_up.answer(ask, payload, now_ns=time.time_ns(), now_s=time.monotonic())

    def _on_end(self, ask: Ask) -> None:
        self._catch_up.end(ask, time.monotonic())

    def _take(self, received: Received) -> None:
        self._sink(received)
        self._n_rows += 1

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._turn()
        except BaseException as error:  # told to whoever asks
            self._failure = error

    def _turn(self) -> None:
        with suppress(queue.Empty):
            self._handle(self._queue.get(timeout=TICK_S))
            for _ in range(BATCH):
                self._handle(self._queue.get_nowait())
        now_s = time.monotonic()
        if now_s >= self._next_tick_s:
            self._next_tick_s = now_s + TICK_S
            self._catch_up.tick(now_s)

    def _handle(self, item: Live | Callable[[], None]) -> None:
        if isinstance(item, tuple):
            key, payload, seal, arrival_ns = item
            self._n_bytes_out += len(payload)
            self._intake.live(key, payload, seal, arrival_ns=arrival_ns, now_s=time.monotonic())
        else:
            item()
