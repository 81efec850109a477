"""Asks the nodes for what is missing: summaries now and then and for a reason, rows where a summary tells of gaps.

For one thread, time injected. One question a node at a time; nodes that answer come before those that did not.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from google.protobuf.message import DecodeError

from nodes.bus import spotcal_pb2 as pb
from nodes.coordinator.books import ALL, LAST_RETRY_S, Ask
from nodes.coordinator.intake import Intake
from nodes.coordinator.missing import MissingReport, missing_of

# What was lost at the end of a stream no later message tells of, and a node may have been there before us.
SUMMARIES_EVERY_S = 5.0
# Questions in flight; half of them at most for nodes that did not answer last time.
MAX_ASKING = 64
COMPLETE_RETRY_S = 1.0
# For nodes of which nobody has heard yet to answer the question to all.
UNHEARD_S = 2.0


@dataclass(slots=True)
class Completing:
    """A wish to have everything, and what came of it.

    Attributes:
        report: when `done` is set.
    """

    begin_s: float
    timeout_s: float
    since: int = -1
    report: MissingReport | None = None
    done: threading.Event = field(default_factory=threading.Event)


class CatchUp:
    """The questions of one session.

    Args:
        intake: takes the answers.
        send: sends a question; `answer` for each reply and one `end` follow.
    """

    def __init__(self, intake: Intake, send: Callable[[Ask], None]) -> None:
        self._intake, self._send = intake, send
        self._new_rows: dict[int, int] = {}
        self._next_all_s = -float("inf")
        self._all_ended = -1
        self._completing: Completing | None = None

    def tick(self, now_s: float) -> None:
        """Ask what is due; to be called some 20 times a second."""
        if now_s >= self._next_all_s:
            self._next_all_s = now_s + SUMMARIES_EVERY_S
            self._send(Ask(ALL, self._serial()))
        due = [book for book in self._intake.books.values() if book.wants_summary or book.has_gaps]
        due.sort(key=lambda book: book.n_silent)
        for book in due:
            limit = MAX_ASKING // 2 if book.n_silent else MAX_ASKING
            if len(self._new_rows) >= limit:
                break
            ask = book.next_ask(self._intake.ledger, now_s, self._intake.serial + 1)
            if ask is not None:
                self._new_rows[self._serial()] = 0
                self._send(ask)
        if self._completing is not None:
            self._look_whether_complete(self._completing, now_s)

    def expect(self, node: str, now_s: float) -> None:
        """A node that was heard of; its journal is asked when it was not before."""
        book = self._intake.book(node)
        if book is not None and book.answered < 0:
            book.want_summary(now_s)

    def complete(self, completing: Completing) -> None:
        """Ask everybody again, from now on without long pauses."""
        completing.since = self._intake.serial + 1
        for book in self._intake.books.values():
            book.hurry(completing.begin_s)
        self._completing, self._next_all_s = completing, completing.begin_s

    def answer(self, ask: Ask, payload: bytes, *, now_ns: int, now_s: float) -> None:
        """One reply."""
        if ask.gap is None:
            self._intake.summary(payload, serial=ask.serial, now_ns=now_ns, now_s=now_s)
            return
        try:
            rows = pb.JournalRows.FromString(payload).rows
        except DecodeError:
            self._intake.refusals.count(ask.node, "rows: no protobuf of its type")
            return
        n_new = sum(self._intake.row(ask.node, row.key, row.payload, arrival_ns=now_ns) for row in rows)
        if ask.serial in self._new_rows:
            self._new_rows[ask.serial] += n_new

    def end(self, ask: Ask, now_s: float) -> None:
        """There are no more replies to a question."""
        if ask.node == ALL:
            self._all_ended = max(self._all_ended, ask.serial)
            return
        n_new = self._new_rows.pop(ask.serial, 0)
        book = self._intake.books[ask.node]
        longest_s = LAST_RETRY_S if self._completing is None else COMPLETE_RETRY_S
        book.ended(ask, now_s, n_new=n_new, longest_s=longest_s)
        if book.n_silent and ask.gap is None:
            self._intake.unanswered(book, ask.serial, now_s)

    def _serial(self) -> int:
        self._intake.serial += 1
        return self._intake.serial

    def _look_whether_complete(self, completing: Completing, now_s: float) -> None:
        books, ledger = self._intake.books.values(), self._intake.ledger
        is_over = now_s >= completing.begin_s + completing.timeout_s
        if not is_over:
            has_asked_all = self._all_ended >= completing.since or now_s >= completing.begin_s + UNHEARD_S
            if not has_asked_all or not all(book.is_settled(ledger, completing.since) for book in books):
                return
        self._completing = None
        completing.report = missing_of(books, ledger, since=completing.since)
        completing.done.set()
