"""What was refused, counted by who sent it and why, in bounded memory whatever is sent."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass

OTHERS = "(others)"
MAX_SOURCE_CHARACTERS = 120


@dataclass(frozen=True, slots=True)
class Refused:
    """How often one source was refused for one reason.

    Attributes:
        source: a node's name, or a key that is no node's; `OTHERS` for all that were seldom.
        reason: field and fault.
        n: how often.
    """

    source: str
    reason: str
    n: int


class Refusals:
    """Counts by (source, reason); from any thread.

    No count is ever lost: when there are too many pairs, the seldom ones are put together as `OTHERS`. Reasons must
    come from a finite set, sources need not.

    Args:
        max_pairs: (source, reason) pairs that are kept apart.
    """

    def __init__(self, *, max_pairs: int = 2000) -> None:
        self._max_pairs = max_pairs
        self._counts: Counter[tuple[str, str]] = Counter()
        self._lock = threading.Lock()

    def count(self, source: str, reason: str) -> None:
        """One more refusal."""
        with self._lock:
            self._counts[source[:MAX_SOURCE_CHARACTERS], reason] += 1
            if len(self._counts) > self._max_pairs:
                self._fold()

    @property
    def n(self) -> int:
        with self._lock:
            return self._counts.total()

    def top(self, n: int | None = None) -> tuple[Refused, ...]:
        """The most frequent first; all of them without `n`."""
        with self._lock:
            counted = self._counts.most_common(n)
        return tuple(Refused(source, reason, times) for (source, reason), times in counted)

    def by_reason(self) -> Counter[str]:
        """Counts whoever sent it."""
        reasons: Counter[str] = Counter()
        for refused in self.top():
            reasons[refused.reason] += refused.n
        return reasons

    def _fold(self) -> None:
        ranked = self._counts.most_common()
        self._counts = Counter(dict(ranked[: self._max_pairs // 2]))
        for (_, reason), times in ranked[self._max_pairs // 2 :]:
            self._counts[OTHERS, reason] += times
