"""What a camera of a simulated scene would see: room and bodies in shades of grey, by sphere tracing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lrf_stereo.synthetic import BoxRoom, LrfScene
from lrf_stereo.synthetic_scans import Capsule
from network_calib.cameras import cam_from_img
from network_calib.errors import InputError
from network_calib.observations import FloatArray

# Steps of the tracing; a ray has arrived long before that, or grazes a body and takes its shade.
N_STEPS = 80
SLOPE_STEP_M = 1e-4
GRID_M, LINE_M = 0.5, 0.02
LIGHT = np.array([-0.45, 0.35, 0.82])
AMBIENT = 0.35


def render(scene: LrfScene, bodies: Sequence[Capsule] = (), *, camera: int = 0) -> FloatArray:
    """(height, width) grey levels 0..1 of one camera; walls carry lines every half metre.

    Raises:
        InputError: the camera stands outside the room or in a body, where sphere tracing sees nothing.
    """
    width, height = (int(side) for side in scene.cameras.size_px[camera])
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    px = np.column_stack([x.ravel(), y.ravel()])
    intrinsics = np.tile(scene.cameras.intrinsics[camera], (len(px), 1))
    rays, _ = cam_from_img(intrinsics, np.repeat(scene.cameras.is_fisheye[camera], len(px)), px)
    in_cam = np.column_stack([np.nan_to_num(rays), np.ones(len(px))])
    in_cam /= np.linalg.norm(in_cam, axis=1, keepdims=True)
    room_from_world = scene.room.world_from_room.inv()
    room_from_cam = room_from_world * scene.cameras.cam_from_world[camera].inv()
    way, start = room_from_cam.rotation.apply(in_cam), np.asarray(room_from_cam.translation)
    solids = [(room_from_world.apply(np.stack([b.begin_in_world, b.end_in_world])), b.radius_m) for b in bodies]
    if _gap(start[None], scene.room, solids)[0] <= 0:
        raise InputError(f"camera {scene.cameras.names[camera]} stands outside the room or in a body")
    travelled = np.zeros(len(px))
    for _ in range(N_STEPS):
        travelled += _gap(start + travelled[:, None] * way, scene.room, solids)
    shade = _shade(start + travelled[:, None] * way, scene.room, solids)
    return shade.reshape(height, width)


def _gap(points: FloatArray, room: BoxRoom, solids: Sequence[tuple[FloatArray, float]]) -> FloatArray:
    """(N,) distance of points (N, 3) in the room's frame to the nearest surface; below zero behind it."""
    return np.minimum(_to_walls(points, room), _to_bodies(points, solids))


def _to_walls(points: FloatArray, room: BoxRoom) -> FloatArray:
    return np.minimum(points - room.low_m, room.high_m - points).min(axis=1)


def _to_bodies(points: FloatArray, solids: Sequence[tuple[FloatArray, float]]) -> FloatArray:
    nearest = np.full(len(points), np.inf)
    for ends, radius in solids:
        axis, arm = ends[1] - ends[0], points - ends[0]
        along = np.clip(arm @ axis / max(float(axis @ axis), 1e-12), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(arm - along[:, None] * axis, axis=1) - radius)
    return nearest


def _shade(points: FloatArray, room: BoxRoom, solids: Sequence[tuple[FloatArray, float]]) -> FloatArray:
    """(N,) grey levels: Lambert's law with one lamp, and the lines of the walls."""
    slope = np.stack(
        [
            _gap(points + SLOPE_STEP_M * axis, room, solids) - _gap(points - SLOPE_STEP_M * axis, room, solids)
            for axis in np.eye(3)
        ],
        axis=1,
    )
    normal = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    shade = AMBIENT + (1 - AMBIENT) * np.clip(normal @ LIGHT / np.linalg.norm(LIGHT), 0.0, 1.0)
    is_wall = _to_walls(points, room) < _to_bodies(points, solids)
    off_line = np.abs((points + GRID_M / 2) % GRID_M - GRID_M / 2)
    # A wall's own coordinate is constant: only lines across it count.
    off_line[np.abs(normal) > 0.5] = np.inf
    is_line = (off_line < LINE_M / 2).any(axis=1)
    return np.where(is_wall, shade * np.where(is_line, 0.55, 0.75), 0.85 * shade)
