"""Sites to project scans into: a room of the paper's set-up, or one such room among many, and a fast scanner in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.rooms import random_generator
from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import LrfScene, paper_scene
from lrf_stereo.synthetic_scans import ScannedRoom
from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.observations import FloatArray, IntArray
from network_calib.result import (
    PARAMETER_NAMES,
    CalibratedCamera,
    Calibration,
    CameraQuality,
    ErrorSummary,
    NetworkQuality,
    Provenance,
    WorldFrame,
)
from network_calib.synthetic_rooms import look_at
from nodes.simulation.lrf_simulation import true_lrf

# 270 degrees by a quarter of a degree, 40 times a second, as common scanners of 10 or 30 m reach.
FAST_STEPS = ScanSteps(
    front_step=720, steps_per_turn=1440, first_step=180, last_step=1260, range_max_m=30.0, turn_s=0.025
)
RATE_HZ = 40.0
TILT_RAD = float(np.radians(23.2))
ROOM_M = (6.0, 5.0)
NO_ERRORS = ErrorSummary(0, np.nan, np.nan, np.nan, np.nan)


@dataclass(frozen=True, slots=True)
class Site:
    """A calibration, and scans of its LRF: (n, 1081) readings in mm."""

    calibration: Calibration
    readings_mm: IntArray


def small_site(n_scans: int) -> Site:
    """Five cameras in the scanner's room."""
    scene = paper_scene(rng=random_generator(5), n_room_cameras=3)
    return _site(scene, scene.cameras, n_scans)


def large_site(n_cameras: int, grid: tuple[int, int], n_scans: int) -> Site:
    """Cameras under the ceilings of rooms side by side, each looking at its room's middle; the scanner is in one.

    Args:
        n_cameras: equally many in each room.
        grid: rooms along x and y of the scanner's room, which is in the middle.
        n_scans: different scans.
    """
    scene, rng = paper_scene(rng=random_generator(5)), random_generator(7)
    room = np.arange(n_cameras) % (grid[0] * grid[1])
    shift = np.column_stack(
        [(room % grid[0] - grid[0] // 2) * ROOM_M[0], (room // grid[0] - grid[1] // 2) * ROOM_M[1], 0 * room]
    )
    low, high = np.array([0.1, -2.4, 2.2]), np.array([5.9, 2.4, 2.8])
    centres = shift + rng.uniform(low, high, (n_cameras, 3))
    targets = shift + np.array([2.5, 0.0, 0.8]) + 0.5 * rng.standard_normal((n_cameras, 3))
    intrinsics = np.zeros((n_cameras, 8))
    intrinsics[:, :2] = rng.uniform(400, 520, (n_cameras, 1))
    intrinsics[:, 2:4] = [319.5, 239.5]
    intrinsics[:, 4], intrinsics[:, 5] = rng.uniform(-0.30, -0.20, n_cameras), 0.06
    cameras = Cameras(
        names=tuple(f"C{i}" for i in range(n_cameras)),
        size_px=np.tile([640, 480], (n_cameras, 1)),
        lenses=(LensModel.K1_K2,) * n_cameras,
        intrinsics=intrinsics,
        cam_from_world=poses_from_centres(look_at(centres, targets), centres) * scene.room.world_from_room.inv(),
    )
    return _site(scene, cameras, n_scans)


def _site(scene: LrfScene, cameras: Cameras, n_scans: int) -> Site:
    rng = random_generator(9)
    scanned = ScannedRoom.of(scene, rng=rng, steps=FAST_STEPS)
    readings_mm = np.stack([scanned.readings_mm(TILT_RAD, rng=rng) for _ in range(n_scans)])
    quality = NetworkQuality(0, 0, 0, NO_ERRORS, NO_ERRORS, np.nan, np.nan, np.nan, np.nan, np.nan)
    calibration = Calibration(
        cameras=tuple(_camera(cameras, k, _covariance(rng)) for k in range(len(cameras))),
        world=WorldFrame("room", "m", "truth", 0.0),
        quality=quality,
        warnings=(),
        provenance=Provenance("synthetic", "", "site", "", 0, "truth", "{}"),
        lrfs=(true_lrf(scene.scanner, scene.tilts_rad),),
    )
    return Site(calibration, readings_mm)


def _camera(cameras: Cameras, k: int, covariance: FloatArray) -> CalibratedCamera:
    return CalibratedCamera(
        name=cameras.names[k],
        size_px=(int(cameras.size_px[k, 0]), int(cameras.size_px[k, 1])),
        lens=cameras.lenses[k],
        intrinsics=cameras.intrinsics[k],
        cam_from_world=cameras.cam_from_world[k],
        covariance=covariance,
        is_intrinsics_fixed=False,
        quality=CameraQuality(0, NO_ERRORS, NO_ERRORS, 0.3, 0.0),
    )


def _covariance(rng: np.random.Generator) -> FloatArray:
    """Of about a pixel: aspect and tangential terms held, everything else correlated."""
    root = 1e-3 * rng.standard_normal((len(PARAMETER_NAMES),) * 2)
    root[[7, 12, 13]] = 0.0
    return root @ root.T
