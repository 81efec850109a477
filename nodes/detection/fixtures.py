"""Bright things that stand perfectly still: lamps switched on, reflections that somebody had hidden.

No hand holds a spot so still for so long; a thing that does is part of the room and may be learnt.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nodes.detection.spots import FloatArray

# A candidate within this distance of where it was first seen, in samples, has not moved.
STILL = 0.5
# Seen there in so many frames, some twenty seconds, it is a fixture.
N_FRAMES = 500
# Forgotten when not seen for so many frames.
MEMORY = 250
N_PLACES = 64


class Fixtures:
    """Counts how often something was seen at the very same place; remembers so many places at most."""

    def __init__(self) -> None:
        self._px = np.full((N_PLACES, 2), -1e9)
        self._n_seen = np.zeros(N_PLACES, np.int64)
        self._last = np.full(N_PLACES, -MEMORY - 1, np.int64)
        self._now = 0

    def note(self, positions: Sequence[FloatArray]) -> frozenset[int]:
        """Take one frame's candidates, (2,) x, y each, into account; the numbers of those that are fixtures."""
        self._now += 1
        self._n_seen[self._now - self._last > MEMORY] = 0
        fixtures = set()
        for k, px in enumerate(positions):
            away = np.abs(self._px - px).max(axis=1)
            place = int(away.argmin())
            if away[place] > STILL or self._n_seen[place] == 0:
                place = int(self._last.argmin())
                self._px[place], self._n_seen[place] = px, 0
            self._n_seen[place] += 1
            self._last[place] = self._now
            if self._n_seen[place] > N_FRAMES:
                fixtures.add(k)
        return frozenset(fixtures)
