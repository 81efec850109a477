"""Laser points in a table: measurements (lrf, range_m, bearing_rad, tilt_deg), or points in world (x, y, z)."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.observations import FloatArray
from nodes.projection.points import Beams, WorldPoints

MEASURED, IN_WORLD = ("lrf", "range_m", "bearing_rad", "tilt_deg"), ("x", "y", "z")
ADVICE = f"The first line names the columns: {','.join(MEASURED)} or {','.join(IN_WORLD)} (m, in the world frame)."


def read_points(path: Path) -> tuple[Beams | WorldPoints, ...]:
    """The points of a CSV file; measurements LRF by LRF, in the order of the file.

    Raises:
        InputError: it cannot be read, or a line is not what the first one says.
    """
    try:
        rows = [row for row in csv.reader(path.read_text(encoding="utf-8").splitlines()) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot read {path}: {error}") from None
    columns = tuple(name.strip() for name in rows[0]) if rows else ()
    if set(columns) == set(MEASURED):
        return _measured(path, columns, rows[1:])
    if set(columns) == set(IN_WORLD):
        numbers = _numbers(path, columns, IN_WORLD, rows[1:])
        return (WorldPoints(numbers),)
    raise InputError(f"{path} has the columns {', '.join(columns) or 'of an empty file'}", advice=ADVICE)


def _measured(path: Path, columns: Sequence[str], rows: list[list[str]]) -> tuple[Beams, ...]:
    numbers = _numbers(path, columns, MEASURED[1:], rows)
    names = [row[columns.index("lrf")].strip() for row in rows]
    out = []
    for name in dict.fromkeys(names):
        range_m, bearing_rad, tilt_deg = numbers[[one == name for one in names]].T
        out.append(Beams(name, range_m, bearing_rad, np.radians(tilt_deg)))
    return tuple(out)


def _numbers(path: Path, columns: Sequence[str], wanted: Sequence[str], rows: list[list[str]]) -> FloatArray:
    """(N, columns wanted)."""
    if not rows:
        raise InputError(f"{path} holds no points", advice=ADVICE)
    out = np.empty((len(rows), len(wanted)))
    for number, row in enumerate(rows):
        try:
            if len(row) != len(columns):
                raise ValueError
            out[number] = [float(row[columns.index(name)]) for name in wanted]
        except ValueError:
            text = ",".join(row)[:80]
            raise InputError(f"{path}, point {number + 1}: {text!r} is no row of {','.join(columns)}") from None
    return out
