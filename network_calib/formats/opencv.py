"""Cameras as an OpenCV FileStorage file, written only: OpenCV's reader is not safe with files from elsewhere.

`cameras` is a sequence of maps: name, image_width, image_height, model ("pinhole" or "fisheye"), camera_matrix (3 x 3),
distortion_coefficients (1 x 5: k1, k2, p1, p2, k3 = 0; fisheye 1 x 4), rotation (3 x 3) and translation (3 x 1) of
x_in_cam = R x_in_world + t.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.result import Calibration

_SUFFIXES = (".yml", ".yaml", ".xml", ".json")


def write_opencv(calibration: Calibration, path: Path) -> None:
    """Write the file; the suffix chooses YAML, XML or JSON.

    Raises:
        InputError: another suffix, or the file cannot be opened for writing.
    """
    import cv2

    if path.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{path}: OpenCV files end in {', '.join(_SUFFIXES)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if not storage.isOpened():
        raise InputError(f"{path} cannot be written")
    storage.write("unit", calibration.world.unit)
    storage.write("world", calibration.world.name)
    storage.startWriteStruct("cameras", cv2.FILE_NODE_SEQ)
    for camera in calibration.cameras:
        focal_x, focal_y, centre_x, centre_y, *distortion = np.asarray(camera.intrinsics).tolist()
        storage.startWriteStruct("", cv2.FILE_NODE_MAP)
        storage.write("name", camera.name)
        storage.write("image_width", int(camera.size_px[0]))
        storage.write("image_height", int(camera.size_px[1]))
        storage.write("model", "fisheye" if camera.lens.is_fisheye else "pinhole")
        storage.write("camera_matrix", np.array([[focal_x, 0, centre_x], [0, focal_y, centre_y], [0, 0, 1]]))
        terms = distortion if camera.lens.is_fisheye else [*distortion, 0.0]
        storage.write("distortion_coefficients", np.array([terms]))
        storage.write("rotation", camera.cam_from_world.rotation.as_matrix())
        storage.write("translation", camera.cam_from_world.translation.reshape(3, 1))
        storage.endWriteStruct()
    storage.endWriteStruct()
    storage.release()
