"""Queries are answered in a thread of their own: Zenoh's must never wait, or everything else on the session does."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType

import zenoh

from nodes.bus.checks import MessageError
from nodes.devices.errors import DeviceError

# More than this many waiting queries are left unanswered; their askers ask again.
MAX_WAITING = 64
# An answer that takes longer is left behind in its thread, which does not keep the process.
LEAVE_S = 0.5


class QueryWorker:
    """A queue of queries and the thread that answers them; `with`.

    A query that is refused (MessageError) or cannot be answered (DeviceError) is answered with the reason.
    """

    def __init__(self, name: str, answer: Callable[[zenoh.Query], None]) -> None:
        self._answer = answer
        self._waiting: queue.Queue[zenoh.Query | None] = queue.Queue(MAX_WAITING)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> QueryWorker:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        # When the queue is full, the thread sees the event after the query at hand.
        with suppress(queue.Full):
            self._waiting.put_nowait(None)
        self._thread.join(LEAVE_S)

    def put(self, query: zenoh.Query) -> None:
        """Zenoh's callback: takes the query, or lets it go when too many wait."""
        try:
            self._waiting.put_nowait(query)
        except queue.Full:
            query.drop()

    def _run(self) -> None:
        while not self._stop.is_set() and (query := self._waiting.get()) is not None:
            with query:
                self._answer_one(query)

    def _answer_one(self, query: zenoh.Query) -> None:
        try:
            try:
                self._answer(query)
            except MessageError as error:
                query.reply_err(error.reason)
            except DeviceError as error:
                query.reply_err(error.message)
            except zenoh.ZError:
                raise
            except Exception as error:  # a defect, but one request must not end the answering of all others
                query.reply_err(f"{type(error).__name__}: {error}")
        except zenoh.ZError:
            return  # the session is closed; whoever asked finds no answer
