"""From the shots of a camera's connections to numbered frames whose stamps rise."""

from __future__ import annotations

from nodes.devices.cameras.connection import Shot
from nodes.devices.errors import SourceError
from nodes.frames import Frame

# A clock set back by less is waited out, so that no two frames of a source have the same stamp; by more, waiting would
# look like a camera that is away.
_MAX_BACK_NS = 5 * 10**9


class FrameMaker:
    """Numbers the shots of all connections of one source.

    The source begins with its first frame: what is lost before it is no loss. From then on each lost frame leaves a gap
    in the sequence, and is counted.

    Args:
        name: of the source, for messages.
        size_px: width and height that every picture must have: a calibration holds for one.
    """

    def __init__(self, name: str, size_px: tuple[int, int]) -> None:
        self._name, self._size_px = name, size_px
        self._next_sequence = 0
        self._last_stamp_ns: int | None = None
        self.n_lost = 0

    def frame_of(self, shot: Shot) -> Frame | None:
        """The shot as the next frame; None where its stamp does not follow that of the frame before.

        Raises:
            SourceError: the picture has another size, or the clock was set back by seconds.
        """
        if self._last_stamp_ns is not None:
            self._lose(shot.n_lost)
        if not self._follows(shot.stamp_ns):
            self._lose(1)
            return None
        pixels = shot.pixels
        frame = Frame(
            sequence=self._next_sequence,
            stamp_ns=shot.stamp_ns,
            origin=shot.origin,
            image=pixels.image,
            pixel_format=pixels.pixel_format,
            bits=pixels.bits,
            is_full_range=pixels.is_full_range,
            settings=shot.settings,
        )
        self._check_size(frame.size_px)
        self._last_stamp_ns = shot.stamp_ns
        self._next_sequence += 1
        return frame

    def _lose(self, n_frames: int) -> None:
        self.n_lost += n_frames
        self._next_sequence += n_frames

    def _follows(self, stamp_ns: int) -> bool:
        if self._last_stamp_ns is None:
            return True
        back_ns = self._last_stamp_ns - stamp_ns
        if back_ns > _MAX_BACK_NS:
            raise SourceError(
                f"{self._name}: the clock of its frames was set back by {back_ns / 1e9:.1f} s",
                advice="Start again; let the camera and this machine take their time from one NTP server.",
            )
        return back_ns < 0

    def _check_size(self, size_px: tuple[int, int]) -> None:
        if size_px != self._size_px:
            was, now = ("x".join(map(str, size)) for size in (self._size_px, size_px))
            raise SourceError(
                f"{self._name}: the pictures' size changed from {was} to {now}",
                advice="A calibration holds for one size: set the camera to it, or open the source again.",
            )
