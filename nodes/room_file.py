"""The room configuration beside a table: `walk.toml` for `walk.csv`. Written by `detect`, read where none is named."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import tomli_w

from network_calib.errors import InputError
from nodes.config import load_room
from nodes.config_model import RoomConfig

TABLE_SUFFIXES = (".csv", ".npz")


def room_beside(source: Path) -> Path | None:
    """The configuration that belongs to a table, where there is one; never that of a folder."""
    if source.suffix.lower() not in TABLE_SUFFIXES:
        return None
    path = source.with_suffix(".toml")
    return path if path.is_file() else None


def room_text(sizes_px: Mapping[str, tuple[int, int]], *, table: str) -> str:
    """A room.toml that says what recordings tell: names and image sizes; and how to say more."""
    names, table = list(sizes_px), " ".join(table.split())
    lines = [
        f"# What is known of the cameras of {table}; `spotcal calibrate {table}` reads it. Yours to edit.",
        "",
        "# For metres, measure the distance between the lenses of two cameras and take these # away:",
        "# [anchor]",
        '# kind = "distance"',
        f"# cameras = [{_quoted(names[0])}, {_quoted(names[1])}]",
        "# distance_m = 0.35",
    ]
    for name, (width, height) in sizes_px.items():
        lines += ["", "[[cameras]]", f"name = {_quoted(name)}", f"size = [{width}, {height}]"]
    return "\n".join(lines) + "\n"


def keeps(path: Path, sizes_px: Mapping[str, tuple[int, int]]) -> bool:
    """Whether the file describes just these cameras, so that what a person wrote into it still holds."""
    if not path.is_file():
        return False
    try:
        room = load_room(path)
    except InputError:
        return False
    return len(room.cameras) == len(sizes_px) and sizes_of(room) == dict(sizes_px)


def sizes_of(room: RoomConfig) -> dict[str, tuple[int, int]]:
    """Width and height by camera name, of the cameras whose size is given."""
    return {camera.name: (camera.size[0], camera.size[1]) for camera in room.cameras if camera.size is not None}


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Have a file written under another name beside it and moved into place: whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays, because NumPy appends one that it misses.
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    unfinished = Path(name)
    try:
        write(unfinished)
        # mkstemp lets nobody else read; the file is to be as if written in the usual way.
        mask = os.umask(0)
        os.umask(mask)
        unfinished.chmod(0o666 & ~mask)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _quoted(name: str) -> str:
    """A TOML string."""
    return tomli_w.dumps({"name": name}).removeprefix("name = ").rstrip("\n")
