"""The builders behind `synthetic.room`: cameras and the way of the spot for each named room.

A builder takes the number of cameras, the number of frames and a generator, draws the cameras first and then the way,
and returns cameras, trajectory (F, 3) in metres, and frame rate. To add a room, write a builder and a row of PLANS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from network_calib.cameras import Cameras, LensModel, distort, poses_from_centres
from network_calib.observations import FloatArray

FRAME_RATE_HZ = 25.0
MEAN_SPEED_M_S = 1.25
HEIGHT_M = (0.2, 2.2)
HALL_STEP_M = 1.1
Built = tuple[Cameras, FloatArray, float]


@dataclass(frozen=True, slots=True)
class Plan:
    """How a room is built, and its own numbers: cameras, their fewest and most, frames."""

    build: Callable[[int, int, np.random.Generator], Built]
    n_cameras: int
    fewest: int
    most: int
    n_frames: int = 2000
    n_frames_per_camera: int = 0


def look_at(centre_in_world: FloatArray, target_in_world: FloatArray) -> FloatArray:
    """(..., 3, 3) cam_from_world of upright cameras at (..., 3) that look at (..., 3); never straight up or down."""
    forward = _unit(np.asarray(target_in_world) - centre_in_world)
    right = _unit(np.cross(forward, [0.0, 0.0, 1.0]))
    return np.stack([right, np.cross(forward, right), forward], axis=-2)


def _unit(vector: FloatArray) -> FloatArray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


# The way of the spot


def _walk(
    low_m: tuple[float, ...],
    high_m: tuple[float, ...],
    n_frames: int,
    rng: np.random.Generator,
    *,
    travel_m: float = 0.0,
    frame_rate_hz: float = FRAME_RATE_HZ,
) -> FloatArray:
    """(F, D) smooth way of a hand through a box, which itself travels along the first axis.

    Each coordinate is a band-limited Gaussian process pressed into (0, 1) by its own distribution, so that it spends
    equal time at every place; the curve is then run through at a speed between 0.65 and 1.85 m/s.
    """
    low, size = np.array(low_m), np.array(high_m) - np.array(low_m)
    # Slow along the long sides and fast along the short ones, so that no direction dominates the speed.
    wave = rng.uniform(0.5, 2.0, (8, len(low))) * np.pi / size
    phase = rng.uniform(0, 2 * np.pi, wave.shape)
    beat, beat_phase = rng.uniform(0.1, 0.5, (4, 1)), rng.uniform(0, 2 * np.pi, (4, 1))
    beat_angle = 2 * np.pi * beat * np.arange(n_frames) / frame_rate_hz + beat_phase
    speed = MEAN_SPEED_M_S + 1.2 * (ndtr(np.cos(beat_angle).sum(axis=0) / np.sqrt(2)) - 0.5)
    walked = np.cumsum(speed) / frame_rate_hz

    def place(part: FloatArray, extent: float) -> FloatArray:
        process = sum((np.cos(extent * part[:, None] * w + p) for w, p in zip(wave, phase, strict=True)), 0.0)
        out = low + size * ndtr(process / 2)
        out[:, 0] += travel_m * part
        return out

    # The curve is stretched until its length is the length that is walked; eight rounds leave less than 1 %.
    extent, part, length = float(walked[-1]), np.linspace(0, 1, 6 * n_frames + 200), walked
    for _ in range(8):
        extent *= float(walked[-1] / length[-1])
        length = np.cumsum(np.linalg.norm(np.diff(place(part, extent), axis=0), axis=1))
    return place(np.interp(walked * (length[-1] / walked[-1]), np.append(0.0, length), part), extent)


def _waved(low_xy: tuple[float, float], high_xy: tuple[float, float], n: int, rng: np.random.Generator) -> FloatArray:
    """(F, 3) way of the spot over a rectangle of floor, from knee to overhead."""
    return _walk((*low_xy, HEIGHT_M[0]), (*high_xy, HEIGHT_M[1]), n, rng)


# The cameras


def _posed(
    centres: FloatArray,
    targets: FloatArray,
    rng: np.random.Generator,
    *,
    intrinsics: FloatArray | None = None,
    size_px: tuple[int, int] = (640, 480),
    lens: LensModel = LensModel.K1_K2,
) -> Cameras:
    """Cameras that look at their targets, turned by a degree or two at random as mounted by hand."""
    n = len(centres)
    mounted = Rotation.from_rotvec(np.radians(1.5) * rng.standard_normal((n, 3))).as_matrix()
    rotations = mounted @ look_at(centres, targets)
    rows = _surveillance_lenses(n, rng) if intrinsics is None else intrinsics
    return Cameras(
        names=tuple(f"C{i}" for i in range(n)),
        size_px=np.tile(np.array(size_px, dtype=np.int64), (n, 1)),
        lenses=(lens,) * n,
        intrinsics=rows,
        cam_from_world=poses_from_centres(rotations, centres),
    )


def _surveillance_lenses(n: int, rng: np.random.Generator) -> FloatArray:
    """(n, 8) lenses for 640 x 480: square pixels, barrel distortion, principal point off by several px."""
    rows = np.zeros((n, 8))
    rows[:, :2] = rng.uniform(400, 520, (n, 1))
    rows[:, 2:4] = np.array([319.5, 239.5]) + rng.choice([-1, 1], (n, 2)) * rng.uniform(3, 12, (n, 2))
    rows[:, 4] = rng.uniform(-0.30, -0.20, n)
    rows[:, 5] = rng.uniform(0.05, 0.08, n)
    return rows


def _fisheye_lenses(n: int, size_px: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    """(n, 8) fisheye lenses whose image diagonal spans 150 to 170 degrees."""
    rows = np.zeros((n, 8))
    rows[:, 4:] = np.array([-0.02, 0.004, -0.002, 0.0002]) * rng.uniform(0.8, 1.2, (n, 4))
    half_angle = np.radians(rng.uniform(150, 170, n) / 2)
    edge = distort(rows[:, 4:], np.ones(n, dtype=bool), np.stack([np.tan(half_angle), np.zeros(n)], axis=1))[:, :1]
    rows[:, :2] = np.hypot(*size_px) / 2 / edge
    rows[:, 2:4] = (np.array(size_px) - 1) / 2 + rng.uniform(-8, 8, (n, 2))
    return rows


def _smart_cameras(n: int, rng: np.random.Generator) -> Cameras:
    """The stereo pair on a wall of a 6 x 5 x 2.8 m room, the others in its corners."""
    half = rng.uniform(0.15, 0.20)
    corners = [[0.15, 4.85, 2.5], [5.85, 4.85, 2.4], [5.85, 0.15, 2.6], [0.15, 0.15, 2.6]]
    centres = np.array([[3 - half, 0.15, 2.4], [3 + half, 0.15, 2.4], *corners])[:n]
    targets = np.array([[3 - half, 3.0, 1.0], [3 + half, 3.0, 1.0], *[[3.0, 2.5, 1.0]] * 4])[:n]
    return _posed(centres, targets, rng)


def _ring_cameras(n: int, rng: np.random.Generator) -> Cameras:
    """A ring of 4.5 m radius, alternately high and low, looking inwards."""
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(-0.1, 0.1, n)) / n
    height = np.where(np.arange(n) % 2 == 0, 2.7, 1.8)
    centres = np.stack([4.5 * np.cos(angle), 4.5 * np.sin(angle), height], axis=1)
    return _posed(centres, np.tile([0.0, 0.0, 1.2], (n, 1)) + 0.2 * rng.standard_normal((n, 3)), rng)


def _hall_cameras(n: int, rng: np.random.Generator) -> Cameras:
    """Along a hall 5 m wide, alternately on both walls, looking across; C0 and C1 side by side on one wall."""
    x = np.append(0.0, 0.35 + HALL_STEP_M * np.arange(n - 1))
    is_far_wall = np.append(False, np.arange(n - 1) % 2 == 1)
    slant = np.append([0.0, 0.0], rng.uniform(-0.3, 0.3, n - 2))
    centres = np.stack([x, np.where(is_far_wall, 4.85, 0.15), np.full(n, 2.6)], axis=1)
    targets = np.stack([x + slant, np.where(is_far_wall, 1.6, 3.4), np.full(n, 0.9)], axis=1)
    return _posed(centres, targets, rng)


def _facing_cameras(n: int, rng: np.random.Generator) -> Cameras:
    """Two pairs on opposite walls, level enough to have each other in view."""
    centres = np.array([[2.83, 0.15, 2.0], [3.17, 0.15, 2.0], [2.5, 4.85, 2.1], [3.5, 4.85, 1.9]])[:n]
    targets = np.array([[2.83, 5.0, 1.3], [3.17, 5.0, 1.3], [2.7, 0.0, 1.3], [3.3, 0.0, 1.3]])[:n]
    return _posed(centres, targets, rng)


def _fisheye_cameras(n: int, rng: np.random.Generator) -> Cameras:
    """The smart room seen by four fisheye cameras."""
    size_px = (1280, 960)
    half = rng.uniform(0.15, 0.20)
    centres = np.array([[3 - half, 0.15, 2.4], [3 + half, 0.15, 2.4], [0.15, 4.85, 2.5], [5.85, 4.85, 2.4]])[:n]
    targets = np.array([[3 - half, 3.0, 1.0], [3 + half, 3.0, 1.0], [3.0, 2.5, 1.0], [3.0, 2.5, 1.0]])[:n]
    lenses = _fisheye_lenses(n, size_px, rng)
    return _posed(centres, targets, rng, intrinsics=lenses, size_px=size_px, lens=LensModel.FISHEYE)


def _mixed_cameras(n: int, rng: np.random.Generator) -> Cameras:
    """Focal lengths from 300 to 2500 px; the longer the lens, the straighter its picture."""
    centres = np.array([[2.83, 0.15, 2.4], [3.17, 0.15, 2.4], [0.15, 4.85, 2.5], [5.85, 4.85, 2.4], [8.0, -3.0, 2.6]])
    targets = np.array([[2.83, 3.0, 1.0], [3.17, 3.0, 1.0], [3.0, 2.5, 1.0], [2.8, 2.3, 1.1], [3.0, 2.5, 1.2]])
    focal_px = np.array([450.0, 470.0, 300.0, 900.0, 2500.0])
    lenses = np.zeros((5, 8))
    lenses[:, :2] = focal_px[:, None]
    lenses[:, 2:4] = np.array([399.5, 299.5]) + rng.uniform(-10, 10, (5, 2))
    lenses[:, 4] = rng.uniform(-0.25, -0.20, 5) * np.minimum(1, 450 / focal_px)
    lenses[:, 5] = 0.06 * np.minimum(1, 450 / focal_px)
    return _posed(centres[:n], targets[:n], rng, intrinsics=lenses[:n], size_px=(800, 600))


def _shelf_cameras(n: int, rng: np.random.Generator) -> Cameras:
    """All centres on one straight shelf along a wall."""
    along = np.concatenate([[0.45, 0.51], np.linspace(0.05, 0.95, n - 2)])
    centres = np.array([0.2, 0.15, 2.2]) + along[:, None] * np.array([5.6, 0.0, 0.4])
    targets = np.stack([np.full(n, 3.0), rng.uniform(2.8, 3.6, n), rng.uniform(0.8, 1.2, n)], axis=1)
    return _posed(centres, targets, rng)


def _island_cameras(n: int, rng: np.random.Generator) -> Cameras:
    """Two groups, back to back 5 m apart, each in front of a room of its own."""
    is_second = np.arange(n) >= (n + 1) // 2
    n_first = int((~is_second).sum())
    y = np.concatenate([[2.3, 2.65], np.linspace(0.3, 4.7, n_first - 2), np.linspace(0.3, 4.7, n - n_first)])
    height = np.where(np.arange(n) % 2 == 0, 2.6, 2.2)
    height[1] = height[0]
    centres = np.stack([np.where(is_second, 10.0, 5.0), y, height], axis=1)
    return _posed(centres, np.stack([np.where(is_second, 12.8, 2.2), 0.5 * (y + 2.5), np.full(n, 1.0)], axis=1), rng)


# The rooms


def _in_box(
    cameras: Callable[[int, np.random.Generator], Cameras], low_xy: tuple[float, float], high_xy: tuple[float, float]
) -> Callable[[int, int, np.random.Generator], Built]:
    """A builder of a room whose spot is waved all over a rectangle of floor."""

    def build(n_cameras: int, n_frames: int, rng: np.random.Generator) -> Built:
        return cameras(n_cameras, rng), _waved(low_xy, high_xy, n_frames, rng), FRAME_RATE_HZ

    return build


def _corridor_chain(n_cameras: int, n_frames: int, rng: np.random.Generator) -> Built:
    """One walk along the whole hall; with few frames to show it in, these are taken further apart."""
    cameras = _hall_cameras(n_cameras, rng)
    length_m = float(np.ptp(cameras.centres_in_world[:, 0]))
    frame_rate_hz = min(FRAME_RATE_HZ, n_frames * MEAN_SPEED_M_S / (1.5 * length_m))
    low, high = (-1.0, 1.4, HEIGHT_M[0]), (1.0, 3.6, HEIGHT_M[1])
    return cameras, _walk(low, high, n_frames, rng, travel_m=length_m, frame_rate_hz=frame_rate_hz), frame_rate_hz


def _planar_waving(n_cameras: int, n_frames: int, rng: np.random.Generator) -> Built:
    """The smart room, the spot in one tilted plane."""
    cameras = _smart_cameras(n_cameras, rng)
    across = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])
    return cameras, np.array([3.0, 2.6, 1.2]) + _walk((-2.0, -1.5), (2.0, 1.5), n_frames, rng) @ across, FRAME_RATE_HZ


def _line_waving(n_cameras: int, n_frames: int, rng: np.random.Generator) -> Built:
    """The smart room, the spot to and fro on one straight line."""
    cameras = _smart_cameras(n_cameras, rng)
    along = _walk((-1.5,), (1.5,), n_frames, rng) @ np.array([[0.8, 0.36, 0.48]])
    return cameras, np.array([3.0, 2.6, 1.2]) + along, FRAME_RATE_HZ


def _two_islands(n_cameras: int, n_frames: int, rng: np.random.Generator) -> Built:
    """Half of the time in one room, half in the other; the lamp is off between them."""
    cameras = _island_cameras(n_cameras, rng)
    first = _waved((0.5, 0.6), (3.6, 4.4), (n_frames + 1) // 2, rng)
    second = _waved((11.4, 0.6), (14.5, 4.4), n_frames // 2, rng)
    return cameras, np.concatenate([first, second]), FRAME_RATE_HZ


_SMART_FLOOR = ((0.5, 0.6), (5.5, 4.5))
PLANS = {
    "smart_room": Plan(_in_box(_smart_cameras, *_SMART_FLOOR), 5, 2, 6),
    "ring_room": Plan(_in_box(_ring_cameras, (-1.4, -1.4), (1.4, 1.4)), 8, 2, 64),
    "corridor_chain": Plan(_corridor_chain, 20, 3, 200, n_frames=200, n_frames_per_camera=100),
    "facing_cameras": Plan(_in_box(_facing_cameras, (1.2, 1.0), (4.8, 4.0)), 4, 4, 4),
    "stereo_only": Plan(_in_box(_smart_cameras, (1.0, 1.5), (5.0, 4.5)), 2, 2, 2),
    "wide_fisheye": Plan(_in_box(_fisheye_cameras, *_SMART_FLOOR), 4, 4, 4),
    "tele_beside_wide": Plan(_in_box(_mixed_cameras, *_SMART_FLOOR), 5, 5, 5),
    "planar_waving": Plan(_planar_waving, 5, 2, 6),
    "line_waving": Plan(_line_waving, 5, 2, 6),
    "colinear_centres": Plan(_in_box(_shelf_cameras, (0.8, 1.5), (5.2, 4.5)), 5, 3, 12),
    "two_islands": Plan(_two_islands, 6, 4, 20),
}
