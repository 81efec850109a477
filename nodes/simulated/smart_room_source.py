"""A rendered camera of the smart room as a frame source that keeps the wall clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from nodes.closing import Closing
from nodes.devices.cameras.tally import FrameTally
from nodes.devices.errors import SourceError
from nodes.frames import Frame, SourceCounts
from nodes.simulated.rendering.rendered_camera import RenderedCamera

# `close` is heeded after so long at most.
LONGEST_SLEEP_S = 0.1


class SmartRoomSource(Closing):
    """Frames on the world's common grid: frame k is exposed at start_s + k / rate, and comes half an exposure later.

    Args:
        camera: what is looked at.
        refresh: called before each frame, so that the world's events are known.
        start_s: time of frame 0.
        first: deliver every frame from this number on, though late; None: live, late frames are dropped and counted.
        clock_s: the wall clock.
        sleep: waits for so many seconds.
    """

    def __init__(
        self,
        camera: RenderedCamera,
        refresh: Callable[[], None],
        *,
        start_s: float,
        first: int | None,
        clock_s: Callable[[], float],
        sleep: Callable[[float], None],
    ) -> None:
        self._camera, self._refresh, self._start_s = camera, refresh, start_s
        self._clock_s, self._sleep = clock_s, sleep
        self._is_live = first is None
        self._next = self._newest() + 1 if first is None else first
        self._tally = FrameTally(camera.rate_hz)
        self._is_closed = False

    @property
    def name(self) -> str:
        return self._camera.name

    @property
    def size_px(self) -> tuple[int, int]:
        return self._camera.size_px

    @property
    def rate_hz(self) -> float | None:
        return self._camera.rate_hz

    @property
    def counts(self) -> SourceCounts:
        return self._tally.counts

    def __iter__(self) -> Iterator[Frame]:
        if self._is_closed:
            raise SourceError(f"{self.name} is closed")
        while self._wait():
            sequence = max(self._next, self._newest()) if self._is_live else self._next
            self._tally.drop(sequence - self._next)
            self._next = sequence + 1
            self._refresh()
            frame, _ = self._camera.render(sequence)
            self._tally.deliver(frame.stamp_ns)
            yield frame

    def close(self) -> None:
        """End every iteration at its next frame."""
        self._is_closed = True

    def _wait(self) -> bool:
        """Wait for the next frame; False when the source was closed."""
        due_s = self._start_s + self._camera.sensor.exposure_s / 2 + self._next / self._camera.rate_hz
        while not self._is_closed and (left_s := due_s - self._clock_s()) > 0:
            self._sleep(min(left_s, LONGEST_SLEEP_S))
        return not self._is_closed

    def _newest(self) -> int:
        """Number of the newest frame whose exposure is over; never below -1."""
        since_s = self._clock_s() - self._start_s - self._camera.sensor.exposure_s / 2
        return max(math.floor(since_s * self._camera.rate_hz), -1)
