"""Where a camera node's frames come from: a live camera, or a recording that is played at its own pace.

A feed delivers None from time to time when there is no frame, so that its reader is never held up for long.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

from nodes.camera.session_marks import SessionMark
from nodes.detector_settings import is_recording
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.cameras.open_source import SourceOptions, open_source
from nodes.devices.errors import SourceError
from nodes.frames import Frame, FrameSource, SourceCounts
from nodes.site.load import SIMULATED
from nodes.site.model import CameraSourceConfig
from nodes.site.passwords import with_passwords

IDLE_S = 0.05
EVERY = "?every"
# A stamp before the year 2000 is none of a clock: it counts from the recording's beginning.
EARLIEST_STAMP_NS = 946_684_800 * 10**9


class Feed(Protocol):
    """Frames for one camera's thread.

    Attributes:
        is_repeatable: whether a node that is started again can have the same frames again.
        is_played: whether frames come only after `begin`.
        n_plays: how often a recording was played; raised before its first frame.
        began_ns: when the session began, for its mark.
    """

    is_repeatable: bool
    is_played: bool
    n_plays: int
    began_ns: int

    @property
    def size_px(self) -> tuple[int, int]: ...

    @property
    def rate_hz(self) -> float: ...

    @property
    def counts(self) -> SourceCounts: ...

    def frames(self) -> Iterator[Frame | None]:
        """Frames as they come, until `close`.

        Raises:
            SourceError: the source failed for good.
        """
        ...

    def begin(self) -> None:
        """A session begins: a recording is played from its beginning."""
        ...

    def close(self) -> None:
        """Give the source back; for any thread."""
        ...


def open_feed(camera: CameraSourceConfig, mark: SessionMark | None) -> Feed:
    """Open the source of a camera.

    Args:
        camera: as configured.
        mark: of the session that is to be gone on with, None where there is none.

    Raises:
        SpotcalError: it cannot be opened.
    """
    if camera.source.startswith(SIMULATED):
        return _open_simulated(camera.source, mark)
    text = with_passwords(camera.source)
    if is_recording(text):
        return RecordingFeed(text, mark)
    size_px = None if camera.size is None else (camera.size[0], camera.size[1])
    return LiveFeed(open_source(text, SourceOptions(LiveOptions(size_px=size_px, rate_hz=camera.rate_hz))))


class LiveFeed:
    """A camera that runs by itself."""

    is_played, n_plays = False, 0

    def __init__(self, source: FrameSource, *, is_repeatable: bool = False) -> None:
        self._source, self.is_repeatable = source, is_repeatable
        self._is_closed = False
        self.began_ns = time.time_ns()

    @property
    def size_px(self) -> tuple[int, int]:
        return self._source.size_px

    @property
    def rate_hz(self) -> float:
        return self._source.rate_hz or 0.0

    @property
    def counts(self) -> SourceCounts:
        return self._source.counts

    def frames(self) -> Iterator[Frame | None]:
        yield from self._source
        if not self._is_closed:
            raise SourceError(f"{self._source.name}: the camera ended")

    def begin(self) -> None:
        self.began_ns = time.time_ns()

    def close(self) -> None:
        self._is_closed = True
        self._source.close()


class RecordingFeed:
    """A recording that is played from its beginning whenever a session begins.

    Stamps that are no wall time are moved: the first one to when it was begun.

    Args:
        text: of the source.
        mark: of the session that is to be gone on with.
        clock_ns: this machine's clock.

    Raises:
        SpotcalError: it cannot be opened.
    """

    is_repeatable = is_played = True

    def __init__(self, text: str, mark: SessionMark | None, *, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._text, self._clock_ns = text, clock_ns
        self._stop, self._due = threading.Event(), threading.Event()
        self.began_ns = 0 if mark is None else mark.began_ns
        self.n_plays = 0
        if mark is not None:
            self._due.set()
        with open_source(text) as source:
            self._size_px, self._rate_hz, self._counts = source.size_px, source.rate_hz or 0.0, source.counts

    @property
    def size_px(self) -> tuple[int, int]:
        return self._size_px

    @property
    def rate_hz(self) -> float:
        return self._rate_hz

    @property
    def counts(self) -> SourceCounts:
        return self._counts

    def begin(self) -> None:
        self.began_ns = self._clock_ns()
        self._due.set()

    def close(self) -> None:
        self._stop.set()

    def frames(self) -> Iterator[Frame | None]:
        while not self._stop.is_set():
            if not self._due.is_set():
                self._stop.wait(IDLE_S)
                yield None
                continue
            self._due.clear()
            self.n_plays += 1
            with open_source(self._text) as source:
                yield from self._played(source, self.began_ns)

    def _played(self, source: FrameSource, began_ns: int) -> Iterator[Frame | None]:
        """Frames, none before its time, until the end or another beginning."""
        first_ns = None
        for frame in source:
            first_ns = frame.stamp_ns if first_ns is None else first_ns
            shift_ns = began_ns - first_ns if first_ns < EARLIEST_STAMP_NS else 0
            while (wait_ns := began_ns + frame.stamp_ns - first_ns - self._clock_ns()) > 0:
                if self._stop.wait(min(1e-9 * wait_ns, IDLE_S)) or self._due.is_set():
                    return
                if wait_ns > 1e9 * IDLE_S:
                    yield None
            if self._stop.is_set() or self._due.is_set():
                return
            self._counts = source.counts
            yield replace(frame, stamp_ns=frame.stamp_ns + shift_ns)


def _open_simulated(text: str, mark: SessionMark | None) -> LiveFeed:
    """A camera of the smart room; where every frame counts, from the mark on, or from now on."""
    from nodes.simulated.smart_room import open_simulated

    if EVERY not in text:
        return LiveFeed(open_simulated(text))
    if mark is None:
        with open_simulated(text.replace(EVERY, "")) as live:
            first = next(iter(live)).sequence + 1
    else:
        first = mark.first_sequence
    return LiveFeed(open_simulated(f"{text}&first={first}"), is_repeatable=True)
