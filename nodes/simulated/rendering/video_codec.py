"""Frames as pictures of a video encoder."""

from __future__ import annotations

from enum import StrEnum
from fractions import Fraction
from typing import TYPE_CHECKING

from network_calib.errors import InputError
from nodes.frames import Frame, PixelFormat

if TYPE_CHECKING:
    import av

_FFV1_GRAY = {8: "gray", 10: "gray10le", 12: "gray12le", 16: "gray16le"}


class VideoCodec(StrEnum):
    """How a video is compressed."""

    H264 = "h264"
    H265 = "h265"
    FFV1 = "ffv1"

    @property
    def encoder(self) -> str:
        """FFmpeg's name of the encoder."""
        return {VideoCodec.H264: "libx264", VideoCodec.H265: "libx265", VideoCodec.FFV1: "ffv1"}[self]

    @property
    def decoder(self) -> str:
        """FFmpeg's name of the decoder."""
        return "hevc" if self is VideoCodec.H265 else self.value

    @property
    def is_lossless(self) -> bool:
        return self is VideoCodec.FFV1

    def options(self, *, is_live: bool) -> dict[str, str]:
        """Of the encoder; live: every picture comes out before the next goes in, as surveillance cameras do it."""
        if self.is_lossless:
            return {}
        quiet = {"x265-params": "log-level=error"} if self is VideoCodec.H265 else {}
        return {"preset": "veryfast", "tune": "zerolatency", **quiet} if is_live else {"preset": "veryfast", **quiet}

    def coded_format(self, pixel_format: PixelFormat, bits: int, size_px: tuple[int, int]) -> str:
        """FFmpeg's pixel format inside the video.

        Raises:
            InputError: frames that this codec cannot hold.
        """
        if self is VideoCodec.FFV1:
            if pixel_format is PixelFormat.BGR and bits > 8:
                raise InputError(f"ffv1 with {bits}-bit colours is not written, expected 8 bits, or mono")
            return "bgr0" if pixel_format is PixelFormat.BGR else _FFV1_GRAY[bits]
        if bits > 8 or pixel_format not in (PixelFormat.MONO, PixelFormat.BGR):
            raise InputError(
                f"{self.value} cannot hold {pixel_format.value} with {bits} bits, expected mono or bgr with 8",
                advice="Write ffv1 or images.",
            )
        if size_px[0] % 2 or size_px[1] % 2:
            raise InputError(f"{self.value} halves the colours' resolution: {size_px} must be even")
        return "yuv420p"


def rate_fraction(rate_hz: float) -> Fraction:
    """A frame rate as encoders want it: 25, 30000/1001."""
    return Fraction(rate_hz).limit_denominator(1001)


def picture_of(frame: Frame, coded_format: str, *, number: int, rate: Fraction) -> av.VideoFrame:
    """The frame as the encoder's picture; colours become BT.601 in limited range, gray its luma."""
    import av
    from av.video.reformatter import ColorRange, Colorspace

    given = "bgr24" if frame.pixel_format is PixelFormat.BGR else _FFV1_GRAY[frame.bits]
    picture = av.VideoFrame.from_ndarray(frame.image, format=given)
    if coded_format == "yuv420p":
        picture = picture.reformat(
            format=coded_format,
            src_color_range=ColorRange.JPEG,
            dst_color_range=ColorRange.MPEG,
            dst_colorspace=Colorspace.ITU601,
        )
    elif coded_format != given:
        picture = picture.reformat(format=coded_format)
    picture.pts, picture.time_base = number, 1 / rate
    return picture
