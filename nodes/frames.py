"""A frame: an image with the instant of its capture. The one thing that all camera sources deliver."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from types import TracebackType
from typing import Protocol, Self

import numpy as np
import numpy.typing as npt

ImageArray = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


class PixelFormat(StrEnum):
    """What an image array holds.

    `YUV420` is planar, as decoders deliver it: (3 height / 2, width), luma above, then both chroma planes; limited
    range (16..235) unless the frame says otherwise. Reading luma or one channel from it needs no whole conversion.
    """

    MONO = "mono"
    BGR = "bgr"
    YUV420 = "yuv420"
    BAYER_RGGB = "bayer_rggb"
    BAYER_GRBG = "bayer_grbg"
    BAYER_GBRG = "bayer_gbrg"
    BAYER_BGGR = "bayer_bggr"


class StampOrigin(StrEnum):
    """Where a frame's stamp comes from, best first."""

    CAMERA = "camera"  # the camera's wall clock, carried with the stream
    DRIVER = "driver"  # the kernel's stamp of the buffer, turned into this machine's wall clock
    TABLE = "table"  # a table beside the images
    FILE = "file"  # the presentation time of a video file: right up to an unknown offset
    ARRIVAL = "arrival"  # this machine's wall clock when the frame came: late by an unknown, varying time
    ORDER = "order"  # none: frame number times an assumed period


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """The camera's settings at capture, as read back; None where it does not tell.

    Attributes:
        exposure_s: exposure time.
        gain_db: analogue and digital gain together.
    """

    exposure_s: float | None = None
    gain_db: float | None = None


@dataclass(frozen=True, slots=True)
class Frame:
    """One captured image.

    Attributes:
        sequence: number of the frame as the source counts, from 0; a gap means frames that were lost.
        stamp_ns: instant of capture (mid-exposure where exposure is known), ns since the epoch of its clock.
        origin: which clock that is.
        image: (h, w) for MONO and Bayer, (h, w, 3) for BGR, (3 h / 2, w) for YUV420; uint8 or uint16. Not to be
            written to: a source may deliver the same memory again after the next frame was asked for.
        pixel_format: what `image` holds.
        bits: significant bits of a sample: 8 for uint8; 10, 12 or 16 for uint16 (values from 0 to 2**bits - 1).
        is_full_range: for YUV420: luma spans 0..255.
        settings: as read back from the camera.
    """

    sequence: int
    stamp_ns: int
    origin: StampOrigin
    image: ImageArray
    pixel_format: PixelFormat
    bits: int = 8
    is_full_range: bool = False
    settings: FrameSettings = field(default_factory=FrameSettings)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture."""
        height, width = self.image.shape[:2]
        return width, (height * 2 // 3 if self.pixel_format is PixelFormat.YUV420 else height)


@dataclass(frozen=True, slots=True)
class SourceCounts:
    """What a source has seen since it was opened.

    Attributes:
        delivered: frames handed out.
        dropped: frames that the source knows it lost: gaps of the sequence, queue overflows, undecodable frames.
        late: frames that came more than two periods after their predecessor.
        reconnects: how often the connection was made anew.
    """

    delivered: int = 0
    dropped: int = 0
    late: int = 0
    reconnects: int = 0


class FrameSource(Protocol):
    """A camera, a file, a folder of images, a simulated camera: each opened whole or not at all, and owned by `with`.

    Iterating delivers frames until the end of a recording; a live source goes on until `close`. A capture that fails
    for good raises `nodes.devices.errors.SourceError` out of the iteration: a dead source never looks like a quiet one.
    """

    @property
    def name(self) -> str:
        """For messages and tables; never holds a password."""
        ...

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        ...

    @property
    def rate_hz(self) -> float | None:
        """Nominal frames a second, where the source knows."""
        ...

    @property
    def counts(self) -> SourceCounts:
        """So far."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...

    def close(self) -> None:
        """Give the device back; further calls do nothing."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
