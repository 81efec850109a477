"""What a command asks an LRF node to acquire."""

from __future__ import annotations

import math
from dataclasses import dataclass

from network_calib.errors import InputError
from nodes.bus import spotcal_pb2 as pb
from nodes.site.model import LrfDeviceConfig

MAX_TILTS, MAX_CROSSINGS = 100, 1000


@dataclass(frozen=True, slots=True)
class TiltPlan:
    """An acquisition.

    Attributes:
        session: that it belongs to.
        tilts_rad: one after the other.
        n_crossings: at every tilt, at least.
    """

    session: str
    tilts_rad: tuple[float, ...]
    n_crossings: int


def plan_of(command: pb.Command, config: LrfDeviceConfig, session: str) -> TiltPlan:
    """What the command says, and the configuration where it says nothing.

    Raises:
        InputError: angles beyond a right one, or too many of anything.
    """
    tilts_rad = tuple(command.tilts_rad) or tuple(math.radians(tilt_deg) for tilt_deg in config.tilts_deg)
    n_crossings = command.n_crossings or config.crossings
    wrong = [tilt_rad for tilt_rad in tilts_rad if not abs(tilt_rad) <= math.pi / 2]
    if wrong:
        raise InputError(f"a tilt of {math.degrees(wrong[0]):.1f} deg, expected -90 to 90")
    if len(tilts_rad) > MAX_TILTS or n_crossings > MAX_CROSSINGS:
        raise InputError(
            f"{len(tilts_rad)} tilts with {n_crossings} crossings, expected at most {MAX_TILTS} and {MAX_CROSSINGS}"
        )
    return TiltPlan(session, tilts_rad, n_crossings)
