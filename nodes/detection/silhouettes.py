"""Peaks in front of somebody: where the picture has become darker, the learnt threshold says nothing about the spot.

Somebody before a window hides what was bright there, and a spot in his hand may be no brighter than the window was.
It still stands out of what is there now.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np

from nodes.detection.background import GRID_STEP, Background
from nodes.detection.channel import SampleArray
from nodes.detection.spots import BoolArray

CELL = 8
# A hand is at the edge of the silhouette of its arm: so many steps of the grid around what is darker.
AROUND = 1
# What stands out must do so by this share of full scale: clothes have folds and buttons.
MIN_PROMINENCE = 0.1


def silhouette_peaks(
    samples: SampleArray, background: Background, is_darker: BoolArray, *, max_width: float
) -> Iterator[tuple[int, int]]:
    """Column and row of what stands out of its neighbourhood near darkened places, the most prominent first.

    Args:
        samples: (h, w) of a frame.
        background: of its channel.
        is_darker: on the grid of the background, see `Background.survey`.
        max_width: of anything that is to be found, in samples.
    """
    if not is_darker.any():
        return
    near = cv2.dilate(is_darker.view(np.uint8), np.ones((2 * AROUND + 1, 2 * AROUND + 1), np.uint8))
    size = (math.ceil(max_width / CELL) + 2) | 1
    top, bottom = _reach(np.asarray(near.any(axis=1)), size, samples.shape[0])
    left, right = _reach(np.asarray(near.any(axis=0)), size, samples.shape[1])
    part = samples[top:bottom, left:right]
    n_rows, n_columns = part.shape[0] // CELL, part.shape[1] // CELL
    cells = part.reshape(n_rows, CELL, -1).max(axis=1).reshape(n_rows, n_columns, CELL).max(axis=2)
    prominence = cv2.morphologyEx(cells, cv2.MORPH_TOPHAT, np.ones((size, size), np.uint8))
    # The grid ends before the picture where that is no multiple of its step: its last row and column then serve.
    grid_rows = np.minimum((top + CELL * np.arange(n_rows)) // GRID_STEP, near.shape[0] - 1)
    grid_columns = np.minimum((left + CELL * np.arange(n_columns)) // GRID_STEP, near.shape[1] - 1)
    is_near = near[grid_rows[:, None], grid_columns]
    is_peak = (prominence > MIN_PROMINENCE * background.full_scale) & (is_near > 0)
    is_peak &= cells == cv2.dilate(cells, np.ones((3, 3), np.uint8))
    places = np.argwhere(is_peak)
    for row, column in places[np.argsort(-prominence[is_peak].astype(np.int64), kind="stable")].tolist():
        cell = part[row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL]
        y, x = divmod(int(cell.argmax()), CELL)
        yield left + column * CELL + x, top + row * CELL + y


def _reach(is_near: BoolArray, n_cells: int, n_samples: int) -> tuple[int, int]:
    """First and last sample, as whole cells, of what is near and so many cells around it."""
    steps = np.flatnonzero(is_near)
    first = max(int(steps[0]) * GRID_STEP - n_cells * CELL, 0)
    last = min((int(steps[-1]) + 1) * GRID_STEP + n_cells * CELL, n_samples)
    return first, last - (last - first) % CELL
