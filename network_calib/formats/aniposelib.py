"""Cameras in aniposelib's TOML layout, written and read back.

One table for each camera, [cam_00], [cam_01], ...: `name`, `size` (width, height, px), `matrix` (3 x 3), `distortions`
(k1, k2, p1, p2, k3 = 0; with `fisheye = true` k1..k4), `rotation` (rotation vector, rad) and `translation` of
x_in_cam = R x_in_world + t, in the unit of the calibration; then [metadata]. Its loader sorts the keys as text, so the
numbers are padded with zeros.
"""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.cameras import Cameras, LensModel
from network_calib.errors import InputError
from network_calib.formats.recording import natural_key, read_text
from network_calib.formats.strict_json import Node
from network_calib.observations import FloatArray
from network_calib.result import Calibration

_MAX_BYTES = 16 * 2**20


def write_aniposelib(calibration: Calibration, path: Path) -> None:
    """Write the file; numbers read back to the same doubles, except that a rotation passes through a vector."""
    digits = len(str(len(calibration.cameras) - 1))
    tables = []
    for number, camera in enumerate(calibration.cameras):
        focal_x, focal_y, centre_x, centre_y, *distortion = np.asarray(camera.intrinsics).tolist()
        matrix = [[focal_x, 0.0, centre_x], [0.0, focal_y, centre_y], [0.0, 0.0, 1.0]]
        lines = [
            f"[cam_{number:0{digits}d}]",
            f"name = {_string(camera.name)}",
            f"size = {[int(side) for side in camera.size_px]}",
            f"matrix = {matrix}",
            f"distortions = {distortion if camera.lens.is_fisheye else [*distortion, 0.0]}",
            f"rotation = {camera.cam_from_world.rotation.as_rotvec().tolist()}",
            f"translation = {camera.cam_from_world.translation.tolist()}",
            *(["fisheye = true"] if camera.lens.is_fisheye else []),
        ]
        tables.append("\n".join(lines) + "\n")
    fitted = calibration.quality.fitted.mean_px
    error = f"error = {fitted!r}\n" if math.isfinite(fitted) else ""
    tables.append(f"[metadata]\nadjusted = true\n{error}unit = {_string(calibration.world.unit)}\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(tables), encoding="utf-8")


def read_aniposelib(path: Path) -> Cameras:
    """Read cameras written here or by aniposelib; the lens model is the smallest that holds the distortion.

    Raises:
        InputError: no TOML, no cameras, or a field that is missing, of the wrong shape, or not modelled (a third radial
            term).
    """
    try:
        document = tomllib.loads(read_text(path, limit_bytes=_MAX_BYTES))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    keys = sorted((key for key in document if key != "metadata"), key=natural_key)
    if not keys:
        raise InputError(f"{path} holds no cameras, expected tables [cam_0], [cam_1], ...")
    faults: list[str] = []
    read = [_camera(Node(document[key], key, faults)) for key in keys]
    Node(None, "", faults).finish(path)
    names, sizes, lenses, intrinsics, poses = zip(*read, strict=True)
    return Cameras(
        names=names,
        size_px=np.array(sizes, dtype=np.int64),
        lenses=lenses,
        intrinsics=np.stack(intrinsics),
        cam_from_world=RigidTransform.concatenate(list(poses)),
    )


def _camera(node: Node) -> tuple[str, tuple[int, int], LensModel, FloatArray, RigidTransform]:
    is_fisheye = isinstance(node.value, dict) and node.value.get("fisheye") is True
    optional = ["fisheye"] if isinstance(node.value, dict) and "fisheye" in node.value else []
    fields = node.fields("name", "size", "matrix", "distortions", "rotation", "translation", *optional)
    width, height = (side.whole(1) for side in fields["size"].items(2))
    matrix = np.array([row.numbers(3) for row in fields["matrix"].items(3)])
    distortion = fields["distortions"].numbers(4 if is_fisheye else 5)
    if not is_fisheye and distortion[4] != 0:
        fields["distortions"].fail("k3 = 0, a third radial term is not modelled")
    intrinsics = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion[:4]])
    pose = RigidTransform.from_components(
        fields["translation"].numbers(3), Rotation.from_rotvec(fields["rotation"].numbers(3))
    )
    return fields["name"].text(), (width, height), _lens(distortion, is_fisheye=is_fisheye), intrinsics, pose


def _lens(distortion: list[float], *, is_fisheye: bool) -> LensModel:
    if is_fisheye:
        return LensModel.FISHEYE
    for lens in (LensModel.NONE, LensModel.K1, LensModel.K1_K2):
        if not any(distortion[lens.n_distortion :]):
            return lens
    return LensModel.K1_K2_P1_P2


def _string(text: str) -> str:
    """A TOML basic string: JSON's escapes are TOML's, but TOML also wants DEL escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
