"""What could not be had of the nodes' journals, and why."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from nodes.bus.ledger import Ledger
from nodes.coordinator.books import Book


@dataclass(frozen=True, slots=True)
class Missing:
    """Of one node, and of one of its boots.

    Attributes:
        boot: None when the node said nothing of its boots.
        n_rows: how many rows; 0 when that is not known.
        reason: for a person.
    """

    node: str
    boot: bytes | None
    n_rows: int
    reason: str


@dataclass(frozen=True, slots=True)
class MissingReport:
    """What is missing of a session.

    Attributes:
        nodes: that were asked.
        items: what is missing; empty when nothing is.
        observing: nodes that said that they are still in the session, so that more will come.
    """

    nodes: tuple[str, ...]
    items: tuple[Missing, ...]
    observing: tuple[str, ...] = ()

    @property
    def is_complete(self) -> bool:
        return not self.items

    def __str__(self) -> str:
        if self.is_complete:
            return f"nothing is missing of {len(self.nodes)} nodes"
        return "; ".join(f"{item.node}: {item.reason}" for item in self.items)


def missing_of(books: Iterable[Book], ledger: Ledger, *, since: int) -> MissingReport:
    """What the ledger lacks of what the nodes' newest summaries tell of.

    Args:
        books: of all nodes that were ever seen.
        ledger: what is here.
        since: serial that an answer must not be older than.
    """
    ordered = sorted(books, key=lambda book: book.node)
    items = tuple(item for book in ordered for item in _of_book(book, ledger, since))
    observing = tuple(book.node for book in ordered if book.is_in_session)
    return MissingReport(tuple(book.node for book in ordered), items, observing)


def _of_book(book: Book, ledger: Ledger, since: int) -> Iterator[Missing]:
    if book.answered < since:
        yield Missing(book.node, None, 0, "does not answer, so that nobody knows what its journal still holds")
    not_given: dict[bytes, int] = {}
    for gap in book.gaps(ledger):
        not_given[gap.boot] = not_given.get(gap.boot, 0) + gap.n_rows
    for boot, n in not_given.items():
        yield Missing(book.node, boot, n, f"{n} rows of its journal were not given, or were refused when they came")
    for boot in book.spans:
        n = book.n_given_up(ledger, boot)
        if n:
            yield Missing(book.node, boot, n, f"{n} rows were given up by its journal for want of room")
