"""What a video file is: found out once, when it is opened, by decoding its first picture."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
from av.container import InputContainer
from av.video.stream import VideoStream

from nodes.devices.cameras.source_info import SourceInfo
from nodes.devices.cameras.video_cut import is_cut
from nodes.devices.cameras.video_decode import PicturePass, picture_time
from nodes.devices.cameras.video_open import BROKEN_OFF_ADVICE, OpenVideo, VideoOptions, open_video
from nodes.devices.cameras.video_pixels import pixels_of
from nodes.devices.errors import SourceError
from nodes.frames import StampOrigin

_ASSUMED_RATE_HZ = Fraction(25)
# At least one of so many packets must decode, or the file is refused: ten seconds, longer than the way to a key frame.
_N_TRIED = 300


def ns_from_pts(pts: int, time_base: Fraction) -> int:
    """Presentation time in ns, to the nearest (ties to even) in exact arithmetic."""
    return round(pts * time_base * 10**9)


@dataclass(frozen=True, slots=True)
class VideoProbe:
    """What opening found out."""

    info: SourceInfo
    rate: Fraction
    time_base: Fraction
    is_strict: bool
    is_cut: bool
    n_index: int
    end_ns: int | None


def probe_video(path: Path, options: VideoOptions) -> VideoProbe:
    """Find the first whole picture. A decoder that refuses every picture as faulty gets a second, lenient try."""
    n_packets = 0
    for is_strict in (False,) if options.keep_damaged else (True, False):
        with open_video(path, options, is_strict=is_strict) as opened:
            pictures = PicturePass(opened, keep_damaged=options.keep_damaged, max_packets=_N_TRIED)
            _, first = next(iter(pictures), (0, None))
            if first is not None:
                return _described(path, opened, first, is_strict=is_strict)
            n_packets = max(n_packets, pictures.n_packets)
    if n_packets:
        raise SourceError(
            f"{path}: none of its first {n_packets} frames can be decoded", advice="Check that the file plays."
        )
    what = "is cut before its first frame" if is_cut(path) else "holds no frames"
    raise SourceError(f"{path} {what}", advice="The recording was broken off, or the copy of it: " + BROKEN_OFF_ADVICE)


def _described(path: Path, opened: OpenVideo, first: av.VideoFrame, *, is_strict: bool) -> VideoProbe:
    container, stream = opened.container, opened.stream
    time_base = stream.time_base or Fraction(1, 1000)
    told_rate = stream.average_rate or stream.guessed_rate
    rate = Fraction(told_rate) if told_rate else _ASSUMED_RATE_HZ
    origin = StampOrigin.FILE if opened.is_timed and picture_time(first) is not None else StampOrigin.ORDER
    pixels = pixels_of(first)
    end_ns = _end_ns(container, stream, time_base)
    info = SourceInfo(
        name=path.name,
        kind="video",
        size_px=(first.width, first.height),
        rate_hz=float(rate) if told_rate else None,
        duration_s=None if end_ns is None else (end_ns - ns_from_pts(stream.start_time or 0, time_base)) / 1e9,
        n_frames=stream.frames or None,
        container=container.format.name,
        codec=stream.codec_context.codec.canonical_name,
        coded_format=first.format.name,
        pixel_format=pixels.pixel_format,
        bits=pixels.bits,
        stamp_origin=origin,
        created_ns=_created_ns(container.metadata.get("creation_time", "")),
        notes=_notes(path, opened, first, is_lenient=not is_strict, is_timed=origin is StampOrigin.FILE),
    )
    return VideoProbe(info, rate, time_base, is_strict, is_cut(path), stream.frames, end_ns)


def _notes(path: Path, opened: OpenVideo, first: av.VideoFrame, *, is_lenient: bool, is_timed: bool) -> tuple[str, ...]:
    n_tracks = len(opened.container.streams.video)
    found = (
        (n_tracks > 1, f"has {n_tracks} video tracks, of which one is read"),
        (is_lenient, "is decoded leniently: damaged frames may be among the delivered ones"),
        (not is_timed, "has no times: stamps are frame number over rate"),
        (
            first.rotation != 0,
            f"asks to be turned by {first.rotation}°; frames are delivered as stored",
        ),
        (
            first.interlaced_frame,
            "is interlaced: odd and even lines were taken at two instants; record progressive",
        ),
    )
    return tuple(f"{path.name} {note}" for is_so, note in found if is_so)


def _end_ns(container: InputContainer, stream: VideoStream, time_base: Fraction) -> int | None:
    """Where the header says that the video ends; that of the whole file only where it has no other stream."""
    start_ns = ns_from_pts(stream.start_time or 0, time_base)
    if stream.duration:
        return start_ns + ns_from_pts(stream.duration, time_base)
    if container.duration and len(container.streams) == 1:
        return start_ns + container.duration * 1000  # in microseconds
    return None


def _created_ns(text: str) -> int | None:
    try:
        created = datetime.fromisoformat(text)
    except ValueError:
        return None
    if created.tzinfo is None or created.year <= 1970:  # not a date but what an unset clock writes
        return None
    since = created - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000
