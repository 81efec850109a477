"""The spot detector: what a frame costs beside the least that any detector must do, and what it finds in scenes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

from benchmarks.measure import MemoryPeak, in_child
from benchmarks.report import Row, Run, at_least, at_most
from benchmarks.rooms import random_generator
from network_calib.observations import FloatArray
from network_calib.synthetic import room
from nodes.detection.spots import Channel, Detections, DetectorOptions, DetectorState
from nodes.frames import Frame, ImageArray, PixelFormat, StampOrigin
from nodes.simulated.rendering.rendered_camera import RenderedCamera
from nodes.simulated.rendering.room_scene import SCENES
from nodes.simulated.rendering.sensor import SensorModel
from nodes.simulated.rendering.spot_path import SpotPath
from nodes.simulated.rendering.spot_truth import SpotTruth
from nodes.spot_detector import N_SETTLING_FRAMES, SpotDetector

WIDTH, HEIGHT = 1920, 1080
N_LEARNING = 50
N_EMPTY = 60
CAMERAS = (0, 2, 3)
# A candidate is the spot when it is so near to the middle of its light.
NEAR_PX = 2.0
# Before something within a tenth of full scale, a spot adds next to nothing to the picture: a ring around it tells.
GLARE = 230
RING_PX = 4.0
FULL_SHARE = 0.1


@dataclass(slots=True)
class Tally:
    """What became of the frames of one scene while the detector was watching.

    Attributes:
        n_frames: watched.
        n_visible: showed the spot.
        n_before_glare: showed it before something nearly as bright as full scale.
        n_found: of those visible, had it among the candidates.
        n_found_before_glare: the same.
        n_best_wrong: showed the spot, not before glare, but the best candidate was another.
        n_false: candidates that were not the spot, in all frames.
        n_dark: frames without the spot.
        n_dark_false: of these, had a candidate.
        n_relearning: frames not watched after the learning.
        errors_px: distances of found spots from the middle of their light.
    """

    n_frames: int = 0
    n_visible: int = 0
    n_before_glare: int = 0
    n_found: int = 0
    n_found_before_glare: int = 0
    n_best_wrong: int = 0
    n_false: int = 0
    n_dark: int = 0
    n_dark_false: int = 0
    n_relearning: int = 0
    errors_px: list[float] = field(default_factory=list)

    def add(self, frame: Frame, truth: SpotTruth, seen: Detections) -> None:
        """Count a frame."""
        if seen.state is not DetectorState.WATCHING:
            self.n_relearning += seen.state is DetectorState.RELEARNING
            return
        near = NEAR_PX + truth.smear_px / 2 + truth.radius_px / 2
        distances = [float(np.linalg.norm(spot.px - truth.centroid_px)) for spot in seen.spots]
        is_spot = [distance < near for distance in distances]
        self.n_frames += 1
        self.n_false += len(is_spot) - sum(is_spot)
        if not truth.is_visible:
            self.n_dark += 1
            self.n_dark_false += bool(is_spot) and not any(is_spot)
            return
        is_before_glare = _is_before_glare(frame.image, truth)
        self.n_visible += 1
        self.n_before_glare += is_before_glare
        self.n_best_wrong += bool(is_spot) and not is_spot[0] and not is_before_glare
        if any(is_spot):
            self.n_found += 1
            self.n_found_before_glare += is_before_glare
            self.errors_px.append(distances[is_spot.index(True)])


def measure(run: Run) -> Iterator[Row]:
    """Time of a frame, memory, and the hard scenes."""
    yield from _time_rows(run)
    added_mb, frame_mb = in_child(_memory, run.pick(1500, 300))
    yield Row("memory beyond 200 frames, 1080p BGR", f"{added_mb:.1f} MB ({frame_mb:.1f} MB a frame)")
    for name in SCENES:
        yield from _scene_rows(name, run)


def _time_rows(run: Run) -> Iterator[Row]:
    frames = _moving_spot(24, random_generator(0))
    ratio, ours_ms, least_ms = _ratio(frames, run.pick(40, 10))
    yield at_most(
        "1080p BGR, one spot, whole detector over one pass of extractChannel, subtract, minMaxLoc",
        ratio,
        2.0,
        note=f"medians of processor time, interleaved: {ours_ms:.2f} ms over {least_ms:.2f} ms",
    )


def _ratio(frames: list[Frame], n_rounds: int) -> tuple[float, float, float]:
    """Median time of the detector over that of the least pass, and both in ms."""
    cv2.setNumThreads(1)
    empty, moving = frames[0], frames[1:]
    detector = SpotDetector(DetectorOptions(channel=Channel.RED, n_learning_frames=N_LEARNING))
    rng = random_generator(1)
    for _ in range(N_LEARNING):
        detector.process(_with_noise(empty, rng))
    for k in range(N_SETTLING_FRAMES + 1):
        detector.process(moving[k % len(moving)])
    threshold = detector.learnt()[0].threshold
    red, rest = np.empty_like(threshold), np.empty_like(threshold)
    ours, least = [], []
    for _ in range(n_rounds):
        for frame in moving:
            begin = time.process_time()
            cv2.extractChannel(frame.image, 2, red)
            cv2.subtract(red, threshold, dst=rest)
            cv2.minMaxLoc(rest)
            middle = time.process_time()
            found = detector.process(frame)
            end = time.process_time()
            assert len(found.spots) >= 1
            least.append(middle - begin)
            ours.append(end - middle)
    return float(np.median(ours) / np.median(least)), 1e3 * float(np.median(ours)), 1e3 * float(np.median(least))


def _memory(n_frames: int) -> tuple[float, float]:
    """Resident memory added by so many frames after the first 200, and the size of one, MB."""
    frames = _moving_spot(16, random_generator(2))
    detector = SpotDetector(DetectorOptions(n_learning_frames=N_LEARNING))
    for k in range(200):
        detector.process(frames[k % len(frames)])
    with MemoryPeak() as peak:
        for k in range(n_frames):
            detector.process(frames[k % len(frames)])
    return peak.added_mb, frames[0].image.nbytes / 2**20


def _moving_spot(n_frames: int, rng: np.random.Generator) -> list[Frame]:
    """Frames 1080p BGR of a noisy smooth scene; the first is empty, a red spot moves through the others."""
    coarse = rng.uniform(30, 160, (HEIGHT // 60, WIDTH // 60, 3)).astype(np.float32)
    scene = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).clip(25, 170).astype(np.uint8)
    empty = Frame(0, 0, StampOrigin.ORDER, scene, PixelFormat.BGR)
    frames = [empty]
    y, x = np.mgrid[-12:13, -12:13]
    for k in range(1, n_frames):
        frame = _with_noise(empty, rng)
        left, top = 100 + 70 * k, 300 + 20 * k
        light = 180 * np.exp(-((x - 0.3) ** 2 + (y + 0.2) ** 2) / (2 * 1.8**2))
        part = frame.image[top : top + 25, left : left + 25].astype(np.float64)
        part += light[..., None] * [0.2, 0.25, 1.0]
        frame.image[top : top + 25, left : left + 25] = np.minimum(np.rint(part), 255)
        frames.append(frame)
    return frames


def _with_noise(frame: Frame, rng: np.random.Generator) -> Frame:
    """Another frame of the same scene: noise of two counts."""
    noise = np.rint(rng.normal(0, 2, frame.image.shape)).astype(np.int16)
    image = (frame.image.astype(np.int16) + noise).clip(0, 255).astype(np.uint8)
    return Frame(frame.sequence, frame.stamp_ns, frame.origin, image, frame.pixel_format)


def _scene_rows(name: str, run: Run) -> Iterator[Row]:
    tally = Tally()
    n_frames = run.pick(2500, 300) // len(CAMERAS)
    for index in CAMERAS:
        _watch(name, index, n_frames, tally)
    glare = tally.n_before_glare
    clear = tally.n_visible - glare
    found = tally.n_found - tally.n_found_before_glare
    watched = f"{tally.n_frames} frames, {tally.n_visible} with the spot"
    yield at_least(f"{name}: found, of visible spots not before glare", found / max(clear, 1), 0.99, note=watched)
    yield Row(
        f"{name}: found before windows and lamps near full scale",
        f"{tally.n_found_before_glare} of {glare} spots" if glare else "no such spots",
    )
    yield Row(
        f"{name}: best candidate is another, of frames with the spot not before glare",
        f"{tally.n_best_wrong / max(clear, 1):.2%}",
    )
    yield Row(
        f"{name}: false candidates, before any check by geometry",
        f"{tally.n_false / max(tally.n_frames, 1):.2f} a frame; in {tally.n_dark_false} of {tally.n_dark} frames "
        "without the spot",
    )
    errors: FloatArray = np.array(tally.errors_px or [np.nan])
    yield Row(f"{name}: distance from the middle of the light", f"median {np.median(errors):.3f} px")


def _watch(name: str, index: int, n_frames: int, tally: Tally) -> None:
    built = room("smart_room", rng=random_generator(7, index), n_frames=n_frames)
    path = SpotPath.of(built, n_empty=N_EMPTY)
    sensor = SensorModel(pixel_format=PixelFormat.BGR)
    camera = RenderedCamera(built.cameras, index, path, scene=SCENES[name], sensor=sensor, seed=index)
    detector = SpotDetector(DetectorOptions(n_learning_frames=N_LEARNING))
    for k in range(camera.n_frames):
        frame, truth = camera.render(k)
        tally.add(frame, truth, detector.process(frame))


def _is_before_glare(image: ImageArray, truth: SpotTruth) -> bool:
    """Whether a part of a ring around the spot is near full scale without it."""
    turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    reach = truth.radius_px + truth.smear_px / 2 + RING_PX
    px = np.rint(truth.centroid_px + reach * np.stack([np.cos(turn), np.sin(turn)], axis=1)).astype(int)
    inside = px[(px >= 0).all(axis=1) & (px < [image.shape[1], image.shape[0]]).all(axis=1)]
    ring = image[inside[:, 1], inside[:, 0]].max(axis=1)
    return bool(np.mean(ring >= GLARE) > FULL_SHARE) if len(ring) else False
