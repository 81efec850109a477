"""What is believed of what arrives: whole, of this session, of a boot that its node vouches for, and not here before.

No Zenoh and no thread here. A message is refused with a reason that is counted; memory stays bounded whatever comes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import lru_cache

from nodes.bus import checks
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MessageError
from nodes.bus.keys import ObservationKey, parse_observation
from nodes.bus.ledger import Ledger
from nodes.bus.seal import is_intact
from nodes.coordinator.books import GRACE_S, MAX_HELD, Book, Held, Span
from nodes.coordinator.received import Received
from nodes.coordinator.refusals import Refusals

# A node that fails and is started again every two seconds has 300 boots within ten minutes.
MAX_NODES, MAX_BOOTS, MAX_SPANS, MAX_RUNS = 4096, 4096, 65536, 4096
MAX_HELD_BYTES = 32 * 2**20
# An hour at 30 messages a second. Beyond it, the node's summary is asked before a row is believed.
MAX_JUMP = 100_000
_address = lru_cache(maxsize=8192)(parse_observation)


class Intake:
    """Books and ledger of one session.

    Args:
        session: rows of others are refused.
        sink: gets each row once.
        ledger: rows that are here already.
        refusals: what is refused is counted there.
        nodes: who may send; None: whoever does.
    """

    def __init__(
        self,
        session: str,
        sink: Callable[[Received], None],
        *,
        ledger: Ledger,
        refusals: Refusals,
        nodes: Collection[str] | None = None,
    ) -> None:
        self.ledger = ledger
        self.books: dict[str, Book] = {}
        self.serial = 0
        self.refusals = refusals
        self._session, self._sink = session, sink
        self._nodes = None if nodes is None else frozenset(nodes)
        self._n_held_bytes = 0
        for node in ledger.nodes:
            book = self.book(node)
            if book is not None:
                book.vouched.update(ledger.boots(node))

    def book(self, node: str) -> Book | None:
        """A node's book, opened when it is new; None for a stranger, or one too many."""
        book = self.books.get(node)
        if book is None and len(self.books) < MAX_NODES and (self._nodes is None or node in self._nodes):
            book = self.books[node] = Book(node)
        return book

    def live(self, key: str, payload: bytes, attachment: bytes | None, *, arrival_ns: int, now_s: float) -> None:
        """A message as it came from the bus."""
        where = _address(key)
        if where is None:
            return self.refusals.count(key, "key: no observation")
        if not is_intact(payload, attachment):
            return self.refusals.count(where.node, "seal: broken")
        received = self._checked(where, key, payload, arrival_ns)
        if received is None:
            return None
        book = self.book(received.node)
        if book is None:
            return self.refusals.count(received.node, "node: not of this site, or too many")
        if received.boot not in book.vouched:
            return self._hold(book, received, now_s)
        return self._take_live(book, received, now_s)

    def row(self, node: str, key: str, payload: bytes, *, arrival_ns: int) -> bool:
        """A row of a node's journal, as it was asked for; whether it was missing."""
        where = _address(key)
        if where is None or where.node != node:
            self.refusals.count(node, "row: of another key")
            return False
        received = self._checked(where, key, payload, arrival_ns)
        if received is None:
            return False
        if received.boot not in self.books[node].vouched:
            self.refusals.count(node, "row: of a boot that was not asked for")
            return False
        is_new = self.ledger.insert(node, received.boot, received.sequence)
        if is_new:
            self._sink(received)
        return is_new

    def summary(self, payload: bytes, *, serial: int, now_ns: int, now_s: float) -> None:
        """What a node's journal holds, as asked for at `serial`."""
        try:
            summary = checks.parse(pb.JournalSummary, payload, node=None, now_ns=now_ns)
            spans = _spans(summary)
        except MessageError as error:
            return self.refusals.count("(summaries)", error.reason)
        book = self.book(summary.header.node)
        if book is None:
            return self.refusals.count(summary.header.node, "node: not of this site, or too many")
        is_in_session = summary.header.session == self._session
        book.vouch(spans, serial, self.ledger, is_in_session=is_in_session)
        return self._judge(book, serial, now_s)

    def unanswered(self, book: Book, serial: int, now_s: float) -> None:
        """A question for the summary came back without an answer.

        A node that never answered has no journal, and nothing speaks against its messages: a replayed recording is so.
        """
        if book.answered < 0:
            for held in book.held:
                if held.serial <= serial and len(book.vouched) < MAX_BOOTS:
                    book.vouched.add(held.received.boot)
            self._judge(book, serial, now_s)

    def _checked(self, where: ObservationKey, key: str, payload: bytes, arrival_ns: int) -> Received | None:
        try:
            message = checks.parse_observation(where.kind, payload, node=where.node, now_ns=arrival_ns)
        except MessageError as error:
            self.refusals.count(where.node, error.reason)
            return None
        header = message.header
        if header.session != self._session:
            self.refusals.count(where.node, "header.session: not the running one")
            return None
        return Received(key, where.kind, where.node, header.boot, header.sequence, payload, message, arrival_ns)

    def _hold(self, book: Book, received: Received, now_s: float) -> None:
        book.want_summary(now_s)
        n_bytes = self._n_held_bytes + len(received.payload)
        if len(book.held) >= MAX_HELD or n_bytes > MAX_HELD_BYTES:
            # When the boot is a good one, its journal gives the row back.
            return self.refusals.count(book.node, "header.boot: not vouched for, and too many wait")
        self.serial += 1
        self._n_held_bytes = n_bytes
        book.held.append(Held(received, self.serial))
        return None

    def _judge(self, book: Book, serial: int, now_s: float) -> None:
        """Take or refuse the messages that were there when the question was asked; newer ones wait for the next."""
        judged = [held.received for held in book.held if held.serial <= serial]
        book.held = [held for held in book.held if held.serial > serial]
        self._n_held_bytes -= sum(len(received.payload) for received in judged)
        for received in judged:
            if received.boot in book.vouched:
                self._take_live(book, received, now_s)
            else:
                self.refusals.count(book.node, "header.boot: not in the node's journal")
        if book.held:
            book.want_summary(now_s)

    def _take_live(self, book: Book, received: Received, now_s: float) -> None:
        runs = self.ledger.runs(book.node, received.boot)
        sequence, last = received.sequence, runs.last
        if sequence != last + 1:
            fault = self._fault(book, received)
            if sequence > last:
                book.want_summary(now_s, after_s=GRACE_S)
            if fault:
                return self.refusals.count(book.node, fault)
        if not runs.add(sequence):
            return self.refusals.count(book.node, "header.sequence: doubled")
        return self._sink(received)

    def _fault(self, book: Book, received: Received) -> str:
        """What speaks against a message that is not the next one."""
        runs = self.ledger.runs(book.node, received.boot)
        spans = book.spans.get(received.boot, ())
        front = max(runs.last, *(span.last for span in spans), -1) if spans else runs.last
        is_known = bool(spans) or runs.n_runs > 0
        if is_known and received.sequence > front + MAX_JUMP:
            return "header.sequence: far ahead of the journal"
        if runs.n_runs >= MAX_RUNS and not runs.touches(received.sequence):
            return "header.sequence: too scattered"
        return ""


def _spans(summary: pb.JournalSummary) -> dict[bytes, tuple[Span, ...]]:
    """Spans by boot.

    Raises:
        MessageError: bounds.
    """
    spans: dict[bytes, tuple[Span, ...]] = {}
    if len(summary.spans) > MAX_SPANS:
        raise MessageError("spans: too many")
    for span in summary.spans:
        if len(span.boot) != checks.BOOT_BYTES or span.first > checks.MAX_SEQUENCE or span.last > checks.MAX_SEQUENCE:
            raise MessageError("spans: no boot, or sequence too large")
        spans[span.boot] = (*spans.get(span.boot, ()), Span(span.first, span.last, span.n_dropped))
    if len(spans) > MAX_BOOTS:
        raise MessageError("spans: too many boots")
    return spans
