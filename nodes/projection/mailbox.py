"""What waits to be worked on: everything in order, but of each scanner only the newest scan.

A stream that is late gains nothing from old scans: a newer one takes the place of one that was not begun, which is
counted. What the other messages say must not be lost, and is little.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field

MAX_WAITING = 4096


@dataclass(frozen=True, slots=True)
class Letter:
    """A message as it came: its key and payload."""

    key: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class Collected:
    """What had come: messages first, then the newest scan of each key."""

    others: tuple[Letter, ...] = ()
    scans: tuple[Letter, ...] = field(default=())


class Mailbox:
    """For many threads that put and one that collects.

    Attributes:
        n_replaced: scans that a newer one took the place of.
        n_lost: other messages for which there was no room.
    """

    def __init__(self) -> None:
        self._others: deque[Letter] = deque()
        self._scans: dict[str, bytes] = {}
        self._has_come = threading.Condition()
        self.n_replaced = 0
        self.n_lost = 0

    def put(self, key: str, payload: bytes) -> None:
        """A message that is not to be lost."""
        with self._has_come:
            if len(self._others) >= MAX_WAITING:
                self._others.popleft()
                self.n_lost += 1
            self._others.append(Letter(key, payload))
            self._has_come.notify()

    def put_scan(self, key: str, payload: bytes) -> None:
        """A scan; an older one of the same key that still waits is given up."""
        with self._has_come:
            # Put anew at the end: no scanner is served twice while another waits.
            self.n_replaced += self._scans.pop(key, None) is not None
            self._scans[key] = payload
            self._has_come.notify()

    def collect(self, timeout_s: float) -> Collected:
        """Everything that has come, waiting for the first of it; nothing when the time is over."""
        with self._has_come:
            if not (self._others or self._scans):
                self._has_come.wait(timeout_s)
            others, self._others = tuple(self._others), deque()
            scans, self._scans = tuple(Letter(*item) for item in self._scans.items()), {}
        return Collected(others, scans)

    def wake(self) -> None:
        """End a wait."""
        with self._has_come:
            self._has_come.notify_all()
