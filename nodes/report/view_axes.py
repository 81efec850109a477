"""From which side a network is looked at."""

from __future__ import annotations

import numpy as np

from network_calib.observations import FloatArray
from network_calib.result import Calibration


def view_axes(calibration: Calibration) -> tuple[FloatArray, tuple[str, str, str]]:
    """(3, 3) rows along, across and up, in world, and their labels.

    A frame that a camera lends has no vertical. There up is the mean of the cameras' own up directions, which people
    mount upright, and along is what that camera calls right, made level.
    """
    names = [camera.name for camera in calibration.cameras]
    if calibration.world.name not in names:
        return np.eye(3), ("x", "y", "z")
    rotations = calibration.as_cameras().rotations
    up = -rotations[:, 1].mean(axis=0)
    right = rotations[names.index(calibration.world.name), 0]
    ahead = np.cross(up, right)
    if np.linalg.norm(up) < 1e-3 or np.linalg.norm(ahead) < 1e-3:
        return np.eye(3), ("x", "y", "z")
    up, ahead = up / np.linalg.norm(up), ahead / np.linalg.norm(ahead)
    axes_in_world = np.array([np.cross(ahead, up), ahead, up], dtype=np.float64)
    name = calibration.world.name
    return axes_in_world, (f"right of {name}", f"ahead of {name}", "up, mean of the cameras")
