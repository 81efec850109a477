"""How a tilt unit moves: trapezoids of speed between positions, and the play of its gear."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from network_calib.observations import FloatArray

# A scan looks back by its own length at most; a minute of moves is plenty.
MAX_MOVES = 256


@dataclass(frozen=True, slots=True)
class Move:
    """From rest at one position to rest at another.

    Attributes:
        begin_s: when it begins.
        begin: position, in steps.
        end: position, in steps.
        speed: greatest speed, steps/s.
        acceleration: steps/s2.
    """

    begin_s: float
    begin: float
    end: float
    speed: float
    acceleration: float

    @property
    def duration_s(self) -> float:
        """Until it rests again."""
        distance = abs(self.end - self.begin)
        if distance <= self.speed**2 / self.acceleration:
            return 2 * math.sqrt(distance / self.acceleration)
        return distance / self.speed + self.speed / self.acceleration

    @property
    def end_s(self) -> float:
        """When it rests again."""
        return self.begin_s + self.duration_s

    def position(self, time_s: npt.ArrayLike) -> FloatArray:
        """Position in steps at times of any shape; at rest before and after."""
        duration, distance = self.duration_s, abs(self.end - self.begin)
        t = np.clip(np.asarray(time_s, dtype=np.float64) - self.begin_s, 0.0, duration)
        ramp_s = min(self.speed / self.acceleration, duration / 2)
        t_left = duration - t
        up = 0.5 * self.acceleration * np.minimum(t, ramp_s) ** 2
        down = 0.5 * self.acceleration * np.minimum(t_left, ramp_s) ** 2
        level = self.acceleration * ramp_s * np.clip(t - ramp_s, 0.0, duration - 2 * ramp_s)
        way = np.where(t_left < ramp_s, distance - down, up + level)
        return self.begin + math.copysign(1.0, self.end - self.begin) * way


class TiltMotion:
    """The moves of one axis, and where its load is: behind the motor by half the play, on the side it came from.

    Args:
        play: width of the gear's play, in steps.
    """

    def __init__(self, *, play: float = 0.0) -> None:
        self._play = play
        self._moves: list[Move] = []
        self._loads: list[float] = []

    def go(self, move: Move) -> None:
        """Add a move that begins not before now; an unfinished one ends where it is then."""
        self._loads.append(float(self.load(move.begin_s)))
        self._moves.append(move)
        if len(self._moves) > MAX_MOVES:
            del self._moves[0], self._loads[0]

    def motor(self, time_s: float) -> float:
        """Position of the motor, in steps: what the unit reports."""
        for move in reversed(self._moves):
            if move.begin_s <= time_s:
                return float(move.position(time_s))
        return self._moves[0].begin if self._moves else 0.0

    def rests_since_s(self, time_s: float) -> float:
        """When the motion before a time ended: infinite when it has not, and when there was none."""
        for move in reversed(self._moves):
            if move.begin_s <= time_s:
                return move.end_s if move.end_s <= time_s else math.inf
        return math.inf

    @property
    def end_s(self) -> float:
        """When the last move ends; minus infinity before the first."""
        return self._moves[-1].end_s if self._moves else -math.inf

    def load(self, time_s: npt.ArrayLike) -> FloatArray:
        """Position of the load, in steps, at times of any shape."""
        time_s = np.asarray(time_s, dtype=np.float64)
        out = np.full(time_s.shape, self._loads[0] if self._loads else 0.0)
        # Of the moves that began before all of these times only the last one counts.
        earliest = float(time_s.min(initial=math.inf))
        first = max(sum(move.begin_s <= earliest for move in self._moves) - 1, 0)
        for move, load in zip(self._moves[first:], self._loads[first:], strict=True):
            motor = move.position(time_s)
            dragged = np.clip(load, motor - self._play / 2, motor + self._play / 2)
            out = np.where(time_s >= move.begin_s, dragged, out)
        return out
