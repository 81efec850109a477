"""A calibration in the result layout of MultiCamSelfCal, for the tools that read its folders.

- `camera<N>.Pmat.cal`: 3 x 4 projection matrix K [R | t] in Octave's text format, from world to *undistorted* pixel.
- `<basename><N>.cal`: camera centre C and the matrix R^T K^-1, which turns a pixel into a ray in the world.
- `<basename><N>.rad`: K and distortion, with which the original undistorts pixels.
- `camera_order.txt`: camera names; `Res.dat`: image sizes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.formats.rad import format_rad
from network_calib.observations import FloatArray
from network_calib.result import CalibratedCamera, Calibration


def write_svoboda(calibration: Calibration, folder: Path, *, basename: str = "basename") -> None:
    """Write the folder, made when missing. Cameras are numbered from 1 in their order.

    Raises:
        InputError: a camera is a fisheye, which the format cannot express.
    """
    fisheyes = [camera.name for camera in calibration.cameras if camera.lens.is_fisheye]
    if fisheyes:
        raise InputError(
            f"MultiCamSelfCal's format has no fisheye lens, but these cameras have one: {', '.join(fisheyes)}",
            advice="Export to aniposelib or opencv instead.",
        )
    folder.mkdir(parents=True, exist_ok=True)
    for number, camera in enumerate(calibration.cameras, 1):
        projection = projection_matrix(camera)
        (folder / f"camera{number}.Pmat.cal").write_text(_octave_text("Pmat", projection), encoding="utf-8")
        (folder / f"{basename}{number}.cal").write_text(_ray_text(camera, projection), encoding="utf-8")
        (folder / f"{basename}{number}.rad").write_text(format_rad(camera.intrinsics), encoding="utf-8")
    names = "".join(f"{camera.name}\n" for camera in calibration.cameras)
    sizes = "".join(f"{camera.size_px[0]} {camera.size_px[1]}\n" for camera in calibration.cameras)
    (folder / "camera_order.txt").write_text(names, encoding="utf-8")
    (folder / "Res.dat").write_text(sizes, encoding="utf-8")


def projection_matrix(camera: CalibratedCamera) -> FloatArray:
    """(3, 4) K [R | t] of a camera without its distortion."""
    focal_x, focal_y, centre_x, centre_y = camera.intrinsics[:4]
    camera_matrix = np.array([[focal_x, 0, centre_x], [0, focal_y, centre_y], [0, 0, 1]])
    return camera_matrix @ camera.cam_from_world.as_matrix()[:3]


def _octave_text(name: str, matrix: FloatArray) -> str:
    rows = "".join(" " + " ".join(map(repr, row)) + "\n" for row in matrix.tolist())
    return f"# name: {name}\n# type: matrix\n# rows: {matrix.shape[0]}\n# columns: {matrix.shape[1]}\n{rows}"


def _ray_text(camera: CalibratedCamera, projection: FloatArray) -> str:
    centre = [f"C{k + 1} = {value!r}\n" for k, value in enumerate(camera.centre_in_world.tolist())]
    ray_from_px = np.linalg.inv(projection[:, :3]).tolist()  # (K R)^-1 = R^T K^-1
    rays = [f"P{i + 1}{j + 1} = {value!r}\n" for i, row in enumerate(ray_from_px) for j, value in enumerate(row)]
    return "".join([*centre, "\n", *rays])
