"""A recorder that puts what an LRF node's devices sent onto the bus."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Protocol

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Kind
from nodes.bus.node import Observed
from nodes.devices.mti import ImuSample
from nodes.devices.scip import Scan, ScannerInfo
from nodes.lrf.acquisition import SettingData
from nodes.lrf.tilt_of_session import SessionTilts
from nodes.measured_rate import MeasuredRate

IMU_BATCH_S = 0.1
# Outside of an acquisition a scan a second tells what the LRF saw, and spares the room of the others.
SPARSE_S = 1.0
MAX_SIGMA_S = 1e6


class Bus(Protocol):
    """The part of `nodes.bus.node.BusNode` that observations go through."""

    @property
    def session(self) -> str: ...

    def observe(self, kind: Kind, message: Observed, *, stamp_ns: int) -> None: ...

    def beat(self) -> None: ...


class BusRecorder:
    """See `nodes.lrf_node.Recorder`. Outside of a session nothing is published.

    Args:
        bus: the node on it.
        lrf: name of the LRF.
        offset_s: Unix time less the devices' clock, now.

    Attributes:
        setting: number of the tilt that is being acquired.
        is_sparse: one scan a second is enough.
        n_scans: that came.
        rate: of the scans.
    """

    def __init__(self, bus: Bus, lrf: str, *, offset_s: Callable[[], float]) -> None:
        self._bus, self._lrf = bus, lrf
        self._read_offset_s, self._offset_s = offset_s, offset_s()
        self._imu: list[ImuSample] = []
        self._last_scan_s = -math.inf
        self.setting = 0
        self.is_sparse = True
        self.n_scans = 0
        self.rate = MeasuredRate()

    def begin_session(self, now_s: float, info: ScannerInfo) -> None:
        """Tell what the scanner is. The offset of the clocks is read anew: within a session stamps never jump."""
        self._imu.clear()
        self._offset_s = self._read_offset_s()
        steps = info.steps
        message = pb.LrfInfo(
            lrf=self._lrf,
            product=info.product,
            serial=info.serial,
            firmware=info.firmware,
            front_step=steps.front_step,
            steps_per_turn=steps.steps_per_turn,
            first_step=steps.first_step,
            last_step=steps.last_step,
            range_min_m=steps.range_min_m,
            range_max_m=steps.range_max_m,
            turn_s=steps.turn_s,
        )
        self._observe(Kind.LRF_INFO, message, now_s)

    def scan(self, scan: Scan) -> None:
        """A scan, as it came; of a sparse time one a second."""
        self._bus.beat()
        self.n_scans += 1
        self.rate.note(time.monotonic())
        if self.is_sparse and scan.stamp_s < self._last_scan_s + SPARSE_S:
            return
        self._last_scan_s = scan.stamp_s
        message = pb.LrfScan(
            lrf=self._lrf,
            scan=scan.sequence,
            stamp_ns=self._ns(scan.stamp_s),
            sigma_s=min(scan.sigma_s, MAX_SIGMA_S) if scan.sigma_s >= 0 else MAX_SIGMA_S,
            device_s=scan.device_s,
            readings_mm=scan.readings_mm.tolist(),
            intensity=[] if scan.intensity is None else scan.intensity.tolist(),
        )
        self._observe(Kind.LRF_SCAN, message, scan.stamp_s)

    def imu(self, sample: ImuSample) -> None:
        """A sample, as it came; ten messages a second."""
        self._imu.append(sample)
        if sample.arrival_s - self._imu[0].arrival_s >= IMU_BATCH_S:
            samples, self._imu = self._imu, []
            message = pb.ImuBatch(
                lrf=self._lrf,
                sample=[one.sequence for one in samples],
                device_s=[one.device_s for one in samples],
                arrival_ns=[self._ns(one.arrival_s) for one in samples],
                rate_rad_s=[value for one in samples for value in one.rate_rad_s.tolist()],
                acceleration_m_s2=[value for one in samples for value in one.acceleration_m_s2.tolist()],
            )
            self._observe(Kind.IMU, message, samples[0].arrival_s)

    def tilt(self, now_s: float, tilt_rad: float, steps: int | None) -> None:
        """The LRF has come to rest at a tilt."""
        message = pb.TiltSample(
            lrf=self._lrf, setting=self.setting, tilt_rad=tilt_rad, steps=steps or 0, has_steps=steps is not None
        )
        self._observe(Kind.TILT, message, now_s)

    def event(self, now_s: float, text: str) -> None:
        """Something that a reader of the recording should know."""
        self._observe(Kind.EVENT, pb.NodeEvent(text=text), now_s)

    def crossings(self, setting: int, data: SettingData) -> None:
        """What was acquired at a tilt, when it ends."""
        found = data.crossings
        for k in range(len(found)):
            message = pb.LrfSpot(
                lrf=self._lrf,
                setting=setting,
                stamp_ns=self._ns(float(found.time_s[k])),
                range_m=float(found.range_m[k]),
                bearing_rad=float(found.bearing_rad[k]),
                range_sigma_m=float(found.sigma_range_m[k]),
                bearing_sigma_rad=float(found.sigma_bearing_rad[k]),
                out_of_plane_sigma_m=float(found.sigma_out_of_plane_m[k]),
                bias_bound_m=float(found.bias_bound_m[k]),
                n_spots=len(found),
            )
            self._observe(Kind.LRF_SPOT, message, float(found.time_s[k]))

    def tilts(self, now_s: float, tilts: SessionTilts) -> None:
        """The angles of all tilts, at the end."""
        covariance = tilts.tilts.covariance_rad2
        message = pb.TiltSettings(
            lrf=self._lrf,
            angle_rad=tilts.tilts.angle_rad.tolist(),
            covariance_rad2=((covariance + covariance.T) / 2).ravel().tolist(),
            sources=tilts.sources,
            notes=tilts.notes,
        )
        self._observe(Kind.TILTS, message, now_s)

    def _observe(self, kind: Kind, message: Observed, stamp_s: float) -> None:
        if self._bus.session:
            self._bus.observe(kind, message, stamp_ns=self._ns(stamp_s))

    def _ns(self, time_s: float) -> int:
        return round(1e9 * (time_s + self._offset_s))
