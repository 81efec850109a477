"""Rows of the final table, and the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Row:
    """One measured figure.

    Attributes:
        what: what was measured, and on what.
        measured: the figure, in words for a person.
        reach: what it should be; empty where the figure is only reported.
        is_met: whether it is; None where nothing is to be reached, or nothing could be measured.
    """

    what: str
    measured: str
    reach: str = ""
    is_met: bool | None = None

    @property
    def verdict(self) -> str:
        return {True: "pass", False: "MISS", None: "-"}[self.is_met]


@dataclass(frozen=True, slots=True)
class Run:
    """How a benchmark is to run.

    Attributes:
        is_quick: few seeds and small sizes, to see that everything works.
        out: folder for plots and tables.
    """

    is_quick: bool
    out: Path

    def pick(self, full: int, quick: int) -> int:
        """A number of seeds, frames or repetitions."""
        return quick if self.is_quick else full


def at_most(what: str, value: float, reach: float, *, unit: str = "", note: str = "") -> Row:
    """A figure that should not exceed `reach`."""
    return Row(what, _figure(value, unit, note), f"≤ {reach:g}{unit}", bool(value <= reach))


def at_least(what: str, value: float, reach: float, *, unit: str = "", note: str = "") -> Row:
    """A figure that should not fall below `reach`."""
    return Row(what, _figure(value, unit, note), f"≥ {reach:g}{unit}", bool(value >= reach))


def within(what: str, value: float, low: float, high: float, *, unit: str = "", note: str = "") -> Row:
    """A figure that should lie between two."""
    return Row(what, _figure(value, unit, note), f"{low:g}–{high:g}{unit}", bool(low <= value <= high))


def markdown_table(rows: Sequence[Row]) -> str:
    """The rows as a markdown table."""
    lines = ["| what | measured | reach | |", "|---|---|---|---|"]
    lines += [f"| {row.what} | {row.measured} | {row.reach} | {row.verdict} |" for row in rows]
    return "\n".join(lines) + "\n"


def _figure(value: float, unit: str, note: str) -> str:
    return f"{value:.3g}{unit}" + (f" ({note})" if note else "")
