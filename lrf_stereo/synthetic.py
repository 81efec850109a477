"""The paper's set-up with known truth: a stereo pair, a tilting scanner beside it, spots on its scan planes.

Geometry and noise are apart: `paper_scene` makes the truth, `sample` makes what cameras and scanner report of it. The
world is C0's frame. The room's own frame has x into the room, y left, z up, and its origin on the floor below the pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.noise import LrfNoise
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.scanner import ScanSteps, TiltingScanner
from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray, Observations
from network_calib.synthetic_rooms import look_at

PAPER_TILTS_DEG = (12.1, 23.2, 50.0)
STEREO_FOCAL_PX, STEREO_SIZE_PX, BASELINE_M = 260.0, (320, 240), 0.09
# So pitched, the pair sees the scan plane at every tilt from 2 to 50 degrees.
CAMERA_PITCH_DEG = 26.0
# Surveillance height: at 50 degrees of tilt, beams of up to 3.2 m end above the floor.
MOUNT_HEIGHT_M = 2.6
ROOM_SIZE_M = (6.0, 5.0, 3.0)
ROOM_CAMERAS_M = ((5.8, 2.3, 2.6), (5.8, -2.3, 2.5), (3.0, 2.4, 2.7), (3.0, -2.4, 2.6), (0.2, 2.3, 2.6))
SPOT_RANGE_M = (1.0, 3.5)


@dataclass(frozen=True, slots=True)
class BoxRoom:
    """An empty room.

    Attributes:
        world_from_room: x into the room, y left, z up; the platform is above the origin.
        low_m: (3,) smallest corner in the room's frame.
        high_m: (3,) largest corner.
    """

    world_from_room: RigidTransform
    low_m: FloatArray
    high_m: FloatArray

    def holds(self, points_in_world: FloatArray, *, margin_m: float = 0.05) -> BoolArray:
        """(N,) whether points (N, 3) are inside, at least this far from the walls."""
        in_room = self.world_from_room.inv().apply(points_in_world)
        return np.asarray(((in_room > self.low_m + margin_m) & (in_room < self.high_m - margin_m)).all(axis=-1))


@dataclass(frozen=True, slots=True)
class LrfScene:
    """The truth.

    Attributes:
        cameras: C cameras; 0 and 1 are the stereo pair.
        scanner: the tilting scanner.
        tilts_rad: (T,) tilt settings.
        spots_in_world: (M, 3) spots on the scan planes, each in view of the stereo pair.
        spot_tilt: (M,) tilt setting of each spot.
        room: walls around it all.
    """

    cameras: Cameras
    scanner: TiltingScanner
    tilts_rad: FloatArray
    spots_in_world: FloatArray
    spot_tilt: IntArray
    room: BoxRoom


@dataclass(frozen=True, slots=True)
class SampleNoise:
    """What is wrong with the samples.

    Attributes:
        sigma_px: of the detected spot, each axis.
        lrf: of range, bearing and reported tilt. The bearing's error is not Gaussian: it is rounded to a step.
        out_of_plane_m: standard deviation of the spot's height over the scan plane.
        out_of_plane_bias_m: mean of that height, which no residual can show; below zero for a one-sided crossing.
        wrong_pairs: share of the LRF rows that show something else in the scan plane.
        scale: of all random errors that are drawn (the stated sigmas stay): 0 for exact samples.
    """

    sigma_px: float = 0.3
    lrf: LrfNoise = field(default_factory=LrfNoise)
    out_of_plane_m: float = 4e-3
    out_of_plane_bias_m: float = 0.0
    wrong_pairs: float = 0.0
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class LrfSamples:
    """What cameras and scanner report, and the truth beside it.

    Attributes:
        observations: detections by all cameras; frame is the spot's number.
        spots: M sightings by the scanner, one for each spot, in order.
        settings: reported tilts.
        is_true: (M,) whether the sighting shows the spot.
        spots_in_world: (M, 3) where the spots truly were, out of the plane by their crossing errors.
    """

    observations: Observations
    spots: LrfSpots
    settings: TiltSettings
    is_true: BoolArray
    spots_in_world: FloatArray


def paper_scene(
    *,
    rng: np.random.Generator,
    n_spots_per_tilt: int = 22,
    tilts_deg: Sequence[float] = PAPER_TILTS_DEG,
    dx_m: float = 0.04,
    dz_m: float = 0.06,
    mount_deg: tuple[float, float] = (0.0, 0.0),
    n_room_cameras: int = 0,
) -> LrfScene:
    """The paper's set-up: its tilts, image size and sensors; what it does not tell is chosen here and in the constants.

    Args:
        rng: draws the spots, and the room cameras' lenses.
        n_spots_per_tilt: the paper's N.
        tilts_deg: tilt settings.
        dx_m: offset of the mirror from the tilt axis, forward at tilt zero.
        dz_m: the same, upward.
        mount_deg: roll and yaw of the scanner on its tilt unit.
        n_room_cameras: further cameras around the room, at most 5; three make the five-camera room.

    Raises:
        InputError: more room cameras than places, or a tilt at which the pair does not see the scan plane.
    """
    if n_room_cameras > len(ROOM_CAMERAS_M):
        raise InputError(f"the room has places for {len(ROOM_CAMERAS_M)} further cameras, not {n_room_cameras}")
    pitch = np.radians(CAMERA_PITCH_DEG)
    first = np.array([0.2, BASELINE_M / 2, MOUNT_HEIGHT_M])
    look = np.array([np.cos(pitch), 0.0, -np.sin(pitch)])
    room_from_world = RigidTransform.from_components(first, Rotation.from_matrix(look_at(first, first + look).T))
    world_from_room = room_from_world.inv()
    # Beside the pair, the mirror level with the cameras at tilt zero.
    axis_in_room = np.array([0.2, 0.15, MOUNT_HEIGHT_M - 0.06])
    scanner = TiltingScanner.from_paper(
        world_from_room * RigidTransform.from_translation(axis_in_room),
        dx_m,
        dz_m,
        mount_roll_rad=float(np.radians(mount_deg[0])),
        mount_yaw_rad=float(np.radians(mount_deg[1])),
    )
    cameras = _cameras(world_from_room, n_room_cameras, rng)
    width = ROOM_SIZE_M[1] / 2
    room = BoxRoom(world_from_room, np.array([0.0, -width, 0.0]), np.array([ROOM_SIZE_M[0], width, ROOM_SIZE_M[2]]))
    tilts_rad = np.radians(np.asarray(tilts_deg, dtype=np.float64))
    spots = [spots_on_plane(cameras, scanner, float(tilt), n_spots_per_tilt, room=room, rng=rng) for tilt in tilts_rad]
    return LrfScene(
        cameras,
        scanner,
        tilts_rad,
        np.concatenate(spots),
        np.repeat(np.arange(len(tilts_rad)), n_spots_per_tilt),
        room,
    )


def spots_on_plane(
    cameras: Cameras, scanner: TiltingScanner, tilt_rad: float, n: int, *, room: BoxRoom, rng: np.random.Generator
) -> FloatArray:
    """(n, 3) points on the scan plane at a tilt: 1 to 3.5 m away, in the room, in view of cameras 0 and 1.

    Raises:
        InputError: cameras 0 and 1 see (almost) nothing of the scan plane.
    """
    found = np.empty((0, 3))
    for _ in range(100):
        range_m, bearing = rng.uniform(*SPOT_RANGE_M, 20 * n), rng.uniform(-1.0, 1.0, 20 * n)
        points = scanner.points_in_world(range_m, bearing, tilt_rad)
        is_seen = room.holds(points)
        for camera in (0, 1):
            index = np.full(len(points), camera)
            px, is_valid = cameras.img_from_world(index, points)
            is_seen &= is_valid & cameras.is_in_image(index, px)
        found = np.concatenate([found, points[is_seen]])
        if len(found) >= n:
            return found[:n]
    raise InputError(f"cameras 0 and 1 see nothing of the scan plane at {np.degrees(tilt_rad):.1f} deg")


def sample(scene: LrfScene, *, rng: np.random.Generator, noise: SampleNoise | None = None) -> LrfSamples:
    """Report the spots: pixels in every camera that sees them, and a range and a bearing of a whole step for each."""
    noise = SampleNoise() if noise is None else noise
    n, scale = len(scene.spots_in_world), noise.scale
    tilts = scene.tilts_rad[scene.spot_tilt]
    normals = scene.scanner.world_from_lrf_at(tilts).rotation.as_matrix()[:, :, 2]
    height = noise.out_of_plane_bias_m + scale * noise.out_of_plane_m * rng.standard_normal(n)
    points = scene.spots_in_world + height[:, None] * normals
    seen = detect(scene.cameras, points, noise=noise, rng=rng)
    observations = Observations.from_columns(
        scene.cameras.names, camera=seen.camera, frame=seen.point, px=seen.px, sigma_px=seen.sigma_px
    )
    range_m, bearing, _ = scene.scanner.measure(points, tilts)
    is_true = np.ones(n, dtype=bool)
    wrong = rng.choice(n, round(noise.wrong_pairs * n), replace=False)
    is_true[wrong] = False
    range_m[wrong], bearing[wrong] = _elsewhere(range_m[wrong], bearing[wrong], rng)
    spots = sightings(scene, range_m, bearing, noise=noise, rng=rng)
    return LrfSamples(observations, spots, tilt_settings(scene, noise=noise, rng=rng), is_true, points)


def sightings(
    scene: LrfScene, range_m: FloatArray, bearing_rad: FloatArray, *, noise: SampleNoise, rng: np.random.Generator
) -> LrfSpots:
    """What the scanner reports of the scene's M spots, whose true ranges and bearings are given; frames 0..M-1."""
    n, steps = len(range_m), ScanSteps()
    sigma_range = noise.lrf.range_m(range_m)
    rounded = steps.bearing_rad(np.round(steps.step(bearing_rad)))
    return LrfSpots(
        frame=np.arange(n),
        setting=scene.spot_tilt,
        range_m=range_m + noise.scale * sigma_range * rng.standard_normal(n),
        bearing_rad=bearing_rad + noise.scale * (rounded - bearing_rad),
        out_of_plane_m=np.zeros(n),
        sigma_range_m=sigma_range,
        sigma_bearing_rad=np.full(n, noise.lrf.bearing_rad),
        sigma_out_of_plane_m=np.full(n, noise.out_of_plane_m),
    )


def tilt_settings(scene: LrfScene, *, noise: SampleNoise, rng: np.random.Generator) -> TiltSettings:
    """The tilts as reported."""
    n_tilts = len(scene.tilts_rad)
    return TiltSettings(
        scanner=np.zeros(n_tilts, dtype=np.int64),
        angle_rad=scene.tilts_rad + noise.scale * noise.lrf.tilt_rad * rng.standard_normal(n_tilts),
        covariance_rad2=noise.lrf.tilt_rad**2 * np.eye(n_tilts),
    )


def _cameras(world_from_room: RigidTransform, n_room_cameras: int, rng: np.random.Generator) -> Cameras:
    """The stereo pair without distortion, then surveillance cameras that look at the middle of the spots."""
    pair = poses_from_centres(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 0.0], [BASELINE_M, 0.0, 0.0]]))
    centres = np.array(ROOM_CAMERAS_M[:n_room_cameras]).reshape(-1, 3)
    in_room = poses_from_centres(look_at(centres, np.tile([2.0, 0.0, 1.3], (n_room_cameras, 1))), centres)
    poses = [pair] + ([in_room * world_from_room.inv()] if n_room_cameras else [])
    intrinsics = np.zeros((2 + n_room_cameras, 8))
    intrinsics[:2, :4] = [STEREO_FOCAL_PX, STEREO_FOCAL_PX, *((np.array(STEREO_SIZE_PX) - 1) / 2)]
    intrinsics[2:, :2] = rng.uniform(430, 480, (n_room_cameras, 1))
    intrinsics[2:, 2:4] = [319.5, 239.5]
    intrinsics[2:, 4] = rng.uniform(-0.30, -0.20, n_room_cameras)
    intrinsics[2:, 5] = 0.06
    return Cameras(
        names=tuple(f"C{i}" for i in range(2 + n_room_cameras)),
        size_px=np.array([STEREO_SIZE_PX] * 2 + [(640, 480)] * n_room_cameras),
        lenses=(LensModel.NONE,) * 2 + (LensModel.K1_K2,) * n_room_cameras,
        intrinsics=intrinsics,
        cam_from_world=RigidTransform.concatenate(poses),
    )


@dataclass(frozen=True, slots=True)
class Detections:
    """K detections of spots.

    Attributes:
        camera: (K,) camera index.
        point: (K,) spot index.
        px: (K, 2) noisy pixels.
        sigma_px: (K,) their standard deviation.
    """

    camera: IntArray
    point: IntArray
    px: FloatArray
    sigma_px: FloatArray


def detect(cameras: Cameras, points: FloatArray, *, noise: SampleNoise, rng: np.random.Generator) -> Detections:
    """Pixels of spots (M, 3) in every camera whose image holds them."""
    camera = np.repeat(np.arange(len(cameras)), len(points))
    point = np.tile(np.arange(len(points)), len(cameras))
    px, is_valid = cameras.img_from_world(camera, points[point])
    is_seen = is_valid & cameras.is_in_image(camera, px)
    camera, point, px = camera[is_seen], point[is_seen], px[is_seen]
    noisy = px + noise.scale * noise.sigma_px * rng.standard_normal(px.shape)
    return Detections(camera, point, noisy, np.full(len(px), noise.sigma_px))


def _elsewhere(range_m: FloatArray, bearing_rad: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Ranges and bearings of other things: an arm beside the spot, a body, anything; 0.1 to 0.8 m from the spot."""
    distance, direction = rng.uniform(0.1, 0.8, len(range_m)), rng.uniform(-np.pi, np.pi, len(range_m))
    x = range_m * np.cos(bearing_rad) + distance * np.cos(direction)
    y = range_m * np.sin(bearing_rad) + distance * np.sin(direction)
    return np.hypot(x, y), np.arctan2(y, x)
