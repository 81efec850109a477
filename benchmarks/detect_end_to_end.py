"""From rendered recordings to a calibration: spots kept, false ones, error of the cameras, time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.report import Row, Run, at_least, at_most
from network_calib.calibrate import calibrate
from network_calib.candidates import Candidates
from network_calib.choose import choose
from network_calib.errors import SpotcalError
from network_calib.evaluate import evaluate
from network_calib.formats.table import read_candidates
from network_calib.observations import BoolArray, FloatArray
from network_calib.optimum import start_problem
from network_calib.pairs import verify_pairs
from network_calib.room_setup import CameraSetup, KnownDistance
from network_calib.spots import SpotViews
from network_calib.synthetic import Room, Sighting, room
from nodes.camera.detect import detect
from nodes.demo_truth import compare_with_truth
from nodes.detector_settings import DetectorSettings, named_sources
from nodes.simulated.rendering.rendered_files import write_video
from nodes.simulated.rendering.spot_truth import SpotTruth
from nodes.simulated.rendering.video_codec import VideoCodec
from nodes.simulation.video_simulation import VideoPlan, camera_of

ROOM, SEED = "smart_room", 4
# A detection belongs to the spot within this distance, or three of its own sigma where it is smeared.
NEAR_PX, NEAR_SIGMA = 2.0, 3.0
JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True)
class Film:
    """One way to film the room.

    Attributes:
        what: for the table.
        scene_name: see `room_scene.SCENES`.
        kind: `h264`, `ffv1` or `jpeg`.
    """

    what: str
    scene_name: str
    kind: str


FILMS = (
    Film("clean, lossless video", "clean", "ffv1"),
    Film("clean, H.264 of 4 Mbit/s", "clean", "h264"),
    Film("dark room with a person, JPEG images", "dark_room", "jpeg"),
    Film("dark room with a person, lossless video", "dark_room", "ffv1"),
    Film("hard scene, H.264 of 4 Mbit/s", "hard", "h264"),
)


@dataclass(frozen=True, slots=True)
class Found:
    """A table beside the truth.

    Attributes:
        candidates: K rows.
        is_true: (K,) the row shows the spot, be it half hidden.
        is_visible: (K,) the camera had the spot in view: in the picture, and more than half of it.
        n_visible: how often that was so.
    """

    candidates: Candidates
    is_true: BoolArray
    is_visible: BoolArray
    n_visible: int


def measure(run: Run) -> Iterator[Row]:
    """All films; five cameras, 640 x 480."""
    n_frames = run.pick(700, 150)
    for film in FILMS:
        folder = run.out / "detect" / f"{film.scene_name}_{film.kind}"
        folder.mkdir(parents=True, exist_ok=True)
        plan = VideoPlan("ffv1", film.scene_name, SEED, n_frames)
        truths = _filmed(film, plan, folder)
        begin = time.perf_counter()
        sources = named_sources([str(folder / f"{name}{_suffix(film)}") for name in _room(plan).cameras.names])
        detect(sources, DetectorSettings(), folder / "walk.npz", console=Console(quiet=True))
        took_s = time.perf_counter() - begin
        yield Row(f"{film.what}: `detect`, both passes, a frame", f"{1e3 * took_s / (len(sources) * n_frames):.1f} ms")
        yield from _rows(film, _room(plan), _found(read_candidates(folder / "walk.npz"), truths))


def _rows(film: Film, built: Room, found: Found) -> Iterator[Row]:
    sizes_px = {name: (int(w), int(h)) for name, (w, h) in zip(built.cameras.names, built.cameras.size_px, strict=True)}
    chosen = choose(found.candidates, rng=np.random.default_rng(0), size_px=sizes_px)
    is_true = found.is_true & found.is_visible & chosen.is_chosen
    kept = float(is_true.sum() / found.n_visible)
    yield at_least(f"{film.what}: visible spots kept", 100 * kept, 95.0, unit=" %")
    true_rows = found.is_true[chosen.is_chosen]
    yield Row(f"{film.what}: false among the chosen", f"{100 * (1 - true_rows.mean()):.2f} %")
    setups = [CameraSetup(name, sizes_px[name]) for name in found.candidates.camera_names]
    views = SpotViews.of(chosen.observations)
    graph = verify_pairs(start_problem(setups, views), rng=np.random.default_rng(0))
    is_shared = chosen.observations.n_views() >= 2
    false = float((~true_rows[is_shared])[graph.is_inlier].mean())
    yield at_most(f"{film.what}: false after the pairwise check", 100 * false, 1.0, unit=" %")
    anchor = KnownDistance("C0", "C1", built.baseline_m, is_stereo_pair=True)
    try:
        calibration = calibrate(chosen.observations, setups, anchor=anchor)
    except SpotcalError as error:
        yield Row(f"{film.what}: calibration", error.message.splitlines()[0], "no refusal", False)
        return
    inliers = evaluate(calibration, chosen.observations).is_inlier
    false = float((~true_rows[is_shared])[inliers].mean())
    yield at_most(f"{film.what}: false among the calibration's inliers", 100 * false, 1.0, unit=" %")
    sighting = Sighting(chosen.observations, true_rows, chosen.observations.frame)
    cameras = compare_with_truth(calibration, built, sighting).cameras
    yield at_most(f"{film.what}: hold-out RMS", calibration.quality.holdout.rms_px, 0.2, unit=" px")
    worst_m = float(cameras.errors.centre_m.max())
    note = f"worst {1e3 * worst_m:.1f} mm"
    yield at_most(f"{film.what}: centres over their σ", float(cameras.centre_in_sigma.max()), 3.0, note=note)


def _room(plan: VideoPlan) -> Room:
    return room(ROOM, rng=np.random.default_rng(plan.seed), n_frames=plan.n_frames)


def _filmed(film: Film, plan: VideoPlan, folder: Path) -> list[tuple[SpotTruth, ...]]:
    """The recordings of all cameras, and the truth about each frame."""
    n = len(_room(plan).cameras)
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        return list(pool.map(_film_one, [film] * n, [plan] * n, range(n), [folder] * n))


def _film_one(film: Film, plan: VideoPlan, index: int, folder: Path) -> tuple[SpotTruth, ...]:
    camera = camera_of(_room(plan), index, plan)
    if film.kind != "jpeg":
        return write_video(camera, folder / f"{camera.name}{_suffix(film)}", codec=VideoCodec(film.kind))
    import cv2

    (folder / camera.name).mkdir(exist_ok=True)
    truths = []
    for k in range(camera.n_frames):
        frame, truth = camera.render(k)
        cv2.imwrite(str(folder / camera.name / f"{k:06d}.jpg"), frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        truths.append(truth)
    return tuple(truths)


def _suffix(film: Film) -> str:
    return {"jpeg": "", "ffv1": ".mkv", "h264": ".mp4"}[film.kind]


def _found(candidates: Candidates, truths: list[tuple[SpotTruth, ...]]) -> Found:
    px: FloatArray = np.array([[truth.px for truth in of_camera] for of_camera in truths])
    is_visible = np.array([[truth.is_visible for truth in of_camera] for of_camera in truths])
    index = np.array([int(name[1:]) for name in candidates.camera_names])[candidates.camera]
    error_px = np.linalg.norm(candidates.px - px[index, candidates.frame], axis=1)
    is_true = error_px < np.maximum(NEAR_PX, NEAR_SIGMA * candidates.sigma_px)
    return Found(candidates, is_true, is_visible[index, candidates.frame], int(is_visible.sum()))
