"""A driver and an emulator joined in one process and in virtual time: as fast as the machine, and deterministic."""

from __future__ import annotations

import math
from dataclasses import dataclass

from nodes.closing import Closing
from nodes.devices.errors import LineLostError
from nodes.devices.transport import MAX_READ_BYTES
from nodes.simulated.emulator import Emulator
from nodes.simulated.line_faults import LineFaults

OVERDUE_S = 1e-3


@dataclass(slots=True)
class VirtualClock:
    """Time that passes only when somebody waits. Call it to read it, as `time.monotonic`."""

    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        """Let time pass."""
        self.now_s += max(duration_s, 0.0)


class LoopbackTransport(Closing):
    """The client's end of a line to an emulator; reading lets the clock run to the next byte or the timeout."""

    def __init__(self, emulator: Emulator, clock: VirtualClock, *, faults: LineFaults | None = None) -> None:
        self.name = "loopback"
        self._emulator, self._clock, self._faults = emulator, clock, faults
        self._waiting = b""
        self._is_open = True
        emulator.connect(clock())

    def read(self, timeout_s: float) -> bytes:
        """See `Transport`."""
        end_s = self._clock() + timeout_s
        while not self._waiting:
            self._check()
            self._fetch()
            if self._waiting or self._clock() >= end_s:
                break
            due_s = min(self._emulator.next_due_s(), self._next_fault_s(), end_s)
            # What is due and does not come is waited for as for a slow device, not for ever at this instant.
            self._clock.now_s = due_s if due_s > self._clock() else min(self._clock() + OVERDUE_S, end_s)
        out, self._waiting = self._waiting[:MAX_READ_BYTES], self._waiting[MAX_READ_BYTES:]
        return out

    def write(self, data: bytes) -> None:
        """See `Transport`."""
        self._check()
        self._emulator.receive(data, self._clock())

    def set_baud(self, baud: int) -> None:
        """Bytes arrive at once here."""

    def close(self) -> None:
        """See `Transport`."""
        if self._is_open:
            self._is_open = False
            self._emulator.disconnect(self._clock())

    def _fetch(self) -> None:
        data = self._emulator.send(self._clock())
        self._waiting += data if self._faults is None else self._faults.carry(data, self._clock())

    def _next_fault_s(self) -> float:
        return math.inf if self._faults is None else self._faults.next_change_s(self._clock())

    def _check(self) -> None:
        if not self._is_open or (self._faults is not None and self._faults.is_unplugged(self._clock())):
            self.close()
            raise LineLostError(f"{self.name}: the device is gone")
