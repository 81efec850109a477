"""An emulator whose messages are heard late, as by a program that the machine wakes when it likes."""

from __future__ import annotations

import math
from collections.abc import Callable

from nodes.simulated.emulator import Emulator


class LateEmulator:
    """Holds back what an emulator sends; what it receives is not held back.

    Args:
        emulator: the device.
        delay_s: draws the delay of the next message; none overtakes another.
    """

    def __init__(self, emulator: Emulator, delay_s: Callable[[], float]) -> None:
        self._emulator, self._delay_s = emulator, delay_s
        self._held: list[tuple[float, bytes]] = []

    def connect(self, now_s: float) -> None:
        """See `Emulator`."""
        self._held.clear()
        self._emulator.connect(now_s)

    def disconnect(self, now_s: float) -> None:
        """See `Emulator`."""
        self._held.clear()
        self._emulator.disconnect(now_s)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `Emulator`."""
        self._take(now_s)
        self._emulator.receive(data, now_s)

    def send(self, now_s: float) -> bytes:
        """See `Emulator`."""
        self._take(now_s)
        due = [data for due_s, data in self._held if due_s <= now_s]
        self._held = [(due_s, data) for due_s, data in self._held if due_s > now_s]
        return b"".join(due)

    def next_due_s(self) -> float:
        """See `Emulator`."""
        return min(self._held[0][0] if self._held else math.inf, self._emulator.next_due_s())

    def _take(self, now_s: float) -> None:
        """Every message at the time at which the device had sent it."""
        while (due_s := self._emulator.next_due_s()) <= now_s:
            if data := self._emulator.send(due_s):
                earliest_s = self._held[-1][0] if self._held else 0.0
                self._held.append((max(due_s + self._delay_s(), earliest_s), data))
