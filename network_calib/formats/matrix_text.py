"""Matrices as text, one row on a line, as Octave and NumPy write them; every fault is told with its place."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.formats.recording import read_text
from network_calib.observations import FloatArray, IntArray


def read_matrix(path: Path) -> FloatArray:
    """A text file of numbers, every row as long as the first; blank lines and lines after # or % do not count.

    Raises:
        InputError: names file, line, and the value or the count that does not fit.
    """
    lines = [(k, line) for k, line in enumerate(read_text(path).splitlines(), 1) if line.strip()]
    lines = [(k, line) for k, line in lines if line.lstrip()[0] not in "#%"]
    if not lines:
        raise InputError(f"{path} holds no numbers")
    rows = []
    for number, line in lines:
        tokens = line.split()
        if rows and len(tokens) != len(rows[0]):
            raise InputError(
                f"{path}, line {number}: {len(tokens)} numbers, expected {len(rows[0])} as in line {lines[0][0]}"
            )
        try:
            rows.append(np.array(list(map(_number if "_" in line else float, tokens))))
        except ValueError:
            column = next(k for k, token in enumerate(tokens) if not _is_number(token))
            raise InputError(
                f"{path}, line {number}, column {column + 1}: {tokens[column][:40]!r} is not a number"
            ) from None
    return np.stack(rows)


def write_matrix(path: Path, matrix: FloatArray | IntArray) -> None:
    """Write a matrix that `read_matrix` reads back exactly."""
    # repr of a float is the shortest text that reads back to the same number.
    path.write_text("".join(" ".join(map(repr, row)) + "\n" for row in matrix.tolist()), encoding="utf-8")


def _number(token: str) -> float:
    if "_" in token:  # Python reads 1_000 as a thousand; in a data file it is a fault
        raise ValueError(token)
    return float(token)


def _is_number(token: str) -> bool:
    try:
        _number(token)
    except ValueError:
        return False
    return True
