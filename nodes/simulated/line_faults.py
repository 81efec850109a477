"""What a bad cable does to bytes: flipped bits, lost bytes, stalls, pulled plugs. Deterministic by seed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


class LineFaults:
    """Faults of one line, from the device to the client.

    Args:
        rng: draws which bytes suffer.
        flips_per_byte: probability that a byte has one bit flipped.
        drops_per_byte: probability that a byte is lost.
        stalls: (begin, duration) in s: what is sent meanwhile comes at the end.
        unplugs: (begin, duration) in s: the device is gone, and what it sends is lost.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        *,
        flips_per_byte: float = 0.0,
        drops_per_byte: float = 0.0,
        stalls: Sequence[tuple[float, float]] = (),
        unplugs: Sequence[tuple[float, float]] = (),
    ) -> None:
        self._rng = rng
        self._flips_per_byte, self._drops_per_byte = flips_per_byte, drops_per_byte
        self._stalls, self._unplugs = tuple(stalls), tuple(unplugs)
        self._held = b""
        self.n_flipped = 0
        self.n_dropped = 0

    def carry(self, data: bytes, now_s: float) -> bytes:
        """What arrives of what is sent now, with what a stall held back."""
        if self.is_unplugged(now_s):
            self._held = b""
            return b""
        self._held += self._damaged(data)
        if _covers(self._stalls, now_s):
            return b""
        out, self._held = self._held, b""
        return out

    def is_unplugged(self, now_s: float) -> bool:
        """Whether the plug is out."""
        return _covers(self._unplugs, now_s)

    def next_change_s(self, now_s: float) -> float:
        """When the next stall or unplugging begins or ends; infinite when none does."""
        edges = [edge for begin, span in (*self._stalls, *self._unplugs) for edge in (begin, begin + span)]
        return min((edge for edge in edges if edge > now_s), default=math.inf)

    def _damaged(self, data: bytes) -> bytes:
        if not data or not (self._flips_per_byte or self._drops_per_byte):
            return data
        values = np.frombuffer(data, dtype=np.uint8).copy()
        is_flipped = self._rng.random(len(values)) < self._flips_per_byte
        values[is_flipped] ^= (1 << self._rng.integers(0, 8, int(is_flipped.sum()))).astype(np.uint8)
        is_dropped = self._rng.random(len(values)) < self._drops_per_byte
        self.n_flipped += int(is_flipped.sum())
        self.n_dropped += int(is_dropped.sum())
        return values[~is_dropped].tobytes()


def _covers(spans: tuple[tuple[float, float], ...], now_s: float) -> bool:
    return any(begin <= now_s < begin + span for begin, span in spans)
