"""A person who tilts the LRF by hand: goes there when asked, turns it smoothly with a tremor, stops nearby, lets go."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from network_calib.observations import FloatArray


@dataclass(frozen=True, slots=True)
class Hand:
    """How the person does it.

    Attributes:
        reaction_s: from being asked to the first motion.
        speed_rad_s: mean of a turn.
        shortest_s: of a turn.
        miss_rad: standard deviation of where it stops about where it was asked to.
        hold_s: from the end of the turn to letting go.
        tremor_rad: amplitude while the hand holds it.
        tremor_hz: of the tremor; 8 to 12 Hz are usual.
    """

    reaction_s: float = 3.0
    speed_rad_s: float = math.radians(12.0)
    shortest_s: float = 1.0
    miss_rad: float = math.radians(2.0)
    hold_s: float = 1.0
    tremor_rad: float = math.radians(0.05)
    tremor_hz: float = 9.0


@dataclass(frozen=True, slots=True)
class _Turn:
    asked_s: float
    begin_s: float
    duration_s: float
    released_s: float
    begin_rad: float
    end_rad: float


class TiltingPerson:
    """Stands in for a tilt unit's true motion, see `platform.Tilting`.

    Args:
        rng: draws where the person stops.
        hand: how the person does it.
        begin_rad: where the LRF stands at first.
    """

    def __init__(self, rng: np.random.Generator, *, hand: Hand | None = None, begin_rad: float = 0.0) -> None:
        self._rng, self._hand, self._begin_rad = rng, hand or Hand(), begin_rad
        self._turns: list[_Turn] = []

    def ask(self, tilt_rad: float, now_s: float) -> None:
        """Ask for a tilt angle, when the last one is done."""
        hand = self._hand
        before = self._turns[-1].end_rad if self._turns else self._begin_rad
        after = tilt_rad + hand.miss_rad * float(self._rng.standard_normal())
        begin_s = now_s + hand.reaction_s
        duration_s = max(abs(after - before) / hand.speed_rad_s, hand.shortest_s)
        self._turns.append(_Turn(now_s, begin_s, duration_s, begin_s + duration_s + hand.hold_s, before, after))

    def tilt_rad(self, time_s: npt.ArrayLike) -> FloatArray:
        """True tilt at times of any shape."""
        time_s = np.asarray(time_s, dtype=np.float64)
        out = np.full(time_s.shape, self._begin_rad)
        for turn in self._turns:
            part = np.clip((time_s - turn.begin_s) / turn.duration_s, 0.0, 1.0)
            # Least jerk, as hands move.
            way = part**3 * (10 - 15 * part + 6 * part**2)
            held = np.clip((time_s - turn.begin_s) * (turn.released_s - time_s) * 16, 0.0, 1.0)
            tremor = self._hand.tremor_rad * held * np.sin(2 * math.pi * self._hand.tremor_hz * time_s)
            angle = turn.begin_rad + way * (turn.end_rad - turn.begin_rad) + tremor
            out = np.where(time_s >= turn.begin_s, angle, out)
        return out

    def rests_since_s(self, time_s: float) -> float:
        """When the person let go; infinite from being asked until then, and before."""
        for turn in reversed(self._turns):
            if turn.asked_s <= time_s:
                return turn.released_s if turn.released_s <= time_s else math.inf
        return math.inf
