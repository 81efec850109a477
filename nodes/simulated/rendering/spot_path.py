"""The way of the pointer's ball through the room, at any instant."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from network_calib.errors import InputError
from network_calib.synthetic import Room

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
# No hand is faster; a larger step is a cut (the pointer was off and elsewhere again), and nothing moves across it.
MAX_SPEED_M_S = 15.0


class BallPath(Protocol):
    """What a renderer asks of the ball's way."""

    @property
    def points_in_world(self) -> FloatArray:
        """(F, 3) places that the ball may come to, m; furniture stands elsewhere. NaN: nobody is in the room."""
        ...

    @property
    def rate_hz(self) -> float:
        """Instants a second."""
        ...

    def __len__(self) -> int:
        """Number of instants."""
        ...

    def at(self, time_s: FloatArray) -> FloatArray:
        """Positions (N, 3) at instants (N,) of one exposure; NaN: nobody."""
        ...

    def is_shining(self, time_s: float) -> bool:
        """Whether the pointer is on at an instant."""
        ...


@dataclass(frozen=True, slots=True)
class SpotPath:
    """Where the ball is at each instant n / rate_hz, joined by cubic curves.

    Attributes:
        points_in_world: (F, 3) centre of the ball, m; z is up and the floor is z = 0. NaN: nobody is in the room.
        rate_hz: points a second; the first is at time 0.
        is_on: (F,) whether the pointer shines; None: always.
    """

    points_in_world: FloatArray
    rate_hz: float
    is_on: BoolArray | None = None
    _velocity: FloatArray = field(init=False, repr=False, compare=False)
    _is_joined: BoolArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        points = self.points_in_world
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
            raise InputError(f"points_in_world has the shape {points.shape}, expected (2 or more, 3)")
        if not self.rate_hz > 0:
            raise InputError(f"rate_hz is {self.rate_hz}, expected more than 0")
        if self.is_on is not None and self.is_on.shape != (len(points),):
            raise InputError(f"is_on has the shape {self.is_on.shape}, expected ({len(points)},)")
        step = np.diff(points, axis=0)
        is_joined = np.linalg.norm(step, axis=1) <= MAX_SPEED_M_S / self.rate_hz  # never for NaN
        before = np.vstack([np.zeros((1, 3)), np.where(is_joined[:, None], step, 0.0)])
        after = np.vstack([before[1:], np.zeros((1, 3))])
        n_sides = np.append(0, is_joined) + np.append(is_joined, 0)
        # Per step: the central difference, or the one-sided one at an end.
        object.__setattr__(self, "_velocity", (before + after) / np.maximum(n_sides, 1)[:, None])
        object.__setattr__(self, "_is_joined", is_joined)

    def __len__(self) -> int:
        return len(self.points_in_world)

    @classmethod
    def of(cls, room: Room, *, n_empty: int = 0) -> SpotPath:
        """The waved path of a synthetic room, after `n_empty` instants of the empty room (for learning it)."""
        points = np.vstack([np.full((n_empty, 3), np.nan), room.trajectory])
        return cls(points, room.frame_rate_hz)

    def switched(self, is_on: BoolArray) -> SpotPath:
        """The same way with the pointer off in some instants: (F,)."""
        return replace(self, is_on=is_on)

    def at(self, time_s: FloatArray) -> FloatArray:
        """Positions (N, 3) at instants (N,): cubic Hermite curves, straight on beyond ends and cuts; NaN: nobody."""
        step = np.atleast_1d(np.asarray(time_s, dtype=np.float64)) * self.rate_hz
        first = np.clip(np.floor(step).astype(np.int64), 0, len(self) - 2)
        nearest = self._nearest(step)
        straight = self.points_in_world[nearest] + (step - nearest)[:, None] * self._velocity[nearest]
        part = (step - first)[:, None]
        is_inside = self._is_joined[first] & (part[:, 0] >= 0) & (part[:, 0] <= 1)
        rest = 1 - part
        curved = rest * rest * ((1 + 2 * part) * self.points_in_world[first] + part * self._velocity[first])
        curved += part * part * ((1 + 2 * rest) * self.points_in_world[first + 1] - rest * self._velocity[first + 1])
        return np.where(is_inside[:, None], curved, straight)

    def is_shining(self, time_s: float) -> bool:
        """Whether the pointer is on at an instant: as at the nearest point."""
        nearest = int(self._nearest(np.array([time_s * self.rate_hz]))[0])
        is_there = bool(np.isfinite(self.points_in_world[nearest]).all())
        return is_there and (self.is_on is None or bool(self.is_on[nearest]))

    def _nearest(self, step: FloatArray) -> npt.NDArray[np.int64]:
        return np.clip(np.rint(step).astype(np.int64), 0, len(self) - 1)
