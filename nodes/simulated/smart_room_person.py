"""The person in the simulated smart room: where the spot is at any instant, from seed and events alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from network_calib.observations import FloatArray
from nodes.simulated.smart_room_events import LEAD_S, Event, EventFile, Move, Rest, Stop, Wave
from nodes.simulated.smart_room_geometry import WAVED_HIGH_M, WAVED_LOW_M, SmartRoom

# Times from side to side of the waved space: along, across, up. Their ratios are far from simple ones, so that the way
# never closes; together they give about 1.1 m/s.
SWEEP_S = (7.3, 4.1, 2.57)
# Part of a straight zigzag in the sweep, the rest is a sine: equal time everywhere, yet no sharp turns.
STRAIGHTNESS = 0.97
# After the tilt unit came to rest the scanner learns the empty room.
AWAY_S = 3.6
# Raising and lowering: 8 cm above and below the plane clears a ball of 2 cm radius and a beam of 17 mm at 3.4 m.
RAISE_PERIOD_S, RAISE_AMPLITUDE_M = 3.4, 0.06
# Part of the period, about the lowest point, in which the person goes on to the next place.
MOVING_PART = 0.3
# Nobody raises the spot for longer than this at one tilt.
LONGEST_S = 120.0
# Instants of the space that furniture must leave free.
GRID = (12, 8, 6)

Motion = Callable[[float], FloatArray]


class SmartRoomPerson:
    """Follows the events; see `rendering.spot_path.BallPath` for the part that the renderer wants.

    Times are seconds since the world's start.

    Args:
        room: the truth.
        events: to be followed.
        start_s: the world's start, of the Unix epoch.
        rate_hz: frames a second of the cameras.
    """

    def __init__(self, room: SmartRoom, events: EventFile, *, start_s: float, rate_hz: float) -> None:
        self._room, self._file, self._start_s, self._rate_hz = room, events, start_s, rate_hz
        self.waves: list[Wave] = []
        self._turns: list[Rest | Move] = []
        axes = [np.linspace(*ends) for ends in zip(WAVED_LOW_M, WAVED_HIGH_M, GRID, strict=True)]
        self._points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)

    @property
    def points_in_world(self) -> FloatArray:
        """(F, 3) a grid over the space in which the spot is waved."""
        return self._points

    @property
    def rate_hz(self) -> float:
        """Frames a second of the cameras."""
        return self._rate_hz

    def __len__(self) -> int:
        # It goes on until nobody asks.
        return 1 << 40

    def refresh(self) -> None:
        """Read what has happened since."""
        self._take(self._file.new())

    def motion_at(self, time_s: float) -> Motion | None:
        """How the spot moves at an instant: its place (3,) at instants nearby; None while nobody is there."""
        for number, wave in enumerate(self.waves):
            if wave.begin_s <= time_s < wave.begin_s + wave.seconds:
                return self._waving(number, wave.begin_s)
        return self._raising(time_s)

    def spot_in_world(self, time_s: float) -> FloatArray | None:
        """(3,) of the ball's centre; None while nobody is there."""
        motion = self.motion_at(time_s)
        return None if motion is None else motion(time_s)

    def at(self, time_s: FloatArray) -> FloatArray:
        """Positions (N, 3) at instants (N,) of one exposure; NaN: nobody."""
        times = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        motion = self.motion_at(float(times[len(times) // 2]))
        if motion is None:
            return np.full((len(times), 3), np.nan)
        return np.array([motion(float(t)) for t in times])

    def is_shining(self, time_s: float) -> bool:
        """Whether the spot is in the room."""
        return self.motion_at(time_s) is not None

    def _take(self, events: Iterable[Event]) -> None:
        for event in events:
            if isinstance(event, Wave):
                self.waves.append(Wave(self._since_start(event.begin_s), event.seconds))
            elif isinstance(event, Stop):
                self._stop(self._since_start(event.time_s))
            elif isinstance(event, Rest):
                self._turns.append(Rest(self._since_start(event.time_s), event.tilt_rad))
            else:
                self._turns.append(Move(self._since_start(event.time_s)))

    def _since_start(self, time_s: float) -> float:
        # The epoch's seconds are known to a quarter of a microsecond: equal differences stay equal when rounded.
        return round(time_s - self._start_s, 6)

    def _stop(self, time_s: float) -> None:
        self.waves = [
            wave
            if not wave.begin_s <= time_s < wave.begin_s + wave.seconds
            else Wave(wave.begin_s, time_s - wave.begin_s)
            for wave in self.waves
        ]

    def _waving(self, number: int, begin_s: float) -> Motion:
        phase = np.random.default_rng([self._room.seed, 0x3A, number]).uniform(0, 2 * math.pi, 3)
        low, high = np.array(WAVED_LOW_M), np.array(WAVED_HIGH_M)
        rate = math.pi / np.array(SWEEP_S)

        def at(time_s: float) -> FloatArray:
            swing = np.arcsin(STRAIGHTNESS * np.sin(rate * (time_s - begin_s) + phase)) / math.asin(STRAIGHTNESS)
            return low + (high - low) * (swing + 1) / 2

        return at

    def _raising(self, time_s: float) -> Motion | None:
        """Raising and lowering the spot at the tilt at which the unit rests."""
        known = [turn for turn in self._turns if turn.time_s + LEAD_S <= time_s]
        rest = known[-1] if known else None
        if not isinstance(rest, Rest):
            return None
        begin_s, tilt_rad = rest.time_s + AWAY_S, rest.tilt_rad
        if not begin_s <= time_s < begin_s + LONGEST_S:
            return None
        normal = self._room.scanner.world_from_lrf_at(tilt_rad).rotation.as_matrix()[:, 2]

        def at(instant_s: float) -> FloatArray:
            turns = (instant_s - begin_s) / RAISE_PERIOD_S
            place = _between(self._room, tilt_rad, turns)
            return place - RAISE_AMPLITUDE_M * math.cos(2 * math.pi * turns) * normal

        return at


def _between(room: SmartRoom, tilt_rad: float, turns: float) -> FloatArray:
    """(3,) place in the plane: each for most of a period, then smoothly on to the next, about the lowest point."""
    lowest = round(turns)
    part = min(max((turns - lowest) / MOVING_PART + 0.5, 0.0), 1.0)
    before, after = max(lowest - 1, 0), max(lowest, 0)
    here = room.place_in_world(tilt_rad, before, turns - before)
    there = room.place_in_world(tilt_rad, after, turns - after)
    return here + (there - here) * (part * part * (3 - 2 * part))
