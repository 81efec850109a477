"""What the benchmarks calibrate: the real recordings, and synthetic rooms as a user would describe them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.measure import ROOT
from network_calib.observations import Observations
from network_calib.optimum import Network, optimise
from network_calib.room_setup import Anchor, CameraSetup, KnownDistance, Options, UnitScale
from network_calib.spots import SpotViews
from network_calib.synthetic import Room

RECORDINGS = ROOT.parent / "shared" / "data"
NAMES = ("DATA20100906_134124", "caldata20130726_122220", "DATA20090709_111010")
ABSENT = "skipped: ../shared/data is absent"


def recording_folder(name: str) -> Path | None:
    """The folder of a real recording; None where it is absent."""
    folder = RECORDINGS / name
    return folder if (folder / "points.dat").is_file() else None


def setups_of(room: Room) -> list[CameraSetup]:
    """Names, image sizes and lens models: what is known of a synthetic room's cameras. Intrinsics are unknown."""
    cameras = room.cameras
    return [
        CameraSetup(name, (int(size[0]), int(size[1])), lens=lens)
        for name, size, lens in zip(cameras.names, cameras.size_px, cameras.lenses, strict=True)
    ]


def baseline_of(room: Room) -> KnownDistance:
    """The stereo pair as anchor."""
    first, second = room.cameras.names[:2]
    return KnownDistance(first, second, room.baseline_m, is_stereo_pair=True)


def solve_once(
    observations: Observations, setups: Sequence[CameraSetup], *, anchor: Anchor | None = None, seed: int = 0
) -> Network:
    """The solve alone, without hold-out, repeats and checks: pairs, start, joint rounds."""
    views = SpotViews.of(observations)
    return optimise(setups, views, anchor=anchor or UnitScale(), options=Options(), seed=seed)


def random_generator(*numbers: int) -> np.random.Generator:
    """A generator for a numbered scene."""
    return np.random.default_rng(numbers)
