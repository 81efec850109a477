"""What one node's journal is known to hold, and when the node is asked next.

A gap is never filled on the word of a live message alone: it makes the coordinator ask for the node's summary, and what
the summary vouches for and is not here is then asked for. So a forged sequence of 2**50 costs one question.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from nodes.bus.ledger import Gap, Ledger
from nodes.coordinator.received import Received

ROWS_A_REQUEST = 500
# Messages overtake each other by this much at most within a node; a gap may close by itself.
GRACE_S = 0.2
FIRST_RETRY_S, LAST_RETRY_S = 0.25, 30.0
# A question that has not even ended by then was lost with its session.
LOST_S = 30.0
MAX_HELD = 256
# So many answers without a single missing row in them: the rows are not to be had.
HOPELESS = 3

# Instead of a node's name: the question goes to all journals of the site.
ALL = ""


@dataclass(frozen=True, slots=True)
class Span:
    """Rows of a boot that a journal holds, `first` to `last` inclusive; and how many it gave up for want of room."""

    first: int
    last: int
    n_dropped: int = 0


@dataclass(frozen=True, slots=True)
class Ask:
    """A question to a node: for its summary, or for the rows of `gap`.

    Attributes:
        node: its name, or `ALL`.
        serial: when it was asked, in the order of all questions and of all messages that are held.
    """

    node: str
    serial: int
    gap: Gap | None = None


@dataclass(frozen=True, slots=True)
class Held:
    """A message of a boot that its node has not vouched for yet."""

    received: Received
    serial: int


@dataclass(slots=True)
class Book:
    """Of one node.

    Attributes:
        spans: of each boot that the node vouched for, as of its newest answer.
        vouched: boots that are believed.
        answered: serial of the newest question for a summary that was answered; -1: none was.
        is_in_session: the node said with it that it goes on observing.
        n_silent: questions for a summary without an answer since the last answer.
        n_fruitless: questions for rows that brought none of those missing, since the last that did.
    """

    node: str
    spans: dict[bytes, tuple[Span, ...]] = field(default_factory=dict)
    vouched: set[bytes] = field(default_factory=set)
    held: list[Held] = field(default_factory=list)
    answered: int = -1
    is_in_session: bool = False
    n_silent: int = 0
    n_fruitless: int = 0
    wants_summary: bool = False
    has_gaps: bool = False
    _next_s: float = 0.0
    _summary_s: float = 0.0
    _asking: Ask | None = None

    def want_summary(self, now_s: float, *, after_s: float = 0.0) -> None:
        """Ask for the summary, a little later when a gap may still close by itself."""
        if not self.wants_summary:
            self.wants_summary = True
            self._summary_s = max(self._summary_s, now_s + after_s)

    def hurry(self, now_s: float) -> None:
        """Ask for the summary at once, whatever was tried before."""
        self.wants_summary, self._next_s, self._summary_s = True, now_s, now_s
        self.n_silent = self.n_fruitless = 0

    def next_ask(self, ledger: Ledger, now_s: float, serial: int) -> Ask | None:
        """The question that is due, if any; to be followed by `ended`."""
        if now_s < self._next_s or (self._asking is not None and now_s < self._next_s + LOST_S):
            return None
        gap = None
        if self.wants_summary and now_s >= self._summary_s:
            # Not more often than this, so that a flood of reasons to ask leaves room for asking for rows.
            self.wants_summary, self._summary_s = False, now_s + FIRST_RETRY_S
        elif self.n_silent:
            return None
        else:
            gap = self._next_gap(ledger)
            self.has_gaps = gap is not None
            if gap is None:
                return None
        self._asking, self._next_s = Ask(self.node, serial, gap), now_s
        return self._asking

    def vouch(
        self, spans: dict[bytes, tuple[Span, ...]], serial: int, ledger: Ledger, *, is_in_session: bool = False
    ) -> None:
        """The summary that was asked for at `serial`."""
        self.n_silent = 0
        if serial < self.answered:
            return
        self.answered = serial
        self.spans, self.is_in_session = spans, is_in_session
        self.vouched = {*spans, *ledger.boots(self.node)}
        self.has_gaps = next(self.gaps(ledger), None) is not None

    def ended(self, ask: Ask, now_s: float, *, n_new: int, longest_s: float = LAST_RETRY_S) -> None:
        """The question has had all its answers, of which `n_new` rows were missing here."""
        if self._asking is None or self._asking.serial != ask.serial:
            return
        self._asking = None
        is_in_vain = n_new == 0 if ask.gap is not None else self.answered < ask.serial
        if is_in_vain:
            # An empty answer and none are the same to Zenoh; the summary tells whether the node is there.
            self.wants_summary = True
        if ask.gap is not None:
            self.n_fruitless = self.n_fruitless + 1 if is_in_vain else 0
        elif is_in_vain:
            self.n_silent += 1
        n = max(self.n_silent, self.n_fruitless)
        self._next_s = now_s + (min(FIRST_RETRY_S * 2.0 ** (n - 1), longest_s) if n else 0.0)

    def gaps(self, ledger: Ledger) -> Iterator[Gap]:
        """What the journal holds and the ledger does not."""
        for boot, spans in self.spans.items():
            runs = ledger.runs(self.node, boot)
            for span in spans:
                for first, last in runs.missing(span.first, span.last):
                    yield Gap(boot, first, last)

    def n_given_up(self, ledger: Ledger, boot: bytes) -> int:
        """Rows of a boot that the journal no longer has, and that are not here either."""
        runs, n, after = ledger.runs(self.node, boot), 0, -1
        for span in sorted(self.spans[boot], key=lambda span: span.first):
            # Between two spans there may be rows of other sessions, too: no more are lost than the journal says.
            n_absent = sum(last - first + 1 for first, last in runs.missing(after + 1, span.first - 1))
            n, after = n + min(span.n_dropped, n_absent), span.last
        return n

    def is_settled(self, ledger: Ledger, since: int) -> bool:
        """Whether the node has answered since, and gave all that can be had from it."""
        if self.answered < since:
            return False
        return (self.n_fruitless >= HOPELESS and not self.n_silent) or next(self.gaps(ledger), None) is None

    def _next_gap(self, ledger: Ledger) -> Gap | None:
        """Beginning with another gap after each fruitless question: one bad row must not stand before all others."""
        gaps = [gap for gap, _ in zip(self.gaps(ledger), range(256), strict=False)]
        if not gaps:
            return None
        k = self.n_fruitless % len(gaps)
        # Small gaps that lie close together are fetched at once; what is here already does no harm.
        last = max(gap.last for gap in gaps[k:] if gap.boot == gaps[k].boot)
        return Gap(gaps[k].boot, gaps[k].first, min(last, gaps[k].first + ROWS_A_REQUEST - 1))
