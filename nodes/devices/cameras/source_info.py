"""What can be said of a source before its first frame is asked for."""

from __future__ import annotations

from dataclasses import dataclass

from nodes.frames import FrameSource, PixelFormat, StampOrigin


@dataclass(frozen=True, slots=True)
class SourceInfo:
    """One row of a list of cameras; None where it is not known.

    Attributes:
        name: for messages and tables; never holds a password.
        kind: `video`, `images`, `stereo` or `live`.
        size_px: width and height.
        rate_hz: nominal frames a second.
        duration_s: of a recording.
        n_frames: of a recording, as its index says.
        container: format of the file.
        codec: how the pictures are compressed.
        coded_format: pixel format inside the codec, in FFmpeg's words.
        pixel_format: what frames hold.
        bits: significant bits of a sample.
        stamp_origin: where stamps come from.
        created_ns: when the file says that it was recorded, ns since the Unix epoch. Not used for the stamps:
            recorders write the beginning, the end, or local time here.
        notes: what the user should know, one sentence each.
    """

    name: str
    kind: str
    size_px: tuple[int, int]
    rate_hz: float | None = None
    duration_s: float | None = None
    n_frames: int | None = None
    container: str | None = None
    codec: str | None = None
    coded_format: str | None = None
    pixel_format: PixelFormat | None = None
    bits: int | None = None
    stamp_origin: StampOrigin | None = None
    created_ns: int | None = None
    notes: tuple[str, ...] = ()


def describe(source: FrameSource) -> SourceInfo:
    """What is known of any source: its own `info` where it has one, else what every source tells."""
    info = getattr(source, "info", None)
    if isinstance(info, SourceInfo):
        return info
    return SourceInfo(name=source.name, kind="live", size_px=source.size_px, rate_hz=source.rate_hz)
