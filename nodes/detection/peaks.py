"""Where in a picture something is brighter than its threshold: the coarse search.

The whole picture is touched once, strip by strip in the processor's cache: subtracted with saturation, and asked for
anything that is left. A colour picture is not even unpacked: the threshold lies in memory as the picture does, out of
reach in the other channels. All else works on the few samples that are left, in cells of 8 x 8.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np

from nodes.detection.channel import Plane, SampleArray

WORD_BYTES = 8
CELL = 8
STRIP_ROWS = 8 * CELL
AROUND = np.ones((3, 3), np.uint8)


class PeakFinder:
    """Finds peaks in planes of one shape and type; holds the memory for it."""

    def __init__(self, plane: Plane, *, max_width: float) -> None:
        """Begin.

        Args:
            plane: one like all that will come.
            max_width: of anything that is to be found, in samples: what is wider both ways is taken away.
        """
        packed = plane.packed
        self._width = plane.samples.shape[1]
        self._n_lanes = packed.shape[1] // self._width
        n_words = -(-packed.shape[1] * packed.itemsize // WORD_BYTES)
        # Padded with zeros that no subtraction writes to, so that each row is a whole number of words.
        self._excess = np.zeros((STRIP_ROWS, n_words * WORD_BYTES // packed.itemsize), packed.dtype)
        self._words = self._excess.view(np.uint64)
        shape = -(-plane.samples.shape[0] // CELL), -(-self._width // CELL)
        self._cells = np.zeros(shape, packed.dtype)
        self._places = np.zeros(shape, np.intp)
        # Two cells more than the width, as it may begin and end in the middle of one; an even size would shift things.
        self._kernel = np.ones([(math.ceil(max_width / CELL) + 2) | 1] * 2, np.uint8)

    def peaks(self, plane: Plane, packed_threshold: SampleArray) -> Iterator[tuple[int, int]]:
        """Column and row of samples that stand out of their neighbourhood, the most prominent first.

        A wide plateau may give several peaks.

        Args:
            plane: of a frame.
            packed_threshold: of the shape of `plane.packed`, full in other channels.
        """
        packed, width = plane.packed, plane.packed.shape[1]
        self._cells[:] = 0
        is_any = False
        for top in range(0, len(packed), STRIP_ROWS):
            strip = packed[top : top + STRIP_ROWS]
            excess = self._excess[: len(strip), :width]
            cv2.subtract(strip, packed_threshold[top : top + STRIP_ROWS], dst=excess)
            if cv2.hasNonZero(excess):
                self._note_strip(top, len(strip))
                is_any = True
        if is_any:
            yield from self._peaks_of_cells()

    def _note_strip(self, top: int, n_rows: int) -> None:
        """Put the largest excess and its place into each cell of a strip."""
        words = self._words[:n_rows]
        rows = np.flatnonzero(np.bitwise_or.reduce(words, axis=1))
        k, word = np.nonzero(words[rows])
        values = words[rows[k], word].view(self._excess.dtype).reshape(len(k), -1)
        within = values.argmax(axis=1)
        largest = values[np.arange(len(k)), within]
        x = (word * values.shape[1] + within) // self._n_lanes
        y = rows[k] + top
        cell = y // CELL * self._cells.shape[1] + x // CELL
        cells = self._cells.reshape(-1)
        np.maximum.at(cells, cell, largest)
        is_largest = largest == cells[cell]
        self._places.reshape(-1)[cell[is_largest]] = (y * self._width + x)[is_largest]

    def _peaks_of_cells(self) -> Iterator[tuple[int, int]]:
        row, column, cells = self._cells_in_question()
        # A white top hat: what is left when all that is wider than the kernel is taken away.
        prominence = cv2.morphologyEx(cells, cv2.MORPH_TOPHAT, self._kernel)
        is_peak = (prominence > 0) & (cells == cv2.dilate(cells, AROUND))
        order = np.argsort(-prominence[is_peak].astype(np.int64), kind="stable")
        places = self._places[row : row + cells.shape[0], column : column + cells.shape[1]][is_peak]
        for place in places[order].tolist():
            y, x = divmod(place, self._width)
            yield x, y

    def _cells_in_question(self) -> tuple[int, int, SampleArray]:
        """First row and column, and the cells with any excess and so many around them as the kernel reaches."""
        rows, columns = np.flatnonzero(self._cells.any(axis=1)), np.flatnonzero(self._cells.any(axis=0))
        reach = len(self._kernel)
        top, left = max(int(rows[0]) - reach, 0), max(int(columns[0]) - reach, 0)
        return top, left, self._cells[top : int(rows[-1]) + reach + 1, left : int(columns[-1]) + reach + 1]
