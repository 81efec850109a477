"""The part of a room with the fewest spots, in words that a person with the pointer understands."""

from __future__ import annotations

import numpy as np

from network_calib.cameras import Cameras
from network_calib.observations import BoolArray, FloatArray

N_CELLS = 6
MIN_SPOTS = 20


def emptiest_place(spots: FloatArray, cameras: Cameras, *, unit: str) -> str:
    """The emptiest of the cells that the waved space spans and that two cameras see.

    Args:
        spots: (n, 3) in the world.
        cameras: calibrated.
        unit: of the world's lengths.

    Returns:
        For example "2.1 m in front of C3, 0.4 m to its left and 0.3 m above its axis"; empty where nothing is to tell.
    """
    if len(spots) < MIN_SPOTS:
        return ""
    low, high = np.percentile(spots, [2, 98], axis=0)
    side = max(float((high - low).max()) / N_CELLS, 1e-6)
    shape = np.maximum(np.ceil((high - low) / side).astype(np.int64), 1)
    inside = spots[((spots >= low) & (spots <= high)).all(axis=1)]
    cell = np.minimum(((inside - low) / side).astype(np.int64), shape - 1)
    counts = np.bincount(np.ravel_multi_index(tuple(cell.T), tuple(shape)), minlength=int(shape.prod()))
    index = np.stack(np.unravel_index(np.arange(len(counts)), tuple(shape)), axis=1)
    centres = low + (index + 0.5) * side
    is_seen = _sees(cameras, centres)
    is_open = is_seen.sum(axis=0) >= 2
    if not is_open.any():
        return ""
    distance = np.linalg.norm(centres[:, None] - spots[None], axis=2).min(axis=1)
    place = int(np.lexsort((-distance, counts, ~is_open))[0])
    return _told(centres[place], cameras, is_seen[:, place], unit)


def _sees(cameras: Cameras, places: FloatArray) -> BoolArray:
    """(C, n) which camera has which place (n, 3) in its picture."""
    camera = np.repeat(np.arange(len(cameras)), len(places))
    px, is_valid = cameras.img_from_world(camera, np.tile(places, (len(cameras), 1)))
    return (is_valid & cameras.is_in_image(camera, px)).reshape(len(cameras), len(places))


def _told(place: FloatArray, cameras: Cameras, is_seen: BoolArray, unit: str) -> str:
    """From the nearest camera that sees it."""
    distance = np.where(is_seen, np.linalg.norm(cameras.centres_in_world - place, axis=1), np.inf)
    nearest = int(np.argmin(distance))
    right, down, front = cameras.rotations[nearest] @ (place - cameras.centres_in_world[nearest])
    name = f" {unit}" if unit == "m" else f" {unit}s"
    across = f"{abs(right):.1f}{name} to its {'right' if right > 0 else 'left'}"
    along = f"{abs(down):.1f}{name} {'below' if down > 0 else 'above'} its axis"
    return f"{front:.1f}{name} in front of {cameras.names[nearest]}, {across} and {along}"
