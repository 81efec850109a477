"""One door to every simulated session, with cameras alone or with a laser range finder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.synthetic import ROOM_NAMES, observe, room
from nodes.simulation.lrf_simulation import LRF_PLANS, simulate_lrf_room
from nodes.simulation.spots_simulation import write_simulation


def simulate_named(
    name: str, folder: Path, *, seed: int, n_frames: int | None, noise_px: float, missing: float, false: float
) -> int:
    """Write a named session into a folder; the same name, numbers and seed write the same files.

    Args:
        name: one of ROOM_NAMES or LRF_PLANS.
        folder: made when missing.
        seed: of all random draws.
        n_frames: length of the way, of an LRF session of its part outside the scan planes; None for its own.
        noise_px: standard deviation of detections, each axis.
        missing: share of detections dropped.
        false: share of detections put at a random pixel.

    Returns:
        Number of detections.

    Raises:
        InputError: an unknown name.
    """
    if name in LRF_PLANS:
        sighting = simulate_lrf_room(
            name, folder, seed=seed, n_frames=n_frames, noise_px=noise_px, missing=missing, false=false
        )
        return len(sighting.observations)
    _refuse_unknown(name)
    rng = np.random.default_rng(seed)
    built = room(name, rng=rng, n_frames=n_frames)
    sighting = observe(built, rng=rng, sigma_px=noise_px, missing=missing, false_detections=false)
    write_simulation(built, sighting, folder, noise_px=noise_px, seed=seed)
    return len(sighting.observations)


def refuse_no_video_room(name: str) -> None:
    """Rooms that cannot be filmed.

    Raises:
        InputError: an unknown name, or a room with a laser range finder.
    """
    if name in LRF_PLANS:
        raise InputError(f"{name} holds a laser range finder and is not filmed: leave out --video")
    _refuse_unknown(name)


def _refuse_unknown(name: str) -> None:
    if name not in ROOM_NAMES:
        raise InputError(f"no room {name!r}, expected one of {', '.join((*ROOM_NAMES, *LRF_PLANS))}")
