"""The one door to all frame sources: what is given decides what is opened."""

from __future__ import annotations

import glob
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from network_calib.errors import InputError
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.errors import SourceError
from nodes.devices.redaction import redact
from nodes.frames import FrameSource

if TYPE_CHECKING:
    from nodes.devices.cameras.image_folder import ImageOptions
    from nodes.devices.cameras.video_open import VideoOptions

_EXPECTED = (
    "Expected rtsp://user:password@host:554/path, /dev/video0 or usb:0, a video file, a folder of images, "
    "or a folder with a pattern such as images/cam1_*.png."
)
_LIVE_SCHEMES = ("rtsp", "rtsps")


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """Options for each kind of source; only those of the kind that is opened are used.

    Attributes:
        live: RTSP and V4L2.
        video: video files; None: as they are by default.
        images: folders of images; None: as they are by default.
    """

    live: LiveOptions = field(default_factory=LiveOptions)
    video: VideoOptions | None = None
    images: ImageOptions | None = None


def open_source(given: str | Path, options: SourceOptions | None = None) -> FrameSource:
    """Open a camera or a recording.

    | given                                          | source                                      |
    |------------------------------------------------|---------------------------------------------|
    | `rtsp://`, `rtsps://`                          | live stream                                 |
    | `/dev/video0`, `usb:0`                         | V4L2 device                                 |
    | a folder                                       | its images                                  |
    | a folder and a pattern, `images/cam1_*.png`    | those images of it                          |
    | one image file                                 | that image                                  |
    | any other file, or `file:` and its path        | video                                       |

    Raises:
        InputError: it is nothing of these.
        SourceError: it cannot be opened.
    """
    options = options or SourceOptions()
    text = str(given).strip()
    if not text:
        raise InputError("no source is given", advice=_EXPECTED)
    device = re.fullmatch(r"usb:(\d+)", text)
    if device is not None or re.match(r"/dev/", text):
        return _open_live(f"/dev/video{device[1]}" if device else text, options)
    scheme = re.match(r"([A-Za-z][A-Za-z0-9+.-]*)://", text)
    if scheme is not None and scheme[1].lower() in _LIVE_SCHEMES:
        return _open_live(text, options)
    if scheme is not None and scheme[1].lower() != "file":
        raise InputError(f"{redact(text)}: no source for {scheme[1]}://", advice=_EXPECTED)
    return _open_recording(Path(re.sub(r"(?i)^file:(//)?", "", text)).expanduser(), options)


def _open_live(address: str, options: SourceOptions) -> FrameSource:
    from nodes.devices.cameras.live_video import open_live

    return open_live(address, options.live)


def _open_recording(path: Path, options: SourceOptions) -> FrameSource:
    from nodes.devices.cameras.image_names import SUFFIXES

    try:
        is_folder, is_there = path.is_dir(), path.exists()
    except OSError as error:
        raise SourceError(
            f"{path} cannot be read: {error.strerror}", advice="Give this user the right to enter its folders."
        ) from None
    if is_folder:
        return _open_images(path, None, options)
    if is_there and path.suffix.lower() in SUFFIXES:
        return _open_images(path.parent, glob.escape(path.name), options)
    if is_there:
        from nodes.devices.cameras.video_file import VideoFile

        return VideoFile(path, options.video)
    if glob.has_magic(str(path)):
        return _open_pattern(path, options)
    raise InputError(f"{path} does not exist", advice=_EXPECTED)


def _open_pattern(path: Path, options: SourceOptions) -> FrameSource:
    if glob.has_magic(str(path.parent)):
        raise InputError(
            f"{path}: the pattern stands in the folder's name, expected it in the names of the images",
            advice="Give one folder for each camera.",
        )
    return _open_images(path.parent, path.name, options)


def _open_images(folder: Path, pattern: str | None, options: SourceOptions) -> FrameSource:
    from nodes.devices.cameras.image_folder import ImageFolder

    return ImageFolder(folder, options.images, pattern=pattern)
