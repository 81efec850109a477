"""The seam between a way of capturing (RTSP, V4L2) and the thread that keeps it going (`live_video.py`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from nodes.devices.errors import SourceError
from nodes.frames import FrameSettings, StampOrigin

if TYPE_CHECKING:
    from nodes.devices.cameras.video_pixels import Pixels


class ConnectionLostError(SourceError):
    """A failure that a new attempt may cure: the camera is switched off, stalls, or its network is down."""


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture with its stamp, as a connection delivers it.

    Attributes:
        stamp_ns: instant of capture on the clock that `origin` names, ns since the epoch.
        origin: which clock.
        pixels: the picture.
        n_lost: frames lost since the shot before it, or since the connection was made.
        settings: of the camera, as read back.
    """

    stamp_ns: int
    origin: StampOrigin
    pixels: Pixels
    n_lost: int = 0
    settings: FrameSettings = field(default_factory=FrameSettings)


class Connection(Protocol):
    """A camera that was reached, until it is lost."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        ...

    @property
    def rate_hz(self) -> float | None:
        """Nominal frames a second, where the camera tells."""
        ...

    @property
    def n_clock_steps(self) -> int:
        """How often the clock of the stamps has jumped since the connection was made."""
        ...

    def shots(self) -> Iterator[Shot | None]:
        """Until the camera is lost; None in between, so that the thread can be stopped.

        Raises:
            ConnectionLostError: no data for too long, or the camera ended the stream.
            SourceError: what comes cannot be used.
        """
        ...

    def close(self) -> None:
        """Give the camera back; only the thread that iterates calls it."""
        ...
