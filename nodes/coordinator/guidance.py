"""Where to wave next, in words: the weakest tie first, then the emptiest picture, then the emptiest part of a room."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from network_calib.observations import IntArray
from nodes.coordinator.live_result import LiveResult
from nodes.coordinator.sufficiency import Needs, Overlaps

# A picture covered so far needs nobody's care.
WELL_COVERED = 0.5
_ROWS, _COLUMNS = ("upper", "middle", "lower"), ("left", "centre", "right")


def where_to_wave(
    overlaps: Overlaps, needs: Needs, *, expected: Sequence[str], live: LiveResult | None
) -> tuple[str, ...]:
    """Advice, the most urgent first; never empty."""
    told = [*_blind(overlaps, expected), *_weakest_link(overlaps, needs), *_emptiest_picture(overlaps)]
    if live is not None and live.not_yet and live.advice:
        told.append(live.advice)
    if live is not None and live.emptiest:
        told.append(f"fewest spots were {live.emptiest}: wave there")
    return tuple(told) or ("go on through the whole room, near and far, high and low",)


def part_of_picture(cells: IntArray) -> str:
    """The ninth of a picture with the fewest spots, in words.

    Args:
        cells: (rows, columns) spots.
    """
    ninths = [np.array_split(band, 3, axis=1) for band in np.array_split(cells, 3, axis=0)]
    filled = np.array([[(part > 0).mean() for part in band] for band in ninths])
    counts = np.array([[part.sum() for part in band] for band in ninths])
    row, column = divmod(int(np.lexsort((counts.ravel(), filled.ravel()))[0]), 3)
    return "centre" if row == column == 1 else f"{_ROWS[row]} {_COLUMNS[column]}"


def _blind(overlaps: Overlaps, expected: Sequence[str]) -> list[str]:
    seeing = {name for name, n in zip(overlaps.names, np.diag(overlaps.shared), strict=True) if n}
    blind = [name for name in (*expected, *overlaps.names) if name not in seeing]
    return [f"wave in front of {', '.join(dict.fromkeys(blind))}: no spot seen there yet"] if blind else []


def _weakest_link(overlaps: Overlaps, needs: Needs) -> list[str]:
    """Of the strongest ties that hold all seeing cameras together, the weakest."""
    seeing = np.flatnonzero(np.diag(overlaps.shared))
    if len(seeing) < 2:
        return []
    a, b = _weakest_of_tree(overlaps.shared[np.ix_(seeing, seeing)])
    first, second = seeing[a], seeing[b]
    n = int(overlaps.shared[first, second])
    if n >= max(needs.n_link, needs.n_shared):
        return []
    pair = f"{overlaps.names[first]} and {overlaps.names[second]}"
    return [f"wave where {pair} both see the spot: {n} common instants tie them"]


def _weakest_of_tree(shared: IntArray) -> tuple[int, int]:
    """Ends of the weakest edge of the spanning tree with the strongest edges."""
    from scipy.sparse.csgraph import minimum_spanning_tree

    # Without common instants a pair is tied by its own spots alone: rather two that see much.
    own = np.minimum.outer(np.diag(shared), np.diag(shared))
    strength = shared + own / (own.max() + 1)
    cost = np.triu(1 / (strength + 1), k=1)
    tree = minimum_spanning_tree(cost).tocoo()
    weakest = int(np.argmax(tree.data))
    return int(tree.row[weakest]), int(tree.col[weakest])


def _emptiest_picture(overlaps: Overlaps) -> list[str]:
    if not len(overlaps.names):
        return []
    c = int(np.argmin(overlaps.coverage))
    coverage = float(overlaps.coverage[c])
    if coverage >= WELL_COVERED:
        return []
    n_filled, n_cells = int((overlaps.cells[c] > 0).sum()), overlaps.cells[c].size
    part = part_of_picture(overlaps.cells[c])
    return [f"wave in the {part} of the picture of {overlaps.names[c]}: spots in {n_filled} of its {n_cells} cells"]
