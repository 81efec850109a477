"""Fake messages of nodes, as they travel."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind
from nodes.recording.writer import RecordingWriter

START_NS = 1_790_000_000 * 10**9
FRAME_NS = 50_000_000


@dataclass
class FakeNode:
    """Numbers its messages as a journal does."""

    name: str
    boot: bytes = b"\x01" * 16
    session: str = "s1"
    sequence: int = 0
    site: str = "lab"
    rows: list = field(default_factory=list)

    def row(self, kind, message, stamp_ns):
        """(key, payload, stamp_ns), as it is published."""
        message.header.CopyFrom(
            pb.Header(
                schema=1,
                node=self.name,
                boot=self.boot,
                sequence=self.sequence,
                stamp_ns=stamp_ns,
                session=self.session,
            )
        )
        self.sequence += 1
        self.rows.append((Keys(self.site).observation(self.name, kind), message.SerializeToString(), stamp_ns))
        return self.rows[-1]

    def restarted(self, boot):
        return FakeNode(self.name, boot=boot * 16, session=self.session)

    def batch(self, first, n=2, *, camera="C0", begin_ns=START_NS, spots=((0, 10.0, 20.0, 0.2, 0.9),), **fields):
        """Frames first..first+n-1, numbered and stamped 20 times a second; spots: frame, x, y, sigma, score."""
        stamps = [begin_ns + (first + k) * FRAME_NS for k in range(n)]
        columns = list(zip(*spots, strict=True)) or [()] * 5
        defaults = {
            "width_px": 640,
            "height_px": 480,
            "rate_hz": 20,
            "origin": pb.STAMP_ORIGIN_CAMERA,
            "frame_stamp_ns": stamps,
        }
        batch = pb.SpotBatch(
            camera=camera,
            frame_sequence=range(first, first + n),
            spot_frame=columns[0],
            x_px=columns[1],
            y_px=columns[2],
            sigma_px=columns[3],
            score=columns[4],
            **(defaults | fields),
        )
        return self.row(Kind.SPOTS, batch, stamps[0])

    def lrf_spot(self, setting, range_m, *, stamp_ns=START_NS):
        spot = pb.LrfSpot(
            lrf="L0",
            setting=setting,
            stamp_ns=stamp_ns,
            range_m=range_m,
            bearing_rad=0.1,
            range_sigma_m=0.01,
            bearing_sigma_rad=0.002,
            out_of_plane_sigma_m=0.003,
            bias_bound_m=0.0,
        )
        return self.row(Kind.LRF_SPOT, spot, stamp_ns)

    def tilt(self, setting, tilt_rad=0.1, *, stamp_ns=START_NS):
        return self.row(Kind.TILT, pb.TiltSample(lrf="L0", setting=setting, tilt_rad=tilt_rad), stamp_ns)

    def tilts(self, *angle_rad, stamp_ns=START_NS):
        n = len(angle_rad)
        covariance = [1e-6 * (row == column) for row in range(n) for column in range(n)]
        settings = pb.TiltSettings(lrf="L0", angle_rad=angle_rad, covariance_rad2=covariance, sources=["steps"])
        return self.row(Kind.TILTS, settings, stamp_ns)

    def info(self, *, stamp_ns=START_NS):
        info = pb.LrfInfo(
            lrf="L0",
            product="URG",
            serial="7",
            front_step=384,
            steps_per_turn=1024,
            first_step=383,
            last_step=385,
            range_min_m=0.02,
            range_max_m=5.6,
            turn_s=0.1,
        )
        return self.row(Kind.LRF_INFO, info, stamp_ns)

    def scan(self, readings_mm, *, stamp_ns=START_NS):
        scan = pb.LrfScan(lrf="L0", scan=1, stamp_ns=stamp_ns, device_s=1.0, readings_mm=readings_mm)
        return self.row(Kind.LRF_SCAN, scan, stamp_ns)


@pytest.fixture
def node():
    return FakeNode


@pytest.fixture
def recorded(tmp_path):
    """Writes rows (key, payload, stamp_ns), in their order of arrival, into a session folder; gives the folder."""

    def write(rows, name="session", *, session="s1", site="", is_merged=True):
        folder: Path = tmp_path / name
        writer = RecordingWriter(folder, session=session)
        if site:
            writer.write_site(site)
        for key, payload, stamp_ns in rows:
            writer.append(key, payload, log_ns=stamp_ns + 10**8, publish_ns=stamp_ns)
        if is_merged:
            writer.close()
        else:
            writer.abandon()
        return folder

    return write
