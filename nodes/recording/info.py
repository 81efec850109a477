"""`spotcal info`: what a recording holds, as tables for a person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from nodes.recording.checked_rows import Checked, CheckedRows, MissingRows, check_rows
from nodes.recording.reader import About, about, rows
from nodes.recording.session_data import SessionData, session_of

S_NS = 1e-9


@dataclass(frozen=True, slots=True)
class BootLine:
    """One boot of one node.

    Attributes:
        node: its id.
        boot: 16 bytes.
        counts: observations by kind.
        first_ns: least stamp.
        last_ns: greatest stamp.
        n_missing: observations that it numbered and that are not there.
    """

    node: str
    boot: bytes
    counts: Counter[str]
    first_ns: int
    last_ns: int
    n_missing: int

    @property
    def span_s(self) -> float:
        return S_NS * (self.last_ns - self.first_ns)

    @property
    def rate_hz(self) -> float | None:
        """Observations a second; None of a single one."""
        n = self.counts.total()
        return (n - 1) / self.span_s if self.span_s > 0 else None


def info(path: Path) -> RenderableType:
    """Tables of nodes, cameras and LRFs, with what was refused and what is missing.

    Raises:
        InputError: nothing there, or no recording.
    """
    told, faults = about(path), Counter[str]()
    checked = check_rows(rows(path, faults=faults), session=told.session, refused=faults)
    data = session_of(checked, site_toml=told.site_toml)
    lines = boot_lines(checked.observations, checked.missing)
    parts: list[RenderableType] = [_heading(told, checked, lines), _nodes(lines)]
    if data.cameras:
        parts.append(_cameras(data))
    if data.lrfs:
        parts.append(_lrfs(data))
    return Group(*parts, *_losses(data))


def boot_lines(observations: Sequence[Checked], missing: Sequence[MissingRows]) -> tuple[BootLine, ...]:
    """One for each boot of each node, in the order of the observations."""
    n_missing: Counter[tuple[str, bytes]] = Counter()
    for gap in missing:
        n_missing[gap.node, gap.boot] += gap.n_rows
    counts: dict[tuple[str, bytes], Counter[str]] = {}
    stamps: dict[tuple[str, bytes], tuple[int, int]] = {}
    for one in observations:
        boot, stamp_ns = (one.header.node, one.header.boot), one.header.stamp_ns
        counts.setdefault(boot, Counter())[one.kind.value] += 1
        first_ns, last_ns = stamps.get(boot, (stamp_ns, stamp_ns))
        stamps[boot] = min(first_ns, stamp_ns), max(last_ns, stamp_ns)
    return tuple(BootLine(*boot, counts[boot], *stamps[boot], n_missing[boot]) for boot in counts)


def _heading(told: About, checked: CheckedRows, lines: Sequence[BootLine]) -> Text:
    site = "with site.toml" if told.site_toml else "without a site.toml"
    text = f"session {checked.session or '(none)'}: {checked.n_rows} rows, {site}"
    if told.program_version:
        text += f", recorded by spotcal {told.program_version}"
    if lines:
        first_ns, last_ns = min(line.first_ns for line in lines), max(line.last_ns for line in lines)
        begin = datetime.fromtimestamp(first_ns // 10**9, tz=UTC)
        text += f"; {S_NS * (last_ns - first_ns):.1f} s from {begin:%Y-%m-%d %H:%M:%S} UTC"
    return Text(text)


def _nodes(lines: Sequence[BootLine]) -> Table:
    table = _table("node", "boot", "observations", "rate Hz", "span s", "missing", left=3)
    for line in lines:
        counts = ", ".join(f"{n} {kind}" for kind, n in sorted(line.counts.items()))
        rate = "-" if line.rate_hz is None else f"{line.rate_hz:.1f}"
        table.add_row(line.node, line.boot.hex()[:8], counts, rate, f"{line.span_s:.1f}", str(line.n_missing))
    return table


def _cameras(data: SessionData) -> Table:
    table = _table("camera", "size px", "frames", "with a spot", "candidates", "rate Hz", "stamps of", "lost", left=1)
    for camera in data.cameras:
        span_s = S_NS * int(camera.stamp_ns.max() - camera.stamp_ns.min())
        rate = f"{(camera.n_frames - 1) / span_s:.1f}" if span_s > 0 else "-"
        size = f"{camera.size_px[0]} x {camera.size_px[1]}"
        seen, found = str(camera.n_seen), str(len(camera.picture))
        lost = str(camera.n_dropped)
        table.add_row(camera.name, size, str(camera.n_frames), seen, found, rate, camera.origin.value, lost)
    return table


def _lrfs(data: SessionData) -> Table:
    table = _table("LRF", "scanner", "tilts deg", "crossings", left=3)
    for lrf in data.lrfs:
        product = "-" if lrf.info is None else f"{lrf.info.product} {lrf.info.serial}".strip()
        tilts = ", ".join(f"{57.29577951308232 * angle:.2f}" for angle in lrf.angle_rad.tolist())
        table.add_row(lrf.name, product, tilts or "-", str(len(lrf.spots)))
    return table


def _losses(data: SessionData) -> list[Text]:
    refused = [f"refused: {n} x {reason}" for reason, n in sorted(data.refused.items())]
    missing = [
        f"missing: {gap.node}, boot {gap.boot.hex()[:8]}: {gap.first} to {gap.last} ({gap.n_rows})"
        for gap in data.missing[:20]
    ]
    if len(data.missing) > 20:
        missing.append(f"missing: {len(data.missing) - 20} more gaps")
    notes = [note for one in (*data.cameras, *data.lrfs) for note in one.notes]
    return [Text(line) for line in (*refused, *missing, *(f"note: {note}" for note in notes))]


def _table(*headers: str, left: int) -> Table:
    """A table whose first columns are words and whose others are numbers."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for k, header in enumerate(headers):
        table.add_column(header, justify="left" if k < left else "right")
    return table
