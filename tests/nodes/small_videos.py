"""Rendered recordings small enough for tests: half the pictures' sides, a short walk."""

from dataclasses import replace

import numpy as np

from network_calib.synthetic import room
from nodes.simulated.rendering.rendered_camera import RenderedCamera
from nodes.simulated.rendering.rendered_files import write_video
from nodes.simulated.rendering.room_scene import CLEAN
from nodes.simulated.rendering.sensor import SensorModel
from nodes.simulated.rendering.spot_path import SpotPath
from nodes.simulated.rendering.video_codec import VideoCodec


def small_room(name, *, n_frames, seed=0, part=0.5):
    """A named room whose cameras have so small a part of their pixels to each side."""
    built = room(name, rng=np.random.default_rng(seed), n_frames=n_frames)
    intrinsics = built.cameras.intrinsics.copy()
    intrinsics[:, :2] *= part
    intrinsics[:, 2:4] = part * (intrinsics[:, 2:4] + 0.5) - 0.5
    size_px = (part * built.cameras.size_px).astype(np.int64)
    return replace(built, cameras=replace(built.cameras, size_px=size_px, intrinsics=intrinsics))


def small_camera(built, index, *, scene=CLEAN, n_empty=0):
    sensor = SensorModel(exposure_s=0.004)
    path = SpotPath.of(built, n_empty=n_empty)
    return RenderedCamera(built.cameras, index, path, scene=scene, sensor=sensor, seed=1)


def write_small_videos(built, folder, *, with_stamps=False, n_frames=None):
    """One lossless video for each camera; the truth of each."""
    truths = []
    for index, name in enumerate(built.cameras.names):
        path = folder / f"{name}.mkv"
        truths.append(write_video(small_camera(built, index), path, codec=VideoCodec.FFV1, n_frames=n_frames))
        if not with_stamps:
            path.with_suffix(".stamps.csv").unlink()
    return truths
