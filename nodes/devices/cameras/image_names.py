"""Images of a folder in the order of the numbers in their names.

The frame number is the last group of digits that differs between the names: of `cam1_0007.png`, `cam1_0012.png` the
second group. Folders of several cameras are matched by these numbers, and a gap is a frame that was lost.
"""

from __future__ import annotations

import fnmatch
import os
import re
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path

from network_calib.formats.recording import natural_key
from nodes.devices.errors import SourceError

SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff"})
_STAMP_DIGITS = 16  # ns since 1970 have 19 digits; no recorder counts to 10^15
_PATTERN_ADVICE = "Give a pattern that takes the images of one camera, such as folder/cam1_*.png."


class Numbering(StrEnum):
    """What the numbers in the names of images mean."""

    FRAME = "frame"  # frame numbers
    STAMP_NS = "stamp_ns"  # instants of capture in ns; frames are numbered from 0 in their order
    NONE = "none"  # nothing; frames are numbered from 0 in the natural order of the names


@dataclass(frozen=True, slots=True)
class NumberedImage:
    """One image file.

    Attributes:
        name: inside its folder.
        number: of the frame.
        stamp_ns: told by the name; None where names do not tell it.
    """

    name: str
    number: int
    stamp_ns: int | None = None


def numbered_images(folder: Path, pattern: str | None, numbering: Numbering) -> tuple[NumberedImage, ...]:
    """The images of a folder, by rising number; hidden files and what is no image by its suffix are left alone.

    Args:
        folder: its subfolders are not searched.
        pattern: of the names, with `*`, `?` and `[...]`; None: all.
        numbering: what the numbers mean.

    Raises:
        SourceError: no such folder, no images in it, or names that do not tell one number for each image.
    """
    names = sorted(_image_names(folder, pattern), key=natural_key)
    if numbering is Numbering.NONE:
        return tuple(NumberedImage(name, k) for k, name in enumerate(names))
    images = sorted(zip(_numbers(folder, names), names, strict=True))
    for (number, name), (next_number, next_name) in pairwise(images):
        if number == next_number:
            raise SourceError(
                f"{folder}: {name} and {next_name} both have the number {number}, expected one image for each",
                advice=_PATTERN_ADVICE,
            )
    if numbering is Numbering.STAMP_NS:
        return tuple(NumberedImage(name, k, stamp_ns) for k, (stamp_ns, name) in enumerate(images))
    if images[-1][0] >= 10 ** (_STAMP_DIGITS - 1):
        raise SourceError(
            f"{folder}: {images[-1][1]} would be frame {images[-1][0]}, which looks like an instant in ns",
            advice=f"Say that the names hold stamps: numbering = {Numbering.STAMP_NS.value}.",
        )
    return tuple(NumberedImage(name, number) for number, name in images)


def _image_names(folder: Path, pattern: str | None) -> list[str]:
    try:
        if not folder.is_dir():
            what = "is not a folder" if folder.exists() else "does not exist"
            raise SourceError(f"{folder} {what}, expected a folder of images", advice="Check the path.")
        entries = sorted(os.listdir(folder))
    except OSError as error:
        raise SourceError(
            f"{folder} cannot be read: {error.strerror}",
            advice=f"Give this user the right to read it and to enter its folders: chmod a+rx '{folder.name}'.",
        ) from None
    visible = [name for name in entries if not name.startswith(".")]
    images = [name for name in visible if Path(name).suffix.lower() in SUFFIXES]
    chosen = [name for name in images if pattern is None or fnmatch.fnmatchcase(name, pattern)]
    if chosen:
        return chosen
    where = f"{folder}: no image" + (f" among {len(images)} fits the pattern {pattern!r}" if pattern else "")
    raise SourceError(f"{where}{_what_is_there(folder, visible)}", advice=f"Expected files ending in {_suffix_list()}.")


def _what_is_there(folder: Path, visible: list[str]) -> str:
    folders = [name for name in visible if (folder / name).is_dir()]
    if folders:
        return f"; it holds the folders {', '.join(folders[:4])}: give one of them for each camera"
    suffixes = Counter(Path(name).suffix or "without suffix" for name in visible)
    return f"; it holds {', '.join(f'{n} x {suffix}' for suffix, n in suffixes.most_common(4)) or 'nothing'}"


def _suffix_list() -> str:
    return ", ".join(sorted(SUFFIXES))


def _numbers(folder: Path, names: list[str]) -> list[int]:
    """The frame number of each name: all names must agree but for their digits."""
    split = [re.split(r"([0-9]+)", Path(name).stem) for name in names]
    first = split[0]
    for name, parts in zip(names, split, strict=True):
        if len(parts) == 1:
            raise SourceError(f"{folder}: no number in the name {name}", advice=_PATTERN_ADVICE)
        if parts[::2] != first[::2]:
            raise SourceError(
                f"{folder}: the names {names[0]} and {name} do not only differ in their numbers",
                advice=_PATTERN_ADVICE,
            )
    groups = [[int(parts[k]) for parts in split] for k in range(1, len(first), 2)]
    differing = [group for group in groups if len(set(group)) > 1]
    return differing[-1] if differing else groups[-1]
