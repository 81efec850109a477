"""What the coordinator shows: a table that changes in place on a terminal, a line for what is new elsewhere."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from network_calib.observations import IntArray
from nodes.coordinator.live_result import LiveResult
from nodes.coordinator.phases import Phase
from nodes.report.tables import length, plain_table

# Wider than this a matrix of pairs helps nobody; the groups and the weakest tie stand in words.
MAX_MATRIX = 12
MAX_LINES = 6
# A line of where it stands, where nothing changes.
EVERY_S = 10.0


@dataclass(frozen=True, slots=True)
class CameraRow:
    """One camera; `rate_hz` is measured, `clock` of its node."""

    name: str
    is_there: bool
    state: str
    rate_hz: float
    n_frames: int
    n_seen: int
    coverage: float
    n_dropped: int
    clock: str


@dataclass(frozen=True, slots=True)
class LrfRow:
    """One LRF; `n_crossings` of its present tilt."""

    name: str
    is_there: bool
    state: str
    setting: int
    n_settings: int
    tilt_rad: float | None
    n_crossings: int
    plane_sigma_m: float


@dataclass(frozen=True, slots=True)
class View:
    """Everything that is shown.

    Attributes:
        site: its name.
        session: its id.
        phase: of the session.
        phase_s: since when.
        message: what the person is to do.
        cameras: in the order of their names.
        lrfs: likewise.
        names: of the cameras of `shared`.
        shared: common instants of the pairs.
        islands: groups of cameras that hang together.
        live: newest calibration while waving.
        lacks: what waving has not given yet.
        guidance: where to wave next.
        warnings: of nodes and of the session.
        keys: what may be pressed; empty where nobody can.
    """

    site: str
    session: str
    phase: Phase
    phase_s: float
    message: str
    cameras: tuple[CameraRow, ...] = ()
    lrfs: tuple[LrfRow, ...] = ()
    names: tuple[str, ...] = ()
    shared: IntArray = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))
    islands: tuple[tuple[str, ...], ...] = ()
    live: LiveResult | None = None
    lacks: tuple[str, ...] = ()
    guidance: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    keys: str = ""


def render(view: View) -> Group:
    """For `rich.live`."""
    head = Text.assemble((f"{view.site}, session {view.session}: ", "bold"), (view.phase.value, "bold cyan"))
    head.append(f"  {view.phase_s:.0f} s")
    parts: list[Table | Text] = [head, Text(view.message, style="bold green")]
    if view.cameras:
        parts.append(_cameras(view.cameras))
    if view.lrfs:
        parts.append(_lrfs(view.lrfs))
    if 1 < len(view.names) <= MAX_MATRIX:
        parts.append(_pairs(view.names, view.shared))
    parts += [Text(line) for line in _told(view)]
    parts += [Text(f"warning: {line}", style="yellow") for line in view.warnings[:MAX_LINES]]
    if view.keys:
        parts.append(Text(view.keys, style="dim"))
    return Group(*parts)


class PlainLines:
    """Lines for a log: what changed since the last call, and every ten seconds where it stands."""

    def __init__(self) -> None:
        self._phase: Phase | None = None
        self._message = ""
        self._warnings: set[str] = set()
        self._next_s = 0.0

    def lines(self, view: View, *, now_s: float) -> list[str]:
        """What is new.

        Args:
            view: as of now.
            now_s: any clock that goes on evenly.
        """
        # A warning whose figures alone have changed is not new.
        new = [f"warning: {line}" for line in view.warnings if _without_figures(line) not in self._warnings]
        is_other = view.phase is not self._phase
        is_new = _without_figures(view.message) != _without_figures(self._message)
        if is_other or (is_new and view.phase is not Phase.WAVING):
            new.append(f"{view.phase.value}: {view.message}")
            self._next_s = now_s + EVERY_S
        elif now_s >= self._next_s and not view.phase.is_over:
            new.append(f"{view.phase.value}, {view.phase_s:.0f} s: {view.message}")
            new += [f"  {line}" for line in (*_seen(view), *_told(view))]
            self._next_s = now_s + EVERY_S
        self._phase, self._message = view.phase, view.message
        self._warnings |= {_without_figures(line) for line in view.warnings}
        return new


def _without_figures(line: str) -> str:
    return re.sub(r"[0-9]+", "", line)


def _cameras(rows: Sequence[CameraRow]) -> Table:
    table = plain_table("Cameras", "camera", "state", "frames/s", "frames", "with spot", "picture", "lost", "clock")
    for row in rows:
        state = Text(row.state) if row.is_there else Text("missing", style="bold red")
        figures = (f"{row.rate_hz:.1f}", str(row.n_frames), str(row.n_seen), f"{row.coverage:.0%}", str(row.n_dropped))
        table.add_row(Text(row.name), state, *figures, row.clock)
    return table


def _lrfs(rows: Sequence[LrfRow]) -> Table:
    table = plain_table("Laser range finders", "LRF", "state", "tilt", "angle", "crossings", "plane")
    for row in rows:
        state = Text(row.state) if row.is_there else Text("missing", style="bold red")
        angle = "–" if row.tilt_rad is None else f"{math.degrees(row.tilt_rad):.1f}°"
        plane = length(row.plane_sigma_m, "m") if row.plane_sigma_m > 0 else "–"
        table.add_row(Text(row.name), state, _nth(row), angle, str(row.n_crossings), plane)
    return table


def _nth(row: LrfRow) -> str:
    return f"{min(row.setting + 1, row.n_settings)} of {row.n_settings}" if row.n_settings else "–"


def _pairs(names: Sequence[str], shared: IntArray) -> Table:
    table = plain_table("Common instants", "camera", *names)
    for name, counts in zip(names, shared, strict=True):
        cells = ["" if other == name else str(n) for other, n in zip(names, counts, strict=True)]
        table.add_row(Text(name), *cells)
    return table


def _told(view: View) -> list[str]:
    lines = []
    if len(view.islands) > 1:
        lines.append("not tied together: " + " | ".join(", ".join(island) for island in view.islands[:MAX_LINES]))
    if view.live is not None:
        lines.append(_accuracy(view.live))
    if view.phase in (Phase.WAVING, Phase.TILTS):
        lines += [f"missing: {lack}" for lack in view.lacks[:MAX_LINES]]
        lines += [f"next: {line}" for line in view.guidance[1:MAX_LINES]]
    return lines


def _accuracy(live: LiveResult) -> str:
    if live.not_yet:
        return f"not yet: {live.not_yet.splitlines()[0]}"
    sigma = length(live.sigma, live.unit)
    return f"centres known to {sigma} or better ({live.worst} worst), predicted from {live.n_instants} instants"


def _seen(view: View) -> list[str]:
    seen = ", ".join(
        f"{row.name} {row.n_seen} ({row.coverage:.0%})" for row in view.cameras[:MAX_MATRIX] if row.n_frames
    )
    more = len(view.cameras) - MAX_MATRIX
    lines = [f"spots: {seen}{f' and {more} cameras more' if more > 0 else ''}"] if seen else []
    return lines + [f"{row.name}: tilt {_nth(row)}, {row.n_crossings} crossings" for row in view.lrfs]
