"""Numbers and tables for a person: values with their standard deviation, lengths, shares, an empty table."""

from __future__ import annotations

import math

from rich import box
from rich.table import Table


def plus_minus(value: float, sigma: float, *, n_digits: int = 2, max_decimals: int = 9) -> str:
    """Value and standard deviation with so many digits of the latter; a sigma of zero means held fixed."""
    if not math.isfinite(sigma):
        return f"{value:.6g}"
    if sigma <= 0:
        return f"{value:.6g} fixed"
    n_decimals = min(max(n_digits - 1 - math.floor(math.log10(sigma)), 0), max_decimals)
    return f"{value:.{n_decimals}f}±{sigma:.{n_decimals}f}"


def coordinate(value: float, sigma: float) -> str:
    """A position's; the camera that lends the frame has no sigma in it: it is the origin, not held fixed."""
    is_origin = sigma < 1e-7 * max(1.0, abs(value))
    return f"{round(value, 4) + 0.0:.4f}" if is_origin else plus_minus(value, sigma, max_decimals=5)


def length(value: float, unit: str) -> str:
    """A length with a unit that suits its size."""
    if not math.isfinite(value):
        return "–"
    if unit != "m":
        return f"{value:.3g} {unit}s"
    if value < 1e-3:
        return f"{value * 1e6:.3g} µm"
    return f"{value * 1e3:.3g} mm" if value < 1 else f"{value:.4g} m"


def plain_table(title: str, first: str, *heads: str) -> Table:
    """An empty table with a column of names and columns of numbers."""
    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column(first, overflow="fold", min_width=8, max_width=26)
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)  # where it is narrow the names fold, not the numbers
    return table


def share(part: int, whole: int) -> str:
    """A percentage that says 100 only when nothing is missing."""
    if not whole:
        return "–"
    return "100 %" if part == whole else f"{math.floor(1000 * part / whole) / 10:.1f} %"
