"""Scans in, their pixels out, without the bus: keeps what is known of every LRF, and counts what could not be done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lrf_stereo.scanner import ScanSteps
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MessageError, Observation, parse_observation
from nodes.bus.keys import Kind
from nodes.bus.keys import parse_observation as parse_key
from nodes.projection.errors import ProjectionError
from nodes.projection.projectors import Projectors
from nodes.projection.scan_message import F4, Column, fill_columns, seen_rows
from nodes.projection.scan_projector import ScanProjector, SeenScan, Sweep
from nodes.projection.tilt_table import TiltTable

if TYPE_CHECKING:
    from nodes.projection.calibration import Calibration

MAX_LRFS = 1024


@dataclass(frozen=True, slots=True)
class StreamCounts:
    """Since the stream began.

    Attributes:
        n_scans: that came to be projected.
        n_projected: of them, were.
        n_published: messages, one for each camera that saw a scan and was subscribed to.
        n_dropped: scans that a newer one took the place of, because the stream was late.
        n_without_tilt: scans whose tilt was not known at any beam.
        n_without_info: scans of an LRF that has not told its steps.
        n_uncalibrated: scans without a calibration, or of an LRF that is not in it.
        n_refused: messages that are none.
        n_failed: scans that could not be projected for a fault of this program.
    """

    n_scans: int = 0
    n_projected: int = 0
    n_published: int = 0
    n_dropped: int = 0
    n_without_tilt: int = 0
    n_without_info: int = 0
    n_uncalibrated: int = 0
    n_refused: int = 0
    n_failed: int = 0


class ScanDesk:
    """Takes checked observations and projects scans. One thread at a time; `counts` for any.

    Args:
        current: the calibration to use now; None while there is none.
        tilts: of all LRFs.
        clock_ns: this machine's clock.
        max_distance_m: cameras that no point of a scan is so near to are left out.
    """

    def __init__(
        self,
        current: Callable[[], Calibration | None],
        tilts: TiltTable,
        clock_ns: Callable[[], int],
        *,
        max_distance_m: float = np.inf,
    ) -> None:
        self._current, self._tilts, self._clock_ns = current, tilts, clock_ns
        self._max_distance_m = max_distance_m
        self._steps: dict[str, ScanSteps] = {}
        self._calibration: Calibration | None = None
        # Its own, not the calibration's: no scan waits for a query.
        self._prepared: Projectors | None = None
        self._projectors: dict[str, ScanProjector] = {}
        self.counts = StreamCounts()

    def take(self, key: str, payload: bytes) -> None:
        """An observation other than a scan."""
        message = self._parsed(key, payload)
        if isinstance(message, pb.LrfInfo):
            self._note_steps(message)
        elif message is not None:
            self._tilts.take(message)

    def project(self, key: str, payload: bytes, *, is_wanted: Callable[[str], bool]) -> Iterator[pb.Projection]:
        """The messages of a scan, one for each camera that sees it; their headers are empty.

        Args:
            key: of the scan.
            payload: of the scan.
            is_wanted: whether anybody listens to a camera.
        """
        scan = self._parsed(key, payload)
        if not isinstance(scan, pb.LrfScan):
            return
        self._count(n_scans=1)
        steps = self._steps.get(scan.lrf)
        if steps is None or steps.n_measured != len(scan.readings_mm):
            self._count(n_without_info=1)
            return
        projector = self._projector(scan.lrf)
        if projector is None or self._calibration is None:
            self._count(n_uncalibrated=1)
            return
        sweep = self._sweep(scan, steps)
        if sweep is None:
            self._count(n_without_tilt=1)
            return
        names = self._calibration.camera_names
        whole = _whole(scan, steps, sweep, projector.clock_offset_s)
        whole.calibration_id = self._calibration.id
        range_m, n_published = sweep.range_m.astype(F4), 0
        for seen in projector.project(sweep, steps, is_wanted=lambda camera: is_wanted(names[camera])):
            first, end = (rows.tolist() for rows in seen_rows(seen.is_valid))
            for row, camera in enumerate(seen.camera.tolist()):
                n_published += 1
                yield _in_camera(whole, names[camera], seen, row, range_m, slice(first[row], end[row]))
        self._count(n_projected=1, n_published=n_published)

    def fail(self) -> None:
        """A scan could not be projected, and nobody knows why."""
        self._count(n_failed=1)

    def longest_m(self, lrf: str) -> float:
        """The longest range that an LRF measures."""
        return self._steps.get(lrf, ScanSteps()).range_max_m

    def _sweep(self, scan: pb.LrfScan, steps: ScanSteps) -> Sweep | None:
        bearing_rad = steps.bearings_rad
        # Scans and tilts are stamped by one clock, the node's; what that lacks to the cameras' does not come in here.
        stamp_ns = scan.stamp_ns + np.rint(1e9 * steps.beam_time_s(bearing_rad)).astype(np.int64)
        try:
            tilt_rad, sigma_rad = self._tilts.at(scan.lrf, stamp_ns)
        except ProjectionError:
            return None
        readings_mm = np.array(scan.readings_mm)
        range_m = np.where(steps.is_range(readings_mm), 1e-3 * readings_mm, np.nan)
        return Sweep(range_m, bearing_rad, tilt_rad, sigma_rad)

    def _projector(self, lrf: str) -> ScanProjector | None:
        calibration = self._current()
        if calibration is not self._calibration or self._prepared is None:
            self._calibration, self._projectors = calibration, {}
            self._prepared = None if calibration is None else Projectors(calibration.result)
        if self._prepared is None or lrf not in self._prepared.scanners:
            return None
        if lrf not in self._projectors:
            self._projectors[lrf] = ScanProjector(
                self._prepared, lrf, longest_m=self.longest_m(lrf), max_distance_m=self._max_distance_m
            )
        return self._projectors[lrf]

    def _note_steps(self, info: pb.LrfInfo) -> None:
        if info.lrf not in self._steps and len(self._steps) >= MAX_LRFS:
            del self._steps[next(iter(self._steps))]
        steps = ScanSteps(
            info.front_step,
            info.steps_per_turn,
            info.first_step,
            info.last_step,
            info.range_min_m,
            info.range_max_m,
            info.turn_s,
        )
        if self._steps.get(info.lrf) != steps:
            self._projectors.pop(info.lrf, None)
        self._steps[info.lrf] = steps

    def _parsed(self, key: str, payload: bytes) -> Observation | None:
        """The message, None where it is refused."""
        address = parse_key(key)
        try:
            if address is None or address.kind is Kind.SPOTS:
                raise MessageError("key: none of an LRF")
            return parse_observation(address.kind, payload, node=address.node, now_ns=self._clock_ns())
        except MessageError:
            self._count(n_refused=1)
            return None

    def _count(self, **more: int) -> None:
        now = self.counts
        self.counts = replace(now, **{name: getattr(now, name) + n for name, n in more.items()})


def _whole(scan: pb.LrfScan, steps: ScanSteps, sweep: Sweep, clock_offset_s: float) -> pb.Projection:
    """What a scan's messages to all cameras share."""
    known = np.flatnonzero(np.isfinite(sweep.tilt_rad))
    return pb.Projection(
        lrf=scan.lrf,
        scan=scan.scan,
        stamp_ns=scan.stamp_ns + round(1e9 * clock_offset_s),
        first_step=steps.first_step,
        step_s=steps.turn_s / steps.steps_per_turn,
        tilt_rad=float(sweep.tilt_rad[known[len(known) // 2]]),
        tilt_sigma_rad=float(np.nanmax(sweep.tilt_sigma_rad)),
    )


def _in_camera(
    whole: pb.Projection, camera: str, seen: SeenScan, row: int, range_m: Column, beams: slice
) -> pb.Projection:
    message = pb.Projection()
    message.CopyFrom(whole)
    message.camera = camera
    message.first_step += beams.start
    fill_columns(message, seen.px[row, beams], range_m[beams], seen.sigma_px[row, beams], seen.is_valid[row, beams])
    return message
