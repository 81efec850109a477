"""Which rows of which journals are here: an idempotent insert, and the gaps.

Memory goes with the number of contiguous runs, not of rows: a boot that arrived without a gap is two numbers.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Gap:
    """Rows of a boot that are not here, `first` to `last` inclusive."""

    boot: bytes
    first: int
    last: int

    @property
    def n_rows(self) -> int:
        return self.last - self.first + 1


class Runs:
    """A set of sequence numbers as its contiguous runs."""

    __slots__ = ("_firsts", "_lasts")

    def __init__(self) -> None:
        self._firsts: list[int] = []
        self._lasts: list[int] = []

    @property
    def n_runs(self) -> int:
        return len(self._firsts)

    @property
    def first(self) -> int:
        """The smallest number; 0 when there is none."""
        return self._firsts[0] if self._firsts else 0

    @property
    def last(self) -> int:
        """The largest number; -1 when there is none."""
        return self._lasts[-1] if self._lasts else -1

    @property
    def n(self) -> int:
        return sum(self._lasts) - sum(self._firsts) + len(self._firsts)

    def add(self, number: int) -> bool:
        """Insert; False when it was here."""
        firsts, lasts = self._firsts, self._lasts
        if lasts and number == lasts[-1] + 1:
            lasts[-1] = number
            return True
        i = bisect_right(firsts, number) - 1
        if i >= 0 and number <= lasts[i]:
            return False
        meets_left = i >= 0 and lasts[i] + 1 == number
        meets_right = i + 1 < len(firsts) and number + 1 == firsts[i + 1]
        if meets_left and meets_right:
            lasts[i] = lasts.pop(i + 1)
            firsts.pop(i + 1)
        elif meets_left:
            lasts[i] = number
        elif meets_right:
            firsts[i + 1] = number
        else:
            firsts.insert(i + 1, number)
            lasts.insert(i + 1, number)
        return True

    def touches(self, number: int) -> bool:
        """Whether the number is here, or lengthens a run."""
        i = bisect_right(self._firsts, number) - 1
        at_left = i >= 0 and number <= self._lasts[i] + 1
        return at_left or (i + 1 < len(self._firsts) and number + 1 == self._firsts[i + 1])

    def missing(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        """Inclusive ranges between two numbers that are not here, in order."""
        i = max(bisect_right(self._firsts, first) - 1, 0)
        for run_first, run_last in zip(self._firsts[i:], self._lasts[i:], strict=True):
            if run_first > last:
                break
            if run_first > first:
                yield first, run_first - 1
            first = max(first, run_last + 1)
        if first <= last:
            yield first, last


class Ledger:
    """Rows by (node, boot, sequence). For one thread."""

    def __init__(self) -> None:
        self._runs: dict[str, dict[bytes, Runs]] = {}

    def insert(self, node: str, boot: bytes, sequence: int) -> bool:
        """Enter a row; False when it was entered before."""
        return self.runs(node, boot).add(sequence)

    def runs(self, node: str, boot: bytes) -> Runs:
        """Of one boot; empty when nothing was entered."""
        boots = self._runs.setdefault(node, {})
        runs = boots.get(boot)
        if runs is None:
            runs = boots[boot] = Runs()
        return runs

    @property
    def nodes(self) -> tuple[str, ...]:
        return tuple(self._runs)

    def boots(self, node: str) -> tuple[bytes, ...]:
        """Of which rows are here."""
        return tuple(boot for boot, runs in self._runs.get(node, {}).items() if runs.n_runs)

    def gaps(self, node: str) -> tuple[Gap, ...]:
        """Between the rows that are here; what came before the first and after the last only the journal knows."""
        return tuple(
            Gap(boot, first, last)
            for boot, runs in self._runs.get(node, {}).items()
            if runs.n_runs > 1
            for first, last in runs.missing(runs.first, runs.last)
        )

    def n_rows(self, node: str | None = None) -> int:
        """Of one node, or of all."""
        nodes = self._runs.values() if node is None else [self._runs.get(node, {})]
        return sum(runs.n for boots in nodes for runs in boots.values())
