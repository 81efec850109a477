"""What the command line says about detection, as numbers: sources with names, channel, background, mask."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from network_calib.errors import InputError
from nodes.detection.spots import BoolArray, Channel

# NAME=SOURCE; a slash or colon before the sign belongs to a path or an address.
_NAMED = re.compile(r"([^=/\\:?]+)=(.+)", re.DOTALL)
_LIVE = re.compile(r"/dev/|usb:|(?!file:)[a-z][a-z0-9+.-]*://", re.IGNORECASE)
WHOLE = "whole"


@dataclass(frozen=True, slots=True)
class NamedSource:
    """A source and the name of its camera.

    Attributes:
        name: of the camera.
        text: path or address.
        mask: image that is black where no spot may be; None: everywhere may be.
    """

    name: str
    text: str
    mask: Path | None = None


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """What a person chooses; travels between processes.

    Attributes:
        channel: the light of the pointer.
        n_learning: frames of the empty scene at the beginning; None learns from the whole recording, spot and all.
        max_candidates: at most so many spots a frame.
    """

    channel: Channel = Channel.AUTO
    n_learning: int | None = None
    max_candidates: int = 4


def named_sources(texts: Sequence[str]) -> tuple[NamedSource, ...]:
    """Cameras named as `NAME=SOURCE` says, else after their file or folder, else by number.

    Files of one name in several folders are named after the folders.

    Raises:
        InputError: a name twice.
    """
    given = [_NAMED.fullmatch(text) if not Path(text).exists() else None for text in texts]
    paths = [text if match is None else match[2] for text, match in zip(texts, given, strict=True)]
    stems = [_stem(path, number) for number, path in enumerate(paths)]
    if len(set(stems)) < len(stems):
        folders = [Path(path).absolute().parent.name for path in paths]
        stems = folders if len(set(folders)) == len(folders) else stems
    names = [stem if match is None else match[1].strip() for stem, match in zip(stems, given, strict=True)]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"two sources would be camera {twice[0]!r}", advice="Name the cameras: C0=first.mp4 C1=second.mp4"
        )
    return tuple(NamedSource(name, path) for name, path in zip(names, paths, strict=True))


def with_masks(sources: Sequence[NamedSource], texts: Sequence[str]) -> tuple[NamedSource, ...]:
    """The sources with masks: `NAME=IMAGE` for one camera, `IMAGE` for all that have none of their own.

    Raises:
        InputError: a camera that is not there, two masks for one camera, or a file that is no image.
    """
    masks: dict[str | None, Path] = {}
    for text in texts:
        match = _NAMED.fullmatch(text) if not Path(text).exists() else None
        name, path = (None, Path(text)) if match is None else (match[1].strip(), Path(match[2]))
        if name is not None and name not in {source.name for source in sources}:
            raise InputError(f"--mask {text}: no camera {name!r}, expected one of {', '.join(s.name for s in sources)}")
        if name in masks:
            raise InputError(f"--mask {text}: {name or 'all cameras'} have the mask {masks[name]} already")
        masks[name] = path
        read_mask_file(path)
    return tuple(replace(source, mask=masks.get(source.name, masks.get(None))) for source in sources)


def is_recording(text: str) -> bool:
    """Whether a source is a file, a folder or a pattern of files, which can be read twice; a live camera cannot."""
    return _LIVE.match(text.strip()) is None


def parse_channel(text: str) -> Channel:
    """The channel of a name.

    Raises:
        InputError: no such channel.
    """
    if text not in list(Channel):
        raise InputError(f"--channel {text}: expected one of {', '.join(Channel)}")
    return Channel(text)


def parse_background(text: str) -> int | None:
    """How many frames at the beginning show the empty scene; None for `whole`.

    Raises:
        InputError: neither `whole` nor `first:N` with N > 0.
    """
    if text == WHOLE:
        return None
    match = re.fullmatch(r"first:([0-9]{1,9})", text)
    if match is None or int(match[1]) == 0:
        raise InputError(f"--background {text}: expected whole, or first:N with the number of empty frames")
    return int(match[1])


def read_mask_file(path: Path) -> BoolArray:
    """(h, w) True where a spot may be: where the image is not black.

    Raises:
        InputError: no image.
    """
    import cv2
    import numpy as np

    if not path.is_file():
        raise InputError(f"--mask {path}: no such file")
    image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_GRAYSCALE) if path.stat().st_size else None
    if image is None:
        raise InputError(f"--mask {path} is no image that can be read, expected PNG or the like, black where masked")
    return image > 127


def read_mask(path: Path, size_px: tuple[int, int]) -> BoolArray:
    """The mask for pictures of a size.

    Raises:
        InputError: no image, or of another size.
    """
    mask = read_mask_file(path)
    height, width = mask.shape
    if (width, height) != size_px:
        raise InputError(
            f"--mask {path} has {width} x {height} pixels, the camera {size_px[0]} x {size_px[1]}: expected the same"
        )
    return mask


def _stem(path: str, number: int) -> str:
    """`door` of `walk/door.mp4`, of a folder `walk/door`, and of the pattern `walk/door_*.png`."""
    if not is_recording(path):
        return f"C{number}"
    given = Path(path).absolute()
    stem = given.name if given.is_dir() else given.stem
    return stem if given.exists() else re.split(r"[*?\[]", stem)[0].rstrip("_-. ") or f"C{number}"
