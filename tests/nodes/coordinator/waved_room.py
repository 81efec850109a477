"""A synthetic room as its camera nodes would tell it: spot batches with stamps of a clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.synthetic import Room, observe, room
from nodes.bus import spotcal_pb2 as pb
from nodes.config_model import CameraConfig, RoomConfig, StereoAnchor

FRAMES_PER_BATCH = 2
SIGMA_PX = 0.1


@dataclass(frozen=True)
class WavedRoom:
    truth: Room
    batches: dict[str, list[pb.SpotBatch]]
    config: RoomConfig

    @property
    def names(self):
        return self.truth.cameras.names


def waved_room(*, n_frames, begin_ns=1_790_000_000 * 10**9, n_cameras=None, seed=3, lateness_ns=None):
    """Batches of every camera; `lateness_ns` by camera name shifts its stamps."""
    rng = np.random.default_rng(seed)
    truth = room("smart_room", rng=rng, n_frames=n_frames, n_cameras=n_cameras)
    seen = observe(truth, rng=rng, sigma_px=SIGMA_PX, missing=0.1).observations
    step_ns = round(1e9 / truth.frame_rate_hz)
    late_ns = lateness_ns or {}
    batches = {
        name: _batches(truth, seen, c, begin_ns + late_ns.get(name, 0), step_ns)
        for c, name in enumerate(truth.cameras.names)
    }
    return WavedRoom(truth, batches, _config(truth))


def _config(truth):
    """What a site knows of its cameras: their intrinsics, and the baseline of the stereo pair."""
    cameras = [
        CameraConfig(
            name=name,
            size=[int(side) for side in truth.cameras.size_px[c]],
            lens=truth.cameras.lenses[c].value,
            intrinsics="fixed",
            focal=[float(f) for f in truth.cameras.intrinsics[c, :2]],
            centre=[float(f) for f in truth.cameras.intrinsics[c, 2:4]],
            distortion=[float(d) for d in truth.cameras.intrinsics[c, 4 : 4 + truth.cameras.lenses[c].n_distortion]],
        )
        for c, name in enumerate(truth.cameras.names)
    ]
    names = list(truth.cameras.names[:2])
    return RoomConfig(cameras=cameras, anchor=StereoAnchor(kind="stereo", cameras=names, baseline_m=truth.baseline_m))


def _batches(truth, seen, c, begin_ns, step_ns):
    width, height = (int(side) for side in truth.cameras.size_px[c])
    is_own = seen.camera == c
    px = dict(zip(seen.frame[is_own].tolist(), seen.px[is_own], strict=True))
    batches = []
    for first in range(0, len(truth.trajectory), FRAMES_PER_BATCH):
        batch = pb.SpotBatch(
            camera=truth.cameras.names[c],
            width_px=width,
            height_px=height,
            rate_hz=truth.frame_rate_hz,
            origin=pb.STAMP_ORIGIN_CAMERA,
        )
        for k, frame in enumerate(range(first, min(first + FRAMES_PER_BATCH, len(truth.trajectory)))):
            batch.frame_sequence.append(frame)
            batch.frame_stamp_ns.append(begin_ns + frame * step_ns)
            x, y = px.get(frame, (-1, -1))
            if 0 <= x <= width - 1 and 0 <= y <= height - 1:
                batch.spot_frame.append(k)
                batch.x_px.append(x)
                batch.y_px.append(y)
                batch.sigma_px.append(SIGMA_PX)
                batch.score.append(0.9)
        batches.append(batch)
    return batches
