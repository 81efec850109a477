"""An emulator that says what it was given, piece by piece, whatever it hears."""

import math


class Babbler:
    def __init__(self, pieces: list[bytes]) -> None:
        self._rest = list(pieces)

    def connect(self, now_s: float) -> None: ...

    def disconnect(self, now_s: float) -> None: ...

    def receive(self, data: bytes, now_s: float) -> None: ...

    def send(self, now_s: float) -> bytes:
        del now_s
        return self._rest.pop(0) if self._rest else b""

    def next_due_s(self) -> float:
        return 0.0 if self._rest else math.inf
