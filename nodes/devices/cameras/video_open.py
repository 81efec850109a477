"""Opening a video file: every way in which it can fail says what is wrong and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import av
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.stream import VideoStream

from nodes.devices.errors import SourceError

# Formats that are no recording: playlists that name other files or addresses, text drawn as pictures, generators.
_REFUSED_FORMATS = {"applehttp", "concat", "dash", "hls", "imf", "lavfi", "tty", "webm_dash_manifest"}
BROKEN_OFF_ADVICE = "record again, to MKV or MPEG-TS, which can be read up to where they end."


@dataclass(frozen=True, slots=True)
class VideoOptions:
    """How a video file is read.

    Attributes:
        stamp_table: CSV with the instants of capture; None: `name.stamps.csv` or `name.csv` beside the file, if any.
        track: which of the file's video tracks, from 0.
        keep_damaged: deliver damaged frames as well, and those built on lost ones, with whatever the decoder invents.
    """

    stamp_table: Path | None = None
    track: int = 0
    keep_damaged: bool = False


@dataclass(frozen=True, slots=True)
class OpenVideo:
    """An open file and the one stream that is read from it.

    Attributes:
        container: the file.
        stream: its video.
        is_strict: its decoder refuses pictures in which it finds a fault.
        is_timed: its packets carry presentation times as far as they have any. AVI has none: with frames that are coded
            out of order, those that FFmpeg makes up are wrong.
    """

    container: InputContainer
    stream: VideoStream
    is_timed: bool
    is_strict: bool


@contextmanager
def open_video(path: Path, options: VideoOptions, *, is_strict: bool) -> Iterator[OpenVideo]:
    """Open a video file for one pass.

    Args:
        path: of the file.
        options: which track.
        is_strict: pictures in which the decoder finds a fault are refused, not patched up.

    Raises:
        SourceError: missing, unreadable, empty, no video, or of a codec that is not known.
    """
    check_readable(path)
    try:
        # Without `file:` a name with a colon would be an address. A file may then name files only, no addresses.
        container = av.open(f"file:{path}")
    except FFmpegError as error:
        raise _not_a_video(path, error) from None
    with container:
        stream = _stream(path, container, options.track)
        # Threads that decode several frames at once report damage late, and lose the frames that wait behind it.
        stream.thread_type = "SLICE"
        if is_strict:
            stream.codec_context.options = {**stream.codec_context.options, "err_detect": "explode"}
        is_timed = container.format.name != "avi" or not stream.codec_context.has_b_frames
        yield OpenVideo(container, stream, is_timed, is_strict)


def check_readable(path: Path) -> None:
    """Refuse what is no readable file with content, before a decoder sees it.

    Raises:
        SourceError: says which.
    """
    try:
        if not path.is_file():
            what = "is not a file" if path.exists() else "does not exist"
            raise SourceError(f"{path} {what}, expected a recording", advice="Check the path for a typing error.")
        with path.open("rb") as file:
            is_empty = not file.read(1)
    except OSError as error:
        raise SourceError(
            f"{path} cannot be read: {error.strerror}",
            advice=f"Give this user the right to read it and to enter its folders: chmod a+r '{path.name}', "
            "chmod a+rx for the folders.",
        ) from None
    if is_empty:
        raise SourceError(f"{path} is empty (0 bytes)", advice="The recorder wrote nothing: record again.")


def _stream(path: Path, container: InputContainer, track: int) -> VideoStream:
    if set(container.format.name.split(",")) & _REFUSED_FORMATS:
        raise SourceError(
            f"{path} is no video but {container.format.long_name}",
            advice="Give the video file itself; for a stream give its address.",
        )
    videos = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not videos:
        others = ", ".join(sorted({stream.type for stream in container.streams})) or "nothing"
        raise SourceError(f"{path} holds no video ({others})", advice="Give a recording of a camera.")
    if not 0 <= track < len(videos):
        raise SourceError(f"{path}: track {track} of {len(videos)} video tracks, expected 0..{len(videos) - 1}")
    stream = videos[track]
    if cast("object", stream.codec_context) is None:
        raise SourceError(
            f"{path}: the codec of its video is not known", advice="Convert it, for example to H.264 in MKV."
        )
    return stream


def _not_a_video(path: Path, error: FFmpegError) -> SourceError:
    with path.open("rb") as file:
        is_mp4 = file.read(12)[4:8] == b"ftyp"
    if is_mp4:
        return SourceError(
            f"{path} is an MP4 file without its index: the recording was broken off, and no frame of it can be found",
            advice=BROKEN_OFF_ADVICE,
        )
    return SourceError(
        f"{path} is no video that can be read: {error.strerror}",
        advice="Check that it plays; give a video file (MP4, MKV, AVI, MPEG-TS, ...) or a folder of images.",
    )
