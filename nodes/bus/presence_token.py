"""A node's sign of life: it stands while data flows, and only then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import zenoh

# Without data for so long a node counts as gone, though its process lives.
SILENCE_S = 5.0


class PresenceToken:
    """A liveliness token that follows beats; the bus thread calls `follow`."""

    def __init__(self, key: str, *, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._key, self._clock_s = key, clock_s
        self._last_beat_s: float | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._lock = threading.Lock()

    @property
    def is_due(self) -> bool:
        """Whether data flows, as far as the beats tell."""
        last = self._last_beat_s
        return last is not None and self._clock_s() - last < SILENCE_S

    @property
    def is_shown(self) -> bool:
        return self._token is not None

    def beat(self) -> None:
        """Data flows."""
        self._last_beat_s = self._clock_s()

    def withdraw(self) -> None:
        """No data flows, until the next beat."""
        self._last_beat_s = None

    def follow(self, session: zenoh.Session) -> None:
        """Declare or undeclare the token as it is due."""
        with self._lock:
            if self.is_due and self._token is None:
                self._token = session.liveliness().declare_token(self._key)
            elif not self.is_due and self._token is not None:
                self._token.undeclare()
                self._token = None

    def forget(self) -> None:
        """The session is gone, and the token with it."""
        with self._lock:
            self._token = None
