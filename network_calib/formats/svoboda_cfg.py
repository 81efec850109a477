"""The configuration of MultiCamSelfCal (multicamselfcal.cfg): checked key by key, used where it describes the data.

Basename names the .rad files, Num-Cameras is checked against the points, Undo-Radial asks for the .rad files. The other
keys steer steps of the original that have no counterpart here and change nothing. A key that the original does not know
either is reported by name, because the original ignores it silently.
"""

from __future__ import annotations

import configparser
import difflib
from dataclasses import dataclass
from pathlib import Path

from network_calib.errors import InputError
from network_calib.formats.recording import read_text

_KNOWN_KEYS = {
    "Experiment": ("Name",),
    "Paths": ("Data", "Camera-Images"),
    "Files": ("Basename", "Image-Name-Prefix", "Image-Extension", "Projector-Data-Filename"),
    "Images": ("LED-Size", "LED-Color", "LED-Threshold", "Subpix", "Camera-Resolution", "Projector-Resolution"),
    "Calibration": (
        *("Num-Cameras", "Num-Projectors", "Nonlinear-Parameters", "Nonlinear-Update", "Initial-Tolerance"),
        *("Do-Global-Iterations", "Global-Iteration-Threshold", "Global-Iteration-Max", "Num-Cameras-Fill"),
        *("Do-Bundle-Adjustment", "Start-Bundle-Adjustment", "Undo-Radial", "Undo-Heikk", "Min-Points-Value"),
        *("N-Tuples", "Square-Pixels", "Use-Nth-Frame", "Align-Existing"),
    ),
}
_MAX_BYTES = 1_000_000


@dataclass(frozen=True, slots=True)
class SvobodaCfg:
    """What of the configuration is used.

    Attributes:
        path: the file, for messages.
        basename: prefix of the .rad files, or None.
        n_cameras: cameras and projectors (both have rows in points.dat), or None when not said.
        undo_radial: the .rad files are asked for.
        notes: unknown keys.
    """

    path: str
    basename: str | None
    n_cameras: int | None
    undo_radial: bool
    notes: tuple[str, ...]


NO_CFG = SvobodaCfg("", None, None, False, ())


def read_cfg(path: Path) -> SvobodaCfg:
    """Read the file.

    Raises:
        InputError: it is no configuration, or Num-Cameras, Num-Projectors or Undo-Radial is not a number.
    """
    parser = configparser.RawConfigParser(delimiters=(":",), comment_prefixes=("#", "%"), strict=True)
    parser.optionxform = lambda optionstr: optionstr.replace("_", "-").replace(" ", "-")  # as the original does
    try:
        parser.read_string(read_text(path, limit_bytes=_MAX_BYTES))
    except configparser.Error as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}") from None
    n_cameras = _number(parser, path, "Num-Cameras")
    n_projectors = _number(parser, path, "Num-Projectors") or 0
    return SvobodaCfg(
        path=str(path),
        basename=parser.get("Files", "Basename", fallback=None),
        n_cameras=None if n_cameras is None else n_cameras + n_projectors,
        undo_radial=bool(_number(parser, path, "Undo-Radial")),
        notes=tuple(_unknown_keys(parser, path)),
    )


def _number(parser: configparser.RawConfigParser, path: Path, key: str) -> int | None:
    text = parser.get("Calibration", key, fallback=None)
    if text is None:
        return None
    try:
        return int(text)
    except ValueError:
        raise InputError(f"{path}: [Calibration] {key} is {text[:40]!r}, expected a whole number") from None


def _unknown_keys(parser: configparser.RawConfigParser, path: Path) -> list[str]:
    notes = []
    for section in parser.sections():
        if section not in _KNOWN_KEYS:
            notes.append(f"{path}: section [{section}] is unknown and has no effect{_hint(section, _KNOWN_KEYS)}")
            continue
        for key in parser.options(section):
            if key not in _KNOWN_KEYS[section]:
                hint = _hint(key, _KNOWN_KEYS[section])
                notes.append(f"{path}: [{section}] {key} is unknown and has no effect{hint}")
    return notes


def _hint(word: str, known: dict[str, tuple[str, ...]] | tuple[str, ...]) -> str:
    close = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""
