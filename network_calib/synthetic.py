"""Named rooms with known truth, what their cameras would see, and how far an estimate is from the truth.

Geometry and noise are apart: `room` makes cameras and the way of the spot, `observe` makes detections of it, and
`compare` removes the gauge before it takes differences. The world frame is the room's: metres, z up, floor at z = 0.
Walls do not hide the spot, so rooms that must not see each other are laid out with cameras that look away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from network_calib.cameras import Cameras, cam_from_img, img_from_cam
from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray, Observations
from network_calib.synthetic_rooms import PLANS

ROOM_NAMES = tuple(PLANS)
# True centres narrower than this part of their length count as a line: the turn about it, from the centres alone, would
# err by a hundred times what the centres do.
MIN_BREADTH = 0.01
Align = Literal["similarity", "rigid", "none"]


@dataclass(frozen=True, slots=True)
class Room:
    """Cameras and a waved spot, both true. Cameras 0 and 1 are the stereo pair.

    Attributes:
        name: one of ROOM_NAMES.
        cameras: C cameras in the room's frame.
        trajectory: (F, 3) spot in the room's frame at each frame, m.
        frame_rate_hz: 25, or less where so few frames were asked for that the way would be run, not walked.
    """

    name: str
    cameras: Cameras
    trajectory: FloatArray
    frame_rate_hz: float

    @property
    def baseline_m(self) -> float:
        """Distance of the centres of the stereo pair."""
        centres = self.cameras.centres_in_world
        return float(np.linalg.norm(centres[1] - centres[0]))


@dataclass(frozen=True, slots=True)
class Sighting:
    """Detections of a room's spot, and which of them are honest.

    Attributes:
        observations: K detections; frame is the index into the trajectory, sigma_px is not given.
        is_true: (K,) the detection shows the spot; the others are false.
        point: (K,) index into the trajectory.
    """

    observations: Observations
    is_true: BoolArray
    point: IntArray

    @property
    def is_usable(self) -> BoolArray:
        """(K,) the exact inlier mask: true detections in a frame with two or more true ones."""
        n_true = np.bincount(self.point, weights=self.is_true, minlength=1)
        return self.is_true & (n_true[self.point] >= 2)


@dataclass(frozen=True, slots=True)
class CameraErrors:
    """Differences of estimated and true cameras after alignment, in the order of the estimated cameras.

    Attributes:
        names: C names.
        rotation_deg: (C,) angle between the orientations.
        centre_m: (C,) distance of the centres.
        focal_px: (C,) estimated minus true focal length, mean of x and y.
        relative_scale: estimated over true size of the network, whatever the alignment; NaN for a single camera.
    """

    names: tuple[str, ...]
    rotation_deg: FloatArray
    centre_m: FloatArray
    focal_px: FloatArray
    relative_scale: float


def room(name: str, *, rng: np.random.Generator, n_frames: int | None = None, n_cameras: int | None = None) -> Room:
    """Build a named room; the same name, numbers and generator state give the same room.

    Args:
        name: one of ROOM_NAMES.
        rng: draws the cameras, then the way of the spot.
        n_frames: length of the trajectory; None for the room's own.
        n_cameras: None for the room's own.

    Raises:
        InputError: an unknown name, or a number that this room cannot have.
    """
    if name not in PLANS:
        raise InputError(f"no room {name!r}, expected one of {', '.join(ROOM_NAMES)}")
    plan = PLANS[name]
    n_cameras = plan.n_cameras if n_cameras is None else n_cameras
    if not plan.fewest <= n_cameras <= plan.most:
        raise InputError(f"room {name!r} has {plan.fewest} to {plan.most} cameras, not {n_cameras}")
    n_frames = plan.n_frames + plan.n_frames_per_camera * n_cameras if n_frames is None else n_frames
    if n_frames < 2:
        raise InputError(f"a trajectory has at least 2 frames, not {n_frames}")
    cameras, trajectory, frame_rate_hz = plan.build(n_cameras, n_frames, rng)
    return Room(name, cameras, trajectory, frame_rate_hz)


def observe(
    room: Room,
    *,
    rng: np.random.Generator,
    sigma_px: float = 0.2,
    missing: float = 0.0,
    false_detections: float = 0.0,
) -> Sighting:
    """Detect the spot in every camera whose image holds it.

    Args:
        room: the truth.
        rng: draws noise, gaps and false detections.
        sigma_px: standard deviation of the Gaussian noise, each axis. Noisy pixels are not clipped to the image.
        missing: probability with which each true detection is dropped.
        false_detections: this part of the remaining detections is put at a random pixel of its image. One that lands
            within 5 sigma_px of the spot would be no false detection and stays what it was.
    """
    seen = [_visible(room, i) for i in range(len(room.cameras))]
    camera = np.concatenate([np.full(len(point), i) for i, (point, _) in enumerate(seen)])
    point = np.concatenate([point for point, _ in seen])
    spot_px = np.concatenate([px for _, px in seen])
    order = np.lexsort((camera, point))
    order = order[rng.random(len(order)) >= missing]
    camera, point, spot_px = camera[order], point[order], spot_px[order]
    px = spot_px + sigma_px * rng.standard_normal(spot_px.shape)

    chosen = rng.choice(len(px), round(false_detections * len(px)), replace=False)
    stray_px = rng.uniform(-0.5, room.cameras.size_px[camera[chosen]] - 0.5)
    is_far = np.linalg.norm(stray_px - spot_px[chosen], axis=1) > 5 * sigma_px
    px[chosen[is_far]] = stray_px[is_far]
    is_true = np.ones(len(px), dtype=bool)
    is_true[chosen[is_far]] = False
    stamp_ns = np.round(point * (1e9 / room.frame_rate_hz)).astype(np.int64)
    observations = Observations.from_columns(room.cameras.names, camera=camera, frame=point, px=px, stamp_ns=stamp_ns)
    return Sighting(observations, is_true, point)


def compare(estimated: Cameras, truth: Cameras, *, align: Align = "similarity") -> CameraErrors:
    """Differences of cameras once the estimate is moved into the truth's frame, see `align_cameras`.

    Raises:
        InputError: an estimated camera that the truth does not name.
    """
    aligned, relative_scale = align_cameras(estimated, truth, align=align)
    i = _truth_index(estimated, truth)
    turn = truth.rotations[i].transpose(0, 2, 1) @ aligned.rotations
    return CameraErrors(
        names=estimated.names,
        rotation_deg=np.degrees(Rotation.from_matrix(turn).magnitude()),
        centre_m=np.linalg.norm(aligned.centres_in_world - truth.centres_in_world[i], axis=1),
        focal_px=(estimated.intrinsics[:, :2] - truth.intrinsics[i, :2]).mean(axis=1),
        relative_scale=relative_scale,
    )


def align_cameras(estimated: Cameras, truth: Cameras, *, align: Align = "similarity") -> tuple[Cameras, float]:
    """Move the estimate onto the truth by the best similarity (or rigid motion, or not at all).

    The rotation is Umeyama's, from the centres, where these span a plane; two centres, or centres on a line, leave a
    turn about the line free, and there the mean of the cameras' own turns is taken. The scale is Horn's symmetric
    one, the ratio of the spreads, which stays positive however wrong the estimate.

    Returns:
        The moved cameras, and the estimated over the true size.
    """
    i = _truth_index(estimated, truth)
    source, target = estimated.centres_in_world, truth.centres_in_world[i]
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_spread, target_spread = np.linalg.norm(source - source_mean), np.linalg.norm(target - target_mean)
    relative_scale = float(source_spread / target_spread) if target_spread > 0 else float("nan")
    if align == "none":
        return estimated, relative_scale
    extent_m = np.linalg.svd(target - target_mean, compute_uv=False)
    if len(i) > 2 and extent_m[1] > MIN_BREADTH * extent_m[0]:
        left, _, right = np.linalg.svd((target - target_mean).T @ (source - source_mean))
        turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    else:
        turn = Rotation.from_matrix(truth.rotations[i].transpose(0, 2, 1) @ estimated.rotations).mean().as_matrix()
    is_scaled = align == "similarity" and relative_scale > 0
    scale = 1 / relative_scale if is_scaled else 1.0
    centres = target_mean + scale * (source - source_mean) @ turn.T
    return estimated.with_poses(estimated.rotations @ turn.T, centres), relative_scale


def _truth_index(estimated: Cameras, truth: Cameras) -> IntArray:
    unknown = [name for name in estimated.names if name not in truth.names]
    if unknown:
        raise InputError(f"cameras {unknown} are not among the true ones {list(truth.names)}")
    return np.array([truth.names.index(name) for name in estimated.names], dtype=np.int64)


def _visible(room: Room, camera: int) -> tuple[IntArray, FloatArray]:
    """Indices of the spots (V,) that one camera sees, and their pixels (V, 2)."""
    cameras, (pose,) = room.cameras, room.cameras.cam_from_world[camera : camera + 1]
    in_cam = pose.apply(room.trajectory)
    row, is_fisheye = cameras.intrinsics[camera], np.asarray(cameras.lenses[camera].is_fisheye)
    px, is_valid = img_from_cam(row, is_fisheye, in_cam)
    index = np.flatnonzero(is_valid & cameras.is_in_image(np.full(len(px), camera), px))
    # Far off the axis a polynomial lens folds back into the image; such a spot is not the one its pixel shows.
    ray_xy, _ = cam_from_img(row, is_fisheye, px[index])
    true_xy = in_cam[index, :2] / in_cam[index, 2:]
    index = index[np.abs(ray_xy - true_xy).max(axis=1) < 1e-6 * (1 + np.abs(true_xy).max(axis=1))]
    return index, px[index]
