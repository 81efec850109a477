"""The number columns of an observation table: from text or array to checked numbers, with the place of each fault."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.observations import FloatArray, IntArray

REQUIRED = ("camera", "x_px", "y_px")
NUMBERS = ("frame", "stamp_ns", "x_px", "y_px", "sigma_px", "score")
# No image is as wide as this; a larger number is another unit or a broken file.
MAX_PIXEL = 1e6

Raw = list[str] | np.ndarray


@dataclass(frozen=True, slots=True)
class Columns:
    """Number columns of K rows.

    Attributes:
        px: (K, 2).
        sigma_px: (K,), NaN where unknown.
        frame: (K,) or None.
        stamp_ns: (K,) or None; one of the two is there.
        score: (K,) or None: then a camera has at most one row in a frame.
    """

    px: FloatArray
    sigma_px: FloatArray
    frame: IntArray | None
    stamp_ns: IntArray | None
    score: FloatArray | None

    @classmethod
    def of(cls, path: Path, arrays: dict[str, IntArray | FloatArray]) -> Columns:
        """Put parsed columns together.

        Raises:
            InputError: neither frame nor stamp_ns is there.
        """
        if "frame" not in arrays and "stamp_ns" not in arrays:
            raise InputError(f"{path} has neither a column frame nor stamp_ns, expected one of them or both")
        px = np.stack([arrays["x_px"], arrays["y_px"]], axis=1).astype(np.float64)
        sigma = arrays.get("sigma_px", np.full(len(px), np.nan)).astype(np.float64)
        frame, stamp = arrays.get("frame"), arrays.get("stamp_ns")
        score = arrays.get("score")
        return cls(px, sigma, _as_int(frame), _as_int(stamp), None if score is None else score.astype(np.float64))


def parse_column(path: Path, name: str, raw: Raw, lines: Sequence[int] | None) -> IntArray | FloatArray:
    """Numbers of the column `name` out of text (`lines`: the line number of each) or out of an array (`lines` None).

    Raises:
        InputError: a value is no number of the right kind, or out of range.
    """
    if name == "stamp_ns":
        return integers(path, name, raw, lines)
    if name == "frame":
        frames = integers(path, name, raw, lines)
        refuse(path, name, raw, lines, frames < 0, "0 or more")
        return frames
    if name == "sigma_px":
        raw = [text if text.strip() else "nan" for text in raw] if isinstance(raw, list) else raw
        values = floats(path, name, raw, lines)
        refuse(path, name, raw, lines, (values <= 0) | (values > MAX_PIXEL), "a number > 0, or nothing")
        return values
    values = floats(path, name, raw, lines)
    if name == "score":
        refuse(path, name, raw, lines, ~((values >= 0) & (values <= 1)), "a number from 0 to 1")
        return values
    refuse(path, name, raw, lines, ~(np.abs(values) <= MAX_PIXEL), f"a number within +-{MAX_PIXEL:g}")
    return values


def _as_int(column: IntArray | FloatArray | None) -> IntArray | None:
    return None if column is None else column.astype(np.int64)


def floats(path: Path, name: str, raw: Raw, lines: Sequence[int] | None) -> FloatArray:
    """Numbers, whatever their size; for the arguments see `parse_column`.

    Raises:
        InputError: a value is no number.
    """
    if not isinstance(raw, list):
        if raw.dtype.kind not in "fiu":
            raise InputError(f"{path}: array {name} is {raw.dtype}, expected numbers")
        return raw.astype(np.float64)
    try:
        return np.array(_plain(float, raw), dtype=np.float64)
    except ValueError:
        refuse(path, name, raw, lines, np.array([not _parses(float, text) for text in raw]), "a number")
        raise


def integers(path: Path, name: str, raw: Raw, lines: Sequence[int] | None) -> IntArray:
    """Whole numbers; for the arguments see `parse_column`.

    Raises:
        InputError: a value is no whole number within 64 bits.
    """
    if not isinstance(raw, list):
        if raw.dtype.kind not in "iu":
            raise InputError(f"{path}: array {name} is {raw.dtype}, expected whole numbers")
        refuse(path, name, raw, lines, raw > np.iinfo(np.int64).max, "a whole number within 64 bits")
        return raw.astype(np.int64)
    try:
        return np.array(_plain(int, raw), dtype=np.int64)
    except (ValueError, OverflowError):
        is_wrong = np.array([not _parses(_int64, text) for text in raw])
        refuse(path, name, raw, lines, is_wrong, "a whole number within 64 bits")
        raise


def _int64(text: str) -> int:
    return int(np.int64(int(text)))


def _plain(parse: Callable[[str], float], texts: list[str]) -> list[float]:
    """Parse, but not as Python source: 1_000 is no number in a data file."""
    if "_" in "".join(texts):
        raise ValueError("digits with an underscore")
    return list(map(parse, texts))


def _parses(parse: Callable[[str], float], text: str) -> bool:
    try:
        _plain(parse, [text])
    except (ValueError, OverflowError):
        return False
    return True


def refuse(path: Path, name: str, raw: Raw, lines: Sequence[int] | None, is_wrong: np.ndarray, expected: str) -> None:
    """Refuse the values where `is_wrong` (K,) holds: file, line, column, value, and what was expected.

    Raises:
        InputError: there is one.
    """
    if not is_wrong.any():
        return
    k = int(np.flatnonzero(is_wrong)[0])
    place = f"array {name}, index {k}" if lines is None else f"line {lines[k]}, column {name}"
    more = f" ({int(is_wrong.sum())} such values)" if is_wrong.sum() > 1 else ""
    raise InputError(f"{path}, {place}: {str(raw[k])[:40]!r}, expected {expected}{more}")
