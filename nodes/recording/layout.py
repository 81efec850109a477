"""A recording's folder: `session.mcap` and, while it is written, `parts/part-0001.mcap` and so on."""

from __future__ import annotations

import re
from pathlib import Path

SESSION, PARTS, TEMPORARY = "session.mcap", "parts", ".session.mcap.tmp"
# Of the session, where it was calibrated.
CALIBRATION = "calibration.json"
SUFFIX = ".mcap"
# Topics that are made from others, for viewers; no reader here takes them.
DERIVED = "/foxglove/"
SITE_NAME, SITE_TYPE = "site.toml", "application/toml"
METADATA = "spotcal"
_PART = re.compile(r"part-(\d{4,12})\.mcap")


def part_path(folder: Path, number: int) -> Path:
    """Where part `number`, from 1, is."""
    return folder / PARTS / f"part-{number:04d}{SUFFIX}"


def part_number(path: Path) -> int | None:
    """The number of a part; None for any other file."""
    match = _PART.fullmatch(path.name)
    return None if match is None else int(match[1])


def parts_of(folder: Path) -> tuple[Path, ...]:
    """All parts of a folder in their order."""
    numbered = [(number, path) for path in (folder / PARTS).glob("part-*") if (number := part_number(path)) is not None]
    return tuple(path for _, path in sorted(numbered))
