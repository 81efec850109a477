"""Where candidates keep coming back: a lamp switched on, a blinking light, the picture on a screen."""

from __future__ import annotations

import math

import numpy as np

from nodes.detection.spots import FloatArray

# Samples to a cell; a candidate counts in its cell and in the eight around it.
CELL = 16
# Frames; some ten seconds.
MEMORY = 250.0


class Dwelling:
    """How much of the time there was a candidate at each place lately."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """Begin, for planes of so many rows and columns."""
        # A border of one cell, so that every cell has eight neighbours.
        cells = shape[0] // CELL + 3, shape[1] // CELL + 3
        self._weight = np.zeros(cells)
        self._noted = np.zeros(cells)
        self._now = 0

    def share(self, px: FloatArray) -> float:
        """Weighted share 0..1 of the frames of the last seconds in which a candidate was near (2,) x, y."""
        column, row = _cell(px)
        around = slice(row - 1, row + 2), slice(column - 1, column + 2)
        age = self._now - self._noted[around]
        return min(float((self._weight[around] * np.exp(-age / MEMORY)).sum()) / MEMORY, 1.0)

    def note(self, positions: list[FloatArray]) -> None:
        """Take one frame's candidates into account, (2,) x, y each."""
        self._now += 1
        for column, row in {_cell(px) for px in positions}:
            faded = self._weight[row, column] * math.exp((self._noted[row, column] - self._now) / MEMORY)
            self._weight[row, column] = faded + 1.0
            self._noted[row, column] = self._now


def _cell(px: FloatArray) -> tuple[int, int]:
    return int(px[0]) // CELL + 1, int(px[1]) // CELL + 1
