"""What every reader of observations gives, and what all readers share: size limits, text decoding, the digest."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.observations import Observations
from network_calib.room_setup import CameraSetup, KnownCentres

# A day of 30 Hz spots from 50 cameras is about 4 GB of text; nobody waves that long. Beyond this a file is a mistake.
MAX_FILE_BYTES = 2 * 2**30


@dataclass(frozen=True, slots=True)
class Recording:
    """Observations and what was stored beside them.

    Attributes:
        name: of the folder or file.
        observations: the spots.
        setups: one for each camera, in the order of the camera indices; empty where the format knows no image sizes.
        known_centres: measured camera centres found beside the points; a candidate for the anchor, used on request.
        notes: what was dropped, assumed or not understood, one sentence each.
        sha256: digest of the observations, the same for the same spots in every format.
        is_named: False where the camera names were made up by the reader.
        is_frame_given: False where the frame numbers were made up by the reader, so that no other file can use them.
    """

    name: str
    observations: Observations
    setups: tuple[CameraSetup, ...]
    known_centres: KnownCentres | None
    notes: tuple[str, ...]
    sha256: str
    is_named: bool = True
    is_frame_given: bool = True


def digest(observations: Observations) -> str:
    """SHA-256 over names and columns, in little-endian 64-bit numbers."""
    sha = hashlib.sha256("\n".join(observations.camera_names).encode())
    stamps = () if observations.stamp_ns is None else (observations.stamp_ns,)
    for column in (observations.camera, observations.frame, observations.px, observations.sigma_px, *stamps):
        sha.update(np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("<")).tobytes())
    return sha.hexdigest()


def check_file_size(path: Path, *, limit_bytes: int = MAX_FILE_BYTES) -> None:
    """Refuse a missing file, a folder in its place, and a file beyond the limit, before anything is read.

    Raises:
        InputError: says which.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if not path.is_file():
        raise InputError(f"{path} is not a file")
    size = path.stat().st_size
    if size > limit_bytes:
        raise InputError(f"{path} has {size} bytes, expected at most {limit_bytes}")


def read_text(path: Path, *, limit_bytes: int = MAX_FILE_BYTES) -> str:
    """The text of a UTF-8 file, with or without byte-order mark.

    Raises:
        InputError: missing, too large, not UTF-8, or holding NUL characters (a binary file).
    """
    check_file_size(path, limit_bytes=limit_bytes)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text: byte {error.start} is 0x{error.object[error.start]:02x}") from None
    if "\0" in text:
        raise InputError(f"{path} is not text: character {text.index(chr(0))} is NUL")
    return text


def natural_key(name: str) -> tuple[tuple[int, str], ...]:
    """Sort key under which cam2 comes before cam10."""
    return tuple((int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name) if part)
