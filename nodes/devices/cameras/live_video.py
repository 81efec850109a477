"""A live camera as a source of frames: captured in a thread, reconnected when lost, counted, and never quietly dead."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

from network_calib.errors import InputError
from nodes.closing import Closing
from nodes.devices.cameras.capture_thread import CaptureThread, Surroundings
from nodes.devices.cameras.connection import Connection
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.redaction import redact, shown_address
from nodes.frames import Frame, FrameSource, SourceCounts

# Every wait of the capture thread ends by the connection's time-out; then it has only to close.
_CLOSING_S = 2.0


def open_live(address: str, options: LiveOptions | None = None) -> FrameSource:
    """Open a camera: `rtsp://...`, `rtsps://...`, or a V4L2 device such as `/dev/video0`.

    The address may hold a user name and a password; no message, name or log line of the source does.

    Raises:
        InputError: the address or an option cannot be used.
        SourceError: the camera cannot be reached, refuses, or sends what cannot be decoded.
    """
    options = options or LiveOptions()
    if re.match(r"(?i)rtsps?://", address):
        from nodes.devices.cameras.rtsp import RtspConnection

        shown = shown_address(address)
        return LiveVideo(shown, lambda: RtspConnection(address, shown, options), options)
    if address.startswith("/dev/"):
        from nodes.devices.cameras.v4l2 import V4l2Connection

        return LiveVideo(address, lambda: V4l2Connection(address, options), options)
    raise InputError(
        f"{redact(address)!r} is no live camera; expected rtsp://user:password@host:554/path or /dev/video0"
    )


class LiveVideo(Closing):
    """A live camera behind the seam of `nodes.frames.FrameSource`.

    Args:
        name: for messages; without password.
        connect: makes a connection; the first is made at once, so that what is wrong from the start is raised here.
        options: how to keep it.
        around: clock and chance; None for this machine's.

    Raises:
        SourceError: of `connect`.
    """

    def __init__(
        self,
        name: str,
        connect: Callable[[], Connection],
        options: LiveOptions,
        around: Surroundings | None = None,
    ) -> None:
        self._name, self._options, self._around = name, options, around or Surroundings()
        self._delivered = 0
        self._capture = CaptureThread(name, connect, options, self._around)

    @property
    def name(self) -> str:
        return self._name

    @property
    def size_px(self) -> tuple[int, int]:
        return self._capture.size_px

    @property
    def rate_hz(self) -> float | None:
        return self._capture.rate_hz

    @property
    def counts(self) -> SourceCounts:
        capture = self._capture
        return SourceCounts(self._delivered, capture.n_dropped, capture.n_late, capture.n_reconnects)

    @property
    def n_clock_steps(self) -> int:
        """How often the clock of the stamps was seen to jump."""
        return self._capture.n_clock_steps

    @property
    def silent_s(self) -> float:
        """Since the last picture was captured, or the source opened."""
        return self._around.now_s() - self._capture.last_shot_s

    def __iter__(self) -> Iterator[Frame]:
        while (frame := self._capture.next_frame()) is not None:
            self._delivered += 1
            yield frame

    def close(self) -> None:
        """Give the camera back; takes up to the time-out when the camera stalls."""
        self._capture.stop(wait_s=self._options.timeout_s + _CLOSING_S)

    def __repr__(self) -> str:
        return f"LiveVideo({self._name!r}, {self.counts})"
