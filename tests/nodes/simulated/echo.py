"""The simplest emulator: repeats what it receives, a fixed time later."""

import math


class Echo:
    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s
        self._due: list[tuple[float, bytes]] = []
        self.n_connects = self.n_disconnects = 0

    def connect(self, now_s: float) -> None:
        del now_s
        self.n_connects += 1

    def disconnect(self, now_s: float) -> None:
        del now_s
        self.n_disconnects += 1
        self._due.clear()

    def receive(self, data: bytes, now_s: float) -> None:
        self._due.append((now_s + self._delay_s, data))

    def send(self, now_s: float) -> bytes:
        out = b"".join(data for due_s, data in self._due if due_s <= now_s)
        self._due = [(due_s, data) for due_s, data in self._due if due_s > now_s]
        return out

    def next_due_s(self) -> float:
        return min((due_s for due_s, _ in self._due), default=math.inf)
