"""What cameras in the room of an emulated platform saw, written as a session folder of real cameras is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from network_calib.formats.table import write_npz
from network_calib.observations import Observations
from network_calib.synthetic import Room
from nodes.simulated.platform import SimulatedPlatform
from nodes.simulation.lrf_simulation import FRAME_RATE_HZ, given_room_toml

SIGMA_PX = 0.2


def write_camera_session(platform: SimulatedPlatform, folder: Path, *, end_s: float, wall_zero_s: float) -> None:
    """Write `table.npz`, with frames and stamps, and `room.toml`, whose intrinsics are known and held.

    Args:
        platform: asked for every frame; its tilt unit must remember its moves.
        folder: made when missing.
        end_s: of the recording, in the platform's time; it begins at 0.
        wall_zero_s: the wall clock, seconds of the Unix epoch, at the platform's time 0.
    """
    cameras = platform.scene.cameras
    time_s = np.arange(0.0, end_s, 1 / FRAME_RATE_HZ)
    px = np.array([platform.detections_px(float(t), sigma_px=SIGMA_PX) for t in time_s]).reshape(-1, len(cameras), 2)
    frame, camera = np.nonzero(np.isfinite(px[:, :, 0]))
    stamp_ns = np.round(1e9 * (wall_zero_s + time_s)).astype(np.int64)
    observations = Observations.from_columns(
        cameras.names,
        camera=camera,
        frame=frame,
        px=px[frame, camera],
        sigma_px=np.full(len(frame), SIGMA_PX),
        stamp_ns=stamp_ns[frame],
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_npz(observations, folder / "table.npz")
    room = Room("emulated", cameras, np.empty((0, 3)), FRAME_RATE_HZ)
    (folder / "room.toml").write_text(given_room_toml(room), encoding="utf-8")
