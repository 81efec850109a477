"""The result file, calibration.json: versioned, validated on load, and stable bit for bit when loaded and saved again.

Numbers are written with the shortest digits that read back to the same double; not-a-number stands as null where a
figure may be missing. Lengths are in `world.unit` ("m", or "unit" without metric information), so `translation` and the
centres carry no unit in their names. `sigma` and `centre_in_world` repeat, for a person, what covariance and pose say;
on load they must agree. The pose is cam_from_world: x_in_target = rotation * x_in_source + translation.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from network_calib.cameras import LensModel
from network_calib.errors import InputError
from network_calib.formats.calibration_reader import read_calibration
from network_calib.formats.lrf_json import lrf_document
from network_calib.formats.shared_json import canonical_pose, covariance_document, pose_document
from network_calib.formats.strict_json import Node, parse_json, parse_json_text
from network_calib.result import PARAMETER_NAMES, CalibratedCamera, Calibration

SCHEMA = "spotcal.calibration/1"


def save(calibration: Calibration, path: Path) -> None:
    """Write the file at once or not at all: a reader never sees half of it.

    The rotation may change in its last bit, because a quaternion and a matrix round differently; from then on it stays.

    Raises:
        InputError: the calibration breaks the schema, for example by an infinite number.
    """
    root = Node(to_document(calibration), "$")
    as_loaded = read_calibration(root, schema=SCHEMA)
    root.finish(f"the calibration for {path}")
    text = _format(to_document(as_loaded)) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def load(path: Path) -> Calibration:
    """Read and validate a file.

    Raises:
        InputError: lists every fault with its JSON path.
    """
    return _read(parse_json(path), path)


def loads(text: bytes, source: Path | str) -> Calibration:
    """The same of a file's bytes; `source` stands in the message.

    Raises:
        InputError: see `load`.
    """
    try:
        return _read(parse_json_text(text.decode("utf-8-sig"), source), source)
    except UnicodeDecodeError as error:
        raise InputError(f"{source} is not UTF-8 text: byte {error.start}") from None


def _read(value: object, source: Path | str) -> Calibration:
    root = Node(value, "$")
    calibration = read_calibration(root, schema=SCHEMA)
    root.finish(source)
    return calibration


def to_document(calibration: Calibration) -> dict[str, object]:
    """The calibration as nested dictionaries of JSON values."""
    world = calibration.world.name
    lrfs = [_as_json(lrf_document(lrf, world=world)) for lrf in calibration.lrfs]
    return {
        "schema": SCHEMA,
        "world": _as_json(asdict(calibration.world)),
        "cameras": [_camera_document(camera, world=world) for camera in calibration.cameras],
        **({"lrfs": lrfs} if lrfs else {}),
        "quality": _as_json(asdict(calibration.quality)),
        "warnings": [_as_json(asdict(warning)) for warning in calibration.warnings],
        "provenance": _as_json(asdict(calibration.provenance)),
    }


def distortion_names(lens: LensModel) -> tuple[str, str, str, str]:
    """What the four distortion terms of a lens are called."""
    return ("k1", "k2", "k3", "k4") if lens.is_fisheye else ("k1", "k2", "p1", "p2")


def _camera_document(camera: CalibratedCamera, *, world: str) -> dict[str, object]:
    # The derived centre must come from the pose as it will be loaded.
    pose = canonical_pose(camera.cam_from_world)
    focal_x, focal_y, centre_x, centre_y, *distortion = np.asarray(camera.intrinsics).tolist()
    return {
        "name": camera.name,
        "size_px": [int(side) for side in camera.size_px],
        "lens": camera.lens.value,
        "intrinsics": {
            "focal_x_px": focal_x,
            "focal_y_px": focal_y,
            "centre_x_px": centre_x,
            "centre_y_px": centre_y,
            "distortion": dict(zip(distortion_names(camera.lens), distortion, strict=True)),
        },
        "is_intrinsics_fixed": _as_json(camera.is_intrinsics_fixed),
        "cam_from_world": pose_document(pose, target=camera.name, source=f"world {world}"),
        "centre_in_world": pose.inv().translation.tolist(),
        "sigma": dict(zip(PARAMETER_NAMES, camera.sigma.tolist(), strict=True)),
        "covariance": covariance_document(camera.covariance, PARAMETER_NAMES),
        "quality": _as_json(asdict(camera.quality)),
    }


def _as_json(value: object) -> object:
    """Dictionaries of plain numbers: NumPy's scalars unpacked, not-a-number as None."""
    if isinstance(value, dict):
        return {name: _as_json(member) for name, member in value.items()}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, list):
        return [_as_json(member) for member in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _format(value: object, indent: str = "") -> str:
    """JSON text with one line for each field, and arrays of plain numbers or words on one line."""
    inner = indent + "  "
    if isinstance(value, dict) and value:
        members = [f"{inner}{json.dumps(name)}: {_format(member, inner)}" for name, member in value.items()]
        return "{\n" + ",\n".join(members) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(member, dict | list) for member in value):
        return "[\n" + ",\n".join(inner + _format(member, inner) for member in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)
