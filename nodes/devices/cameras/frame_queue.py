"""The queue between the thread that captures and the one that uses the frames: bounded, oldest dropped first."""

from __future__ import annotations

import threading
from collections import deque

from nodes.devices.errors import SourceError
from nodes.frames import Frame


class FrameQueue:
    """One thread puts, one gets."""

    def __init__(self, n_frames: int) -> None:
        self._frames: deque[Frame] = deque(maxlen=n_frames)
        self._changed = threading.Condition()
        self._is_over = False
        self._failure: SourceError | None = None

    def put(self, frame: Frame) -> bool:
        """Add a frame; whether another was dropped for it."""
        with self._changed:
            is_full = len(self._frames) == self._frames.maxlen
            self._frames.append(frame)
            self._changed.notify_all()
        return is_full

    def finish(self, failure: SourceError | None = None) -> None:
        """No more frames come: `get` gives those that wait, then raises `failure`, if there is one."""
        with self._changed:
            if not self._is_over:
                self._is_over, self._failure = True, failure
            self._changed.notify_all()

    def clear(self) -> None:
        """Throw the waiting frames away; nothing is raised any more."""
        with self._changed:
            self._frames.clear()
            self._is_over, self._failure = True, None
            self._changed.notify_all()

    def get(self, *, wait_s: float) -> Frame | None:
        """The oldest frame, when there is one; None at the end.

        Raises:
            SourceError: that of `finish`.
            TimeoutError: neither frame nor end came within so many seconds.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._frames or self._is_over, wait_s):
                raise TimeoutError
            if self._frames:
                return self._frames.popleft()
            if self._failure is not None:
                raise self._failure
            return None
