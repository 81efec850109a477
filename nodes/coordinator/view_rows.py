"""Rows of the live view, from who is there and what came in."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Role
from nodes.coordinator.coverage import CameraSeen, LrfSeen
from nodes.coordinator.live_view import CameraRow, LrfRow
from nodes.coordinator.presence import NodeSeen
from nodes.site.model import NodeEntry

_CLOCKS = {pb.CLOCK_SOURCE_NTP: "NTP", pb.CLOCK_SOURCE_PTP: "PTP", pb.CLOCK_SOURCE_FREE: "free"}


class Rates:
    """Frames a second of each camera, by what came in between two looks."""

    def __init__(self) -> None:
        self._before: dict[str, int] = {}
        self._before_s = math.nan
        self.hz: dict[str, float] = {}

    def look(self, n_frames: dict[str, int], *, now_s: float) -> None:
        """Measure since the last look; the first one tells nothing."""
        spent_s = now_s - self._before_s
        if spent_s > 0:
            self.hz = {name: (n - self._before.get(name, 0)) / spent_s for name, n in n_frames.items()}
        self._before, self._before_s = dict(n_frames), now_s


def camera_rows(
    cameras: Sequence[CameraSeen], seen: Sequence[NodeSeen], rates: Rates, *, expected: Sequence[NodeEntry] = ()
) -> tuple[CameraRow, ...]:
    """One for each camera that sent anything, and for each camera node that has not yet, by name."""
    nodes = {node.node: node for node in seen}
    rows = [_camera_row(camera, nodes.get(camera.node), rates) for camera in cameras]
    told = {camera.node for camera in cameras}
    here = {node.node for node in seen if node.role is Role.CAMERA}
    silent = (here | {entry.name for entry in expected if entry.role == Role.CAMERA}) - told
    rows += [_silent_row(name, nodes.get(name)) for name in silent]
    return tuple(sorted(rows, key=lambda row: row.name))


def lrf_rows(lrfs: Iterable[LrfSeen], seen: Sequence[NodeSeen]) -> tuple[LrfRow, ...]:
    """One for each LRF that sent anything, by name."""
    nodes = {node.node: node for node in seen}
    return tuple(_lrf_row(lrf, nodes.get(lrf.node)) for lrf in sorted(lrfs, key=lambda lrf: lrf.name))


def crossings_told(rows: Iterable[LrfRow]) -> tuple[str, ...]:
    """How far each LRF is, in words."""
    return tuple(
        f"{row.name} has {row.n_crossings} crossings at tilt {min(row.setting + 1, row.n_settings)} of {row.n_settings}"
        for row in rows
        if row.n_settings
    )


def warnings_of(seen: Iterable[NodeSeen]) -> tuple[str, ...]:
    """What nodes say of themselves that a person should read."""
    told: list[str] = []
    for node in seen:
        if node.status is None:
            continue
        # While an LRF acquires its tilts its message says how far it is.
        message = "" if node.status.n_settings and node.status.state != "fault" else node.status.message
        told += [f"{node.node}: {text}" for text in (message, *node.status.advice) if text]
        if node.status.journal_dropped:
            told.append(f"{node.node}: its journal gave up {node.status.journal_dropped} rows for want of room")
    return tuple(told)


def _camera_row(camera: CameraSeen, node: NodeSeen | None, rates: Rates) -> CameraRow:
    status = None if node is None else node.status
    return CameraRow(
        name=camera.name,
        is_there=node is not None and node.is_alive,
        state="" if status is None else status.state,
        rate_hz=rates.hz.get(camera.name, 0.0),
        n_frames=camera.n_frames,
        n_seen=camera.n_seen,
        coverage=camera.coverage,
        n_dropped=camera.n_dropped,
        clock="–" if status is None else _clock(status.header.clock),
    )


def _silent_row(name: str, node: NodeSeen | None) -> CameraRow:
    status = None if node is None else node.status
    return CameraRow(
        name=name,
        is_there=node is not None and node.is_alive,
        state="" if status is None else status.state,
        rate_hz=0.0 if status is None else status.rate_hz,
        n_frames=0,
        n_seen=0,
        coverage=0.0,
        n_dropped=0,
        clock="–" if status is None else _clock(status.header.clock),
    )


def _lrf_row(lrf: LrfSeen, node: NodeSeen | None) -> LrfRow:
    status = None if node is None else node.status
    setting = max(lrf.tilt_rad, default=0) if status is None else status.setting
    return LrfRow(
        name=lrf.name,
        is_there=node is not None and node.is_alive,
        state="" if status is None else status.state,
        setting=setting,
        n_settings=0 if status is None else status.n_settings,
        tilt_rad=lrf.tilt_rad.get(setting),
        # The node knows of crossings that it sends only when the tilt ends.
        n_crossings=max(lrf.crossings.get(setting, 0), 0 if status is None else status.n_crossings),
        plane_sigma_m=0.0 if status is None else status.plane_sigma_m,
    )


def _clock(clock: pb.ClockQuality) -> str:
    name = _CLOCKS.get(clock.source, "–")
    return f"{name} {1e3 * clock.sigma_s:.2g} ms" if clock.sigma_s > 0 else name
