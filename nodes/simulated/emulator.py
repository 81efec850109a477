"""What an emulated instrument is: a state machine in given time, apart from the line that carries its bytes.

`loopback.py` joins one to a driver in virtual time; `emulator_server.py` serves several over ptys and TCP in real time.
"""

from __future__ import annotations

from typing import Protocol


class Emulator(Protocol):
    """One instrument. Time is that of the simulation, in seconds, and never runs backwards."""

    def connect(self, now_s: float) -> None:
        """A client opened the line (TCP), or the device was plugged in (serial)."""
        ...

    def disconnect(self, now_s: float) -> None:
        """The client went away, or the device was unplugged and lost its power."""
        ...

    def receive(self, data: bytes, now_s: float) -> None:
        """Bytes from the client; any bytes, in any pieces."""
        ...

    def send(self, now_s: float) -> bytes:
        """All bytes that are due by now; each is given once."""
        ...

    def next_due_s(self) -> float:
        """When `send` will have something if nothing is received before; infinite when never."""
        ...
