"""A scripted camera behind the seam of `nodes.devices.cameras.connection`."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from nodes.devices.cameras.connection import ConnectionLostError, Shot
from nodes.devices.cameras.video_pixels import Pixels
from nodes.frames import PixelFormat, StampOrigin

SIZE_PX = (8, 6)


def shot(stamp_ns: int, *, n_lost: int = 0, size_px: tuple[int, int] = SIZE_PX) -> Shot:
    """A grey picture whose samples are the low byte of its stamp."""
    image = np.full(size_px[::-1], stamp_ns % 256, np.uint8)
    return Shot(stamp_ns, StampOrigin.CAMERA, Pixels(image, PixelFormat.MONO), n_lost)


@dataclass
class FakeConnection:
    """Plays a list: shots, None, functions to call, and errors to raise; then waits to be released, or is lost."""

    script: Sequence[Shot | Callable[[], object] | BaseException | None]
    hold: threading.Event | None = None
    rate_hz: float | None = 25.0
    size_px: tuple[int, int] = SIZE_PX
    n_clock_steps: int = 0
    is_closed: bool = field(default=False, init=False)

    def shots(self) -> Iterator[Shot | None]:
        for item in self.script:
            if isinstance(item, BaseException):
                raise item
            if callable(item):
                item()
            else:
                yield item
        while self.hold is not None and not self.hold.wait(0.01):
            yield None
        raise ConnectionLostError("fake: lost")

    def close(self) -> None:
        self.is_closed = True


@dataclass
class Connections:
    """`connect` of a source: gives the connections in turn; raises those that are errors; then never answers."""

    given: list[FakeConnection | BaseException]
    n_asked: int = 0

    def __call__(self) -> FakeConnection:
        self.n_asked += 1
        if not self.given:
            raise ConnectionLostError("fake: no answer")
        connection = self.given.pop(0)
        if isinstance(connection, BaseException):
            raise connection
        return connection
