"""Rendered cameras as frame sources: as fast as they are asked, or at the pace of a live camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from nodes.closing import Closing
from nodes.devices.cameras.tally import FrameTally
from nodes.devices.errors import SourceError
from nodes.frames import Frame, SourceCounts
from nodes.simulated.rendering.rendered_camera import RenderedCamera


class RenderedSource(Closing):
    """The frames of one rendered camera.

    Without a clock it is a recording: every iteration starts at the first frame. With one it is live: a frame comes
    half an exposure after its middle, counted from the moment of opening; frames that a slow reader or renderer missed
    are dropped, leave a gap in `sequence` and are counted; a further iteration goes on where the world has got to. Both
    end after the last frame of the path.

    Args:
        camera: what is looked at.
        first: first frame.
        n_frames: how many at most; None: to the end of the path.
        clock_s: a clock that never goes back, such as `time.monotonic`; None: no pacing.
        sleep: waits for so many seconds on that clock.
    """

    def __init__(
        self,
        camera: RenderedCamera,
        *,
        first: int = 0,
        n_frames: int | None = None,
        clock_s: Callable[[], float] | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.camera = camera
        self._first = first
        self._end = camera.n_frames if n_frames is None else min(camera.n_frames, first + n_frames)
        self._clock_s, self._sleep = clock_s, sleep
        self._start_s = clock_s() if clock_s is not None else 0.0
        self._next = first
        self._is_closed = False
        self._tally = FrameTally(camera.rate_hz)

    @property
    def is_recording(self) -> bool:
        """Iterating anew starts anew."""
        return self._clock_s is None

    @property
    def name(self) -> str:
        return self.camera.name

    @property
    def size_px(self) -> tuple[int, int]:
        return self.camera.size_px

    @property
    def rate_hz(self) -> float | None:
        return self.camera.rate_hz

    @property
    def counts(self) -> SourceCounts:
        """Of the latest iteration of a recording; of a live source since it was opened."""
        return self._tally.counts

    def __iter__(self) -> Iterator[Frame]:
        if self._is_closed:
            raise SourceError(f"{self.name} is closed")
        if self._clock_s is None:
            self._tally, self._next = FrameTally(self.rate_hz), self._first
        while not self._is_closed:
            sequence = self._next if self._clock_s is None else self._wait(self._clock_s)
            if self._is_closed or sequence >= self._end:
                return
            self._tally.drop(sequence - self._next)
            self._next = sequence + 1
            frame, _ = self.camera.render(sequence)
            self._tally.deliver(frame.stamp_ns)
            yield frame

    def _wait(self, clock_s: Callable[[], float]) -> int:
        """Wait for the end of the next exposure; the number of the newest frame that is then complete."""
        rate_hz, delay_s = self.camera.rate_hz, self.camera.sensor.exposure_s / 2
        due_s = self._start_s + (self._next - self._first) / rate_hz + delay_s
        if (left_s := due_s - clock_s()) > 0:
            self._sleep(left_s)
            return self._next
        return self._next + int((clock_s() - due_s) * rate_hz)

    def close(self) -> None:
        """End every iteration at its next frame."""
        self._is_closed = True
