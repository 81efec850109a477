"""The gauge: seven directions that no image can see, how they are named, and how a world frame is chosen.

During the solve all poses are free and the seven directions are held by inner constraints (the shortest step). The
result is moved into the frame that the user asked for by one similarity; it never bends the calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.blocks import Gauge, State
from network_calib.camera_block import cameras_of
from network_calib.camera_parameters import CameraParameters
from network_calib.cameras import Cameras
from network_calib.errors import DegenerateError
from network_calib.observations import FloatArray


@dataclass(frozen=True, slots=True)
class Similarity:
    """x_in_target = scale * rotation @ x_in_source + translation.

    Attributes:
        scale: positive.
        rotation: (3, 3), proper.
        translation: (3,) in the target frame.
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """(N, 3) points in the target frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_to_cameras(self, cameras: Cameras) -> Cameras:
        """The same cameras posed in the target frame."""
        return cameras.with_poses(cameras.rotations @ self.rotation.T, self.apply(cameras.centres_in_world))


def into_camera(cameras: Cameras, camera: int, scale: float) -> Similarity:
    """The similarity into one camera's frame, with sizes multiplied by `scale`."""
    rotation = cameras.rotations[camera]
    return Similarity(scale, rotation, -scale * rotation @ cameras.centres_in_world[camera])


def fit_similarity(source: FloatArray, target: FloatArray) -> Similarity:
    """Least-squares similarity of point sets (N, 3), N >= 3 (Umeyama 1991).

    Raises:
        DegenerateError: fewer than three points, or all on one line.
    """
    if len(source) < 3:
        raise DegenerateError(f"a world frame needs 3 known positions or more, got {len(source)}")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_rest, target_rest = source - source_mean, target - target_mean
    left, strength, right = np.linalg.svd(target_rest.T @ source_rest)
    if strength[1] <= 1e-8 * strength[0]:
        raise DegenerateError("the known positions lie on one line: the turn about it stays free")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left * sign @ right
    scale = float((strength * sign).sum() / (source_rest**2).sum())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def level_to_floor(floor_points: FloatArray, cameras: Cameras) -> Similarity:
    """The motion that puts floor points (N, 3) on z = 0, z up towards the cameras, origin below the first camera.

    x points where the first camera looks, projected on the floor.

    Raises:
        DegenerateError: the floor points do not span a plane.
    """
    mean = floor_points.mean(axis=0)
    _, strength, right = np.linalg.svd(floor_points - mean)
    if len(floor_points) < 3 or strength[1] < 1e-3 * strength[0]:
        raise DegenerateError("the floor frames do not span a plane: put the spot down at three places off one line")
    up = right[2] * np.sign((cameras.centres_in_world.mean(axis=0) - mean) @ right[2])
    view = cameras.rotations[0][2]
    if abs(view @ up) > 0.999:
        view = cameras.rotations[0][0]
    forward = view - (view @ up) * up
    forward /= np.linalg.norm(forward)
    rotation = np.stack([forward, np.cross(up, forward), up])
    below = cameras.centres_in_world[0] - ((cameras.centres_in_world[0] - mean) @ up) * up
    return Similarity(1.0, rotation, -rotation @ below)


def similarity_directions(parameters: CameraParameters) -> FloatArray:
    """(n, 7) tangent directions that move the whole world: translation, rotation about the origin, scale."""
    directions = np.zeros((parameters.size, 7))
    rotation, centre = parameters.columns[:, :3], parameters.columns[:, 3:6]
    for axis in range(3):
        directions[centre[:, axis], axis] = 1.0
        unit = np.eye(3)[axis]
        # The world turns by w: C moves by w x C, and R becomes R exp(-w), a step of -R w on the left.
        directions[rotation, 3 + axis] = -(parameters.rotations @ unit)
        directions[centre, 3 + axis] = np.cross(unit, parameters.centres)
    directions[centre, 6] = parameters.centres
    return directions


def inner_gauge(state: State) -> Gauge:
    """No preferred frame: the step is orthogonal to all seven directions."""
    null = similarity_directions(cameras_of(state.parts))
    orthonormal, _ = np.linalg.qr(null)
    return Gauge(orthonormal.T, null)


def camera_gauge(state: State, camera: int, end_a: int, end_b: int) -> Gauge:
    """One camera's pose stays, and so does the distance between two camera centres."""
    parameters = cameras_of(state.parts)
    constraints = np.zeros((7, parameters.size))
    constraints[np.arange(6), parameters.columns[camera, :6]] = 1.0
    baseline = parameters.centres[end_b] - parameters.centres[end_a]
    direction = baseline / np.linalg.norm(baseline)
    constraints[6, parameters.columns[end_a, 3:6]] -= direction
    constraints[6, parameters.columns[end_b, 3:6]] += direction
    return Gauge(constraints, similarity_directions(parameters))
