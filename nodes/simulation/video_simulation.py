"""A simulated recording that begins where a user's does: videos or images of rendered cameras, and the truth."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from network_calib.errors import InputError
from network_calib.formats.calibration_json import save
from network_calib.synthetic import Room, observe, room
from nodes.camera.parallel_cameras import n_usable_processors
from nodes.frames import PixelFormat
from nodes.simulated.rendering.rendered_camera import RenderedCamera
from nodes.simulated.rendering.rendered_files import write_images, write_truth, write_video
from nodes.simulated.rendering.room_scene import RoomScene, scene_named
from nodes.simulated.rendering.sensor import REFERENCE_EXPOSURE_S, SensorModel
from nodes.simulated.rendering.spot_path import SpotPath
from nodes.simulated.rendering.video_codec import VideoCodec
from nodes.simulation.spots_simulation import room_toml, truth_calibration

# What --video may be, and the suffix of each; images have none, being a folder.
FORMATS = {"h264": ".mp4", "ffv1": ".mkv", "images": ""}
FOLDER = "videos"
# Level of the spot that a camera set up with care aims at; dimmer pointers get the sensor's own exposure.
WANTED_LEVEL = 1.2


@dataclass(frozen=True, slots=True)
class VideoPlan:
    """How a room is filmed.

    Attributes:
        format_name: one of FORMATS.
        scene_name: one of `room_scene.SCENES`.
        seed: of the room, the spot's way and the noise.
        n_frames: length of the way; None for the room's own.
    """

    format_name: str
    scene_name: str
    seed: int
    n_frames: int | None

    def __post_init__(self) -> None:
        """Refuse unknown names.

        Raises:
            InputError: says which and what there is.
        """
        if self.format_name not in FORMATS:
            raise InputError(f"--video {self.format_name}: expected one of {', '.join(FORMATS)}")
        scene_named(self.scene_name)


def simulate_videos(name: str, folder: Path, plan: VideoPlan, *, console: Console) -> list[Path]:
    """Film a named room with all its cameras; the same name and plan give the same frames.

    Writes `videos/` with the recording of each camera, its stamps and `C0.truth.csv`, and room.toml and truth.json.

    Returns:
        The recordings, in the order of the cameras.

    Raises:
        SpotcalError: a file cannot be written.
    """
    built = _built(name, plan)
    recordings = [folder / FOLDER / f"{camera}{FORMATS[plan.format_name]}" for camera in built.cameras.names]
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    (folder / "room.toml").write_text(room_toml(built), encoding="utf-8")
    exact = observe(built, rng=np.random.default_rng(plan.seed), sigma_px=0.0)
    save(truth_calibration(built, exact, noise_px=0.0, seed=plan.seed), folder / "truth.json")
    context = multiprocessing.get_context("spawn")
    n_processes = min(n_usable_processors(), len(recordings))
    with (
        ProcessPoolExecutor(n_processes, mp_context=context) as pool,
        Progress(console=console, transient=True) as bar,
    ):
        futures = [pool.submit(_film, name, plan, camera, path) for camera, path in enumerate(recordings)]
        task = bar.add_task("filming", total=len(futures))
        try:
            for future in as_completed(futures):
                future.result()
                bar.advance(task)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return recordings


def camera_of(built: Room, index: int, plan: VideoPlan) -> RenderedCamera:
    """One camera of the room, its exposure set by the pointer's brightness as a careful person sets it."""
    scene = scene_named(plan.scene_name)
    sensor = SensorModel(pixel_format=PixelFormat.BGR, exposure_s=_exposure_s(scene))
    return RenderedCamera(built.cameras, index, SpotPath.of(built), scene=scene, sensor=sensor, seed=plan.seed)


def _exposure_s(scene: RoomScene) -> float:
    return REFERENCE_EXPOSURE_S * min(1.0, WANTED_LEVEL / scene.ball.radiance)


def _built(name: str, plan: VideoPlan) -> Room:
    return room(name, rng=np.random.default_rng(plan.seed), n_frames=plan.n_frames)


def _film(name: str, plan: VideoPlan, index: int, path: Path) -> None:
    """In a process of its own: one camera's recording and truth."""
    camera = camera_of(_built(name, plan), index, plan)
    is_images = plan.format_name == "images"
    truths = write_images(camera, path) if is_images else write_video(camera, path, codec=VideoCodec(plan.format_name))
    write_truth(truths, path.parent / f"{camera.name}.truth.csv")
