"""Events a second, over the last few seconds."""

from __future__ import annotations

from collections import deque

WINDOW_S = 3.0


class MeasuredRate:
    """Counts what comes; memory is that of the window."""

    def __init__(self) -> None:
        self._times_s: deque[float] = deque()

    def note(self, now_s: float) -> None:
        """One came."""
        self._times_s.append(now_s)
        self._forget(now_s)

    def rate_hz(self, now_s: float) -> float:
        """Over the window, or what has passed of it since the first."""
        self._forget(now_s)
        if len(self._times_s) < 2:
            return 0.0
        return (len(self._times_s) - 1) / max(now_s - self._times_s[0], 1e-3)

    def _forget(self, now_s: float) -> None:
        while self._times_s and self._times_s[0] < now_s - WINDOW_S:
            self._times_s.popleft()
