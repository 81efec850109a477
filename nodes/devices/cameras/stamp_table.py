"""Stamp tables beside videos and images: CSV, `frame,stamp_ns` for both, or `file,stamp_ns` for images.

`stamp_ns` is the instant of capture in ns. Rows of a video's table stand in the order of its frames, one row for each;
their `frame` numbers rise, and a gap means that the recorder lost frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.formats.csv_text import ColumnNames, csv_columns
from network_calib.formats.table_columns import integers, refuse
from network_calib.observations import IntArray

_VIDEO_COLUMNS = ColumnNames(
    ("frame", "stamp_ns"), ("frame", "stamp_ns"), "expected frame,stamp_ns with one row for each frame of the video"
)
_IMAGE_COLUMNS = ColumnNames(
    ("stamp_ns",), ("file", "frame", "stamp_ns"), "expected file,stamp_ns or frame,stamp_ns with a row for each image"
)
_ADVICE = "Correct the table, or take it away: then the file's own times are used."


@dataclass(frozen=True, slots=True)
class VideoStamps:
    """Stamps of N frames of a video, in the order of presentation.

    Attributes:
        path: of the table.
        frame: (N,) numbers as the recorder counted, rising.
        stamp_ns: (N,) rising.
        lines: (N,) line of each row in the file.
    """

    path: Path
    frame: IntArray
    stamp_ns: IntArray
    lines: Sequence[int]


@dataclass(frozen=True, slots=True)
class ImageStamps:
    """Stamps of images by file name or by frame number.

    Attributes:
        path: of the table.
        is_by_file: keys are file names, else frame numbers.
        rows: (line in the file, stamp) for each key.
    """

    path: Path
    is_by_file: bool
    rows: dict[str | int, tuple[int, int]]

    def row(self, name: str, number: int) -> tuple[int, int]:
        """Line in the table and stamp in ns of an image by its file name or its number.

        Raises:
            InputError: the table has no row for it.
        """
        found = self.rows.get(name if self.is_by_file else number)
        if found is None:
            what = f"file {name}" if self.is_by_file else f"frame {number} ({name})"
            raise InputError(f"{self.path} has no row for {what}, expected a row for each image", advice=_ADVICE)
        return found


def video_table_beside(video: Path) -> Path | None:
    """The stamp table of a video, `name.stamps.csv` or `name.csv` beside `name.mp4`; None when there is none.

    `name.csv` may as well be a table of spots: one that has a column x_px is left alone.

    Raises:
        InputError: both are there.
    """
    named, plain = video.with_suffix(".stamps.csv"), video.with_suffix(".csv")
    is_plain = plain.is_file() and plain != video and not _is_spot_table(plain)
    if named.is_file() and is_plain:
        raise InputError(
            f"{video}: both {named.name} and {plain.name} stand beside it, expected one stamp table",
            advice="Take one of them away, or name the table in the options.",
        )
    return named if named.is_file() else plain if is_plain else None


def read_video_stamps(path: Path) -> VideoStamps:
    """Read the table of a video.

    Raises:
        InputError: names file, line, column, value and what was expected.
    """
    columns, lines = _columns(path, _VIDEO_COLUMNS)
    frame, stamp = (_numbers(path, name, columns[name], lines) for name in ("frame", "stamp_ns"))
    for name, values in (("frame", frame), ("stamp_ns", stamp)):
        is_wrong = np.concatenate([[False], np.diff(values) <= 0])
        refuse(path, name, columns[name], lines, is_wrong, "more than in the row before")
    return VideoStamps(path, frame, stamp, lines)


def check_row_count(stamps: VideoStamps, video: Path, n_frames: int) -> None:
    """Refuse a table that does not have one row for each frame: every stamp after the difference would be wrong.

    Raises:
        InputError: says how many rows and frames there are.
    """
    n_rows = len(stamps.frame)
    if n_rows == n_frames:
        return
    place = f", line {stamps.lines[n_frames]}" if n_rows > n_frames else ""
    raise InputError(
        f"{stamps.path}{place}: {n_rows} rows for the {n_frames} frames of {video.name}, expected as many",
        advice="Where the end of the video is missing, cut the table there. " + _ADVICE,
    )


def read_image_stamps(path: Path) -> ImageStamps:
    """Read the table of a folder of images; it may have rows for images that are not there.

    Raises:
        InputError: names file, line, column, value and what was expected.
    """
    columns, lines = _columns(path, _IMAGE_COLUMNS)
    stamp = _numbers(path, "stamp_ns", columns["stamp_ns"], lines)
    name = "file" if "file" in columns else "frame"
    if name not in columns:
        raise InputError(f"{path}, line 1: neither a column file nor frame, {_IMAGE_COLUMNS.expected}")
    texts = columns[name]
    keys = [text.strip() for text in texts] if name == "file" else _numbers(path, name, texts, lines).tolist()
    rows: dict[str | int, tuple[int, int]] = {}
    for line, key, stamp_ns in zip(lines, keys, stamp.tolist(), strict=True):
        if key in rows:
            raise InputError(f"{path}, line {line}, column {name}: {key!r} stands there twice", advice=_ADVICE)
        rows[key] = (line, stamp_ns)
    return ImageStamps(path, name == "file", rows)


def _columns(path: Path, names: ColumnNames) -> tuple[dict[str, list[str]], Sequence[int]]:
    try:
        return csv_columns(path, names)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}", advice=_ADVICE) from None


def _numbers(path: Path, name: str, texts: list[str], lines: Sequence[int]) -> IntArray:
    values = integers(path, name, texts, lines).astype(np.int64)
    refuse(path, name, texts, lines, values < 0, "0 or more")
    return values


def _is_spot_table(path: Path) -> bool:
    with path.open("rb") as file:
        return b"x_px" in file.readline(1000)
