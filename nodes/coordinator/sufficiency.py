"""What is enough: every camera has seen its share, all hang together, and the centres are known well enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from network_calib.observations import FloatArray, IntArray
from nodes.coordinator.coverage import COLUMNS, ROWS, Coverage, common_instants, islands_of, shortest_frame_ns
from nodes.coordinator.live_result import LiveResult


@dataclass(frozen=True, slots=True)
class Needs:
    """What waving has to give.

    Attributes:
        target_sigma_m: of the worst camera's centre, as predicted.
        n_shared: instants that each camera shares with another one.
        coverage: of each camera's picture.
        n_link: common instants that tie two cameras.
    """

    target_sigma_m: float
    n_shared: int = 100
    coverage: float = 0.15
    n_link: int = 50


@dataclass(frozen=True, slots=True)
class Overlaps:
    """Of C cameras, at a moment.

    Attributes:
        names: of the cameras.
        cells: (C, rows, columns) spots by part of the picture.
        shared: (C, C) common instants; the diagonal counts a camera's own.
    """

    names: tuple[str, ...]
    cells: IntArray
    shared: IntArray

    @property
    def coverage(self) -> FloatArray:
        """(C,) share of the picture's cells with a spot."""
        return (self.cells > 0).mean(axis=(1, 2))

    @property
    def best_partner(self) -> IntArray:
        """(C,) common instants with the camera that shares most."""
        others = self.shared - np.diag(np.diag(self.shared))
        return others.max(axis=1, initial=0)

    def islands(self, n_link: int) -> list[tuple[str, ...]]:
        """Names of the cameras that hang together by so many common instants, largest group first."""
        groups = islands_of(self.shared, minimum=n_link) if self.names else []
        return [tuple(self.names[c] for c in group) for group in groups]


def overlaps_of(coverage: Coverage) -> Overlaps:
    """Count the common instants; the one costly look at the coverage."""
    names, stamp_ns, camera = coverage.stamps()
    half_frame_ns = shortest_frame_ns(list(coverage.cameras.values())) // 2
    shared = common_instants(stamp_ns, camera, len(names), half_frame_ns=half_frame_ns) * coverage.stride
    cells = [coverage.cameras[name].cells.copy() for name in names]
    return Overlaps(names, np.array(cells, dtype=np.int64).reshape(len(names), ROWS, COLUMNS), shared)


def waving_lacks(
    overlaps: Overlaps, needs: Needs, *, expected: Sequence[str], live: LiveResult | None
) -> tuple[str, ...]:
    """What waving has not given yet, one phrase each; empty when it is enough.

    Args:
        overlaps: as of now.
        needs: what is enough.
        expected: cameras of the site; others that were seen have to see their share as well.
        live: newest first calibration; None before.
    """
    lacks = [f"{name} has seen nothing" for name in expected if name not in overlaps.names]
    figures = zip(overlaps.names, overlaps.best_partner, overlaps.coverage, strict=True)
    for name, n_shared, coverage in figures:
        if n_shared < needs.n_shared:
            lacks.append(f"{name} shares {n_shared} of {needs.n_shared} instants with another camera")
        elif coverage < needs.coverage:
            lacks.append(f"{name} has spots in {coverage:.0%} of its picture, {needs.coverage:.0%} are wanted")
    islands = overlaps.islands(needs.n_link)
    if len(islands) > 1:
        lacks.append(f"{', '.join(islands[1])} not tied to {', '.join(islands[0])}")
    return (*lacks, *_accuracy_lacks(needs, live))


def _accuracy_lacks(needs: Needs, live: LiveResult | None) -> tuple[str, ...]:
    if live is None:
        return ("no calibration was tried yet",)
    if live.not_yet:
        return (f"not yet: {live.not_yet}",)
    if live.unit == "m" and not live.sigma <= needs.target_sigma_m:
        wanted, found = 1e3 * needs.target_sigma_m, 1e3 * live.sigma
        return (f"{live.worst} is known to {found:.2g} mm, {wanted:.2g} mm are wanted",)
    return ()
