"""The .rad files of MultiCamSelfCal: one camera's matrix K11..K33 and Brown distortion kc1..kc4, as `name = value`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.formats.recording import read_text
from network_calib.observations import FloatArray

_MATRIX = [[f"K{row}{column}" for column in (1, 2, 3)] for row in (1, 2, 3)]
_REQUIRED = [name for row in _MATRIX for name in row] + [f"kc{k}" for k in (1, 2, 3, 4)]
_OPTIONAL = ["kc5", "alpha_c"]
_MAX_BYTES = 1_000_000


def read_rad_intrinsics(path: Path) -> tuple[FloatArray, list[str]]:
    """(8,) intrinsics of `network_calib.cameras`, and notes on what the file says beyond them.

    kc1..kc4 are k1, k2, p1, p2 of the Caltech toolbox, which are OpenCV's. Skew and a third radial term are not
    modelled: they are left out, with a note when they are not zero.

    Raises:
        InputError: a value is missing, given twice, unknown, not finite, or no camera matrix.
    """
    values = _read_values(path)
    matrix = np.array([[values[name] for name in row] for row in _MATRIX])
    focal_x, focal_y = matrix[0, 0], matrix[1, 1]
    if not (focal_x > 0 and focal_y > 0):
        raise InputError(f"{path}: K11 = {focal_x:g}, K22 = {focal_y:g}, expected focal lengths > 0")
    if (matrix[[1, 2, 2], [0, 0, 1]] != 0).any() or matrix[2, 2] != 1:
        raise InputError(f"{path}: K is no camera matrix, expected K21 = K31 = K32 = 0 and K33 = 1")
    notes = []
    if matrix[0, 1] != 0 or values.get("alpha_c", 0.0) != 0:
        notes.append(f"{path.name}: a skew is given; pixels are modelled without skew, so it is left out")
    if values.get("kc5", 0.0) != 0:
        notes.append(f"{path.name}: kc5 = {values['kc5']:g} is given; a third radial term is not modelled, left out")
    distortion = [values[f"kc{k}"] for k in (1, 2, 3, 4)]
    return np.array([focal_x, focal_y, matrix[0, 2], matrix[1, 2], *distortion]), notes


def format_rad(intrinsics: FloatArray) -> str:
    """The text of a .rad file; the original's reader wants exactly this order and values from the seventh column on.

    Args:
        intrinsics: (8,) of a lens without fisheye.
    """
    focal_x, focal_y, centre_x, centre_y = intrinsics[:4].tolist()
    matrix = [focal_x, 0.0, centre_x, 0.0, focal_y, centre_y, 0.0, 0.0, 1.0]
    lines = [f"{name} = {value!r}" for name, value in zip(_REQUIRED[:9], matrix, strict=True)]
    lines += ["", *(f"kc{k + 1} = {value!r}" for k, value in enumerate(intrinsics[4:].tolist()))]
    return "\n".join(lines) + "\n\n"


def _read_values(path: Path) -> dict[str, float]:
    values: dict[str, float] = {}
    for number, line in enumerate(read_text(path, limit_bytes=_MAX_BYTES).splitlines(), 1):
        if not line.strip():
            continue
        name, equals, text = (part.strip() for part in line.partition("="))
        if not equals or name not in (*_REQUIRED, *_OPTIONAL):
            raise InputError(f"{path}, line {number}: {line.strip()[:60]!r}, expected K11..K33, kc1..kc4 = number")
        if name in values:
            raise InputError(f"{path}, line {number}: {name} is given twice")
        try:
            values[name] = float(text)
        except ValueError:
            raise InputError(f"{path}, line {number}: {name} = {text[:40]!r} is not a number") from None
        if not math.isfinite(values[name]):
            raise InputError(f"{path}, line {number}: {name} = {text[:40]} is not finite")
    missing = [name for name in _REQUIRED if name not in values]
    if missing:
        raise InputError(f"{path}: {', '.join(missing)} missing")
    return values
