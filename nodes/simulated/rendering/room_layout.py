"""Where a rendered room's walls, furniture, lamps, windows and screens are; the same for all its cameras."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from network_calib.cameras import Cameras
from nodes.simulated.rendering.room_scene import RoomScene
from nodes.simulated.rendering.spot_path import BallPath

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
MARGIN_M = 0.35
MIN_CEILING_M = 2.9
# Walls in the order in which things are hung: opposite walls follow each other, so that every camera faces some.
WALLS = ((1, True), (1, False), (0, True), (0, False))


@dataclass(frozen=True, slots=True)
class Box:
    """A piece of furniture, sides along the axes.

    Attributes:
        low: (3,) least corner, m.
        high: (3,) greatest corner, m.
        style: 0 plain, 1 drawers, 2 books; which pattern its sides show.
        bgr: reflectance.
    """

    low: FloatArray
    high: FloatArray
    style: int
    bgr: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class WallRect:
    """A rectangle on a wall.

    Attributes:
        axis: the wall is perpendicular to this axis (0 x, 1 y).
        is_high: it is the wall at the axis's high end.
        across_m: from, to along the wall (the other horizontal axis).
        up_m: from, to above the floor.
    """

    axis: int
    is_high: bool
    across_m: tuple[float, float]
    up_m: tuple[float, float]

    def centre(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """(3,) its middle in a room with these corners."""
        out = np.empty(3)
        out[self.axis] = (high if self.is_high else low)[self.axis]
        out[1 - self.axis], out[2] = sum(self.across_m) / 2, sum(self.up_m) / 2
        return out


@dataclass(frozen=True, slots=True)
class Lamp:
    """A shining sphere.

    Attributes:
        centre: (3,) m.
        radius_m: of the sphere.
    """

    centre: FloatArray
    radius_m: float


@dataclass(frozen=True, slots=True)
class RoomLayout:
    """The things of a room.

    Attributes:
        low: (3,) least corner; the floor is z = 0.
        high: (3,) greatest corner.
        boxes: furniture.
        lamps: on the walls.
        panels: (P, 3) centres of the ceiling's light panels.
        windows: on walls.
        screens: on walls.
        posters: on walls; what they show is drawn at random.
        indicators: (N, 3) small blinking lamps.
        texture_seed: draws patterns.
    """

    low: FloatArray
    high: FloatArray
    boxes: tuple[Box, ...]
    lamps: tuple[Lamp, ...]
    panels: FloatArray
    windows: tuple[WallRect, ...]
    screens: tuple[WallRect, ...]
    posters: tuple[WallRect, ...]
    indicators: FloatArray
    texture_seed: int
    _box_sides: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        sides = np.array([(box.low, box.high) for box in self.boxes]).reshape(-1, 2, 3)
        object.__setattr__(self, "_box_sides", sides)

    def hides(self, origin: FloatArray, targets: FloatArray) -> BoolArray:
        """(N,) whether furniture stands between an origin (3,) and targets (N, 3)."""
        along = targets - origin
        along = np.where(np.abs(along) < 1e-12, 1e-12, along)[:, None, None, :]
        ends = (self._box_sides - origin) / along
        enter, leave = ends.min(axis=2).max(axis=-1), ends.max(axis=2).min(axis=-1)
        return ((enter < leave) & (leave > 0) & (enter < 1)).any(axis=1)


def layout_of(scene: RoomScene, cameras: Cameras, path: BallPath, *, seed: int) -> RoomLayout:
    """Lay a room out around its cameras and the spot's way; nothing stands in the way or before a lens."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x700]))
    way = path.points_in_world[np.isfinite(path.points_in_world).all(axis=1)]
    inside = np.vstack([cameras.centres_in_world, way])
    low, high = inside.min(axis=0) - MARGIN_M, inside.max(axis=0) + MARGIN_M
    low[2], high[2] = 0.0, max(high[2], MIN_CEILING_M)
    hanging = _Hanging(low, high, rng)
    windows = tuple(hanging.rect(2.0, (0.95, 2.15)) for _ in range(scene.n_windows))
    screens = tuple(hanging.rect(1.1, (0.9, 1.55)) for _ in range(scene.n_screens))
    lamps = tuple(hanging.lamp() for _ in range(scene.n_lamps))
    posters = tuple(hanging.rect(0.7, (1.1, 1.95)) for _ in range(6))
    indicators = np.array([hanging.point(0.4) for _ in range(scene.n_indicators)]).reshape(-1, 3)
    boxes = tuple(box for box in _furniture(low, high, rng) if _is_clear(box, inside))
    return RoomLayout(
        low, high, boxes, lamps, _panels(low, high), windows, screens, posters, indicators, int(rng.integers(1 << 31))
    )


class _Hanging:
    """Hangs things on the walls in turn, each where the wall is still free if a place is found."""

    def __init__(self, low: FloatArray, high: FloatArray, rng: np.random.Generator) -> None:
        self._low, self._high, self._rng = low, high, rng
        self._n_hung = 0
        self._taken: list[list[tuple[float, float]]] = [[] for _ in WALLS]

    def rect(self, width_m: float, up_m: tuple[float, float]) -> WallRect:
        """A rectangle on the next wall."""
        wall = self._n_hung % len(WALLS)
        self._n_hung += 1
        axis, is_high = WALLS[wall]
        other = 1 - axis
        low, high = self._low[other] + 0.3, self._high[other] - 0.3 - width_m
        start = low
        for _ in range(20):
            start = float(self._rng.uniform(low, max(high, low + 1e-3)))
            if all(start + width_m + 0.1 < a or start - 0.1 > b for a, b in self._taken[wall]):
                break
        self._taken[wall].append((start, start + width_m))
        return WallRect(axis, is_high, (start, start + width_m), up_m)

    def point(self, up_m: float, *, away_m: float = 0.02) -> FloatArray:
        """A point just before the next wall."""
        rect = self.rect(0.3, (up_m, up_m))
        out = np.empty(3)
        out[rect.axis] = self._high[rect.axis] - away_m if rect.is_high else self._low[rect.axis] + away_m
        out[1 - rect.axis], out[2] = sum(rect.across_m) / 2, up_m
        return out

    def lamp(self) -> Lamp:
        """A lamp before the next wall."""
        return Lamp(self.point(float(self._rng.uniform(1.3, 1.8)), away_m=0.15), float(self._rng.uniform(0.06, 0.11)))


def _panels(low: FloatArray, high: FloatArray) -> FloatArray:
    """Light panels under the ceiling, one about every 2.5 m each way."""
    n = np.maximum(1, np.rint((high[:2] - low[:2]) / 2.5)).astype(int)
    x, y = (low[axis] + (np.arange(n[axis]) + 0.5) / n[axis] * (high[axis] - low[axis]) for axis in (0, 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.column_stack([grid, np.full(len(grid), high[2] - 0.05)])


def _furniture(low: FloatArray, high: FloatArray, rng: np.random.Generator) -> list[Box]:
    """Cupboards, shelves, tables and boxes along the walls, one about every 1.6 m."""
    out: list[Box] = []
    for axis, is_high in WALLS:
        other = 1 - axis
        at = low[other] + float(rng.uniform(0.3, 0.8))
        while at < high[other] - 1.2:
            kind = int(rng.integers(0, 4))
            width, depth, height = ((0.9, 0.4, 1.9), (1.2, 0.35, 1.6), (1.4, 0.6, 0.75), (0.5, 0.45, 0.5))[kind]
            depth, height = depth * float(rng.uniform(0.8, 1.1)), height * float(rng.uniform(0.85, 1.1))
            corner, opposite = low.copy(), high.copy()
            corner[other], opposite[other] = at, at + width
            corner[axis], opposite[axis] = (
                (high[axis] - depth, high[axis]) if is_high else (low[axis], low[axis] + depth)
            )
            opposite[2] = height
            tone = rng.uniform(0.18, 0.55) * np.array([0.62, 0.8, 1.0]) ** rng.uniform(0.1, 1.6)
            style = (1, 2, 0, 0)[kind]
            out.append(Box(corner, opposite, style, (float(tone[0]), float(tone[1]), float(tone[2]))))
            at += width + float(rng.uniform(0.2, 1.6))
    return out


def _is_clear(box: Box, points: FloatArray) -> bool:
    """No point of the way and no camera in the box or within 15 cm of it."""
    gap = np.maximum(np.maximum(box.low - points, points - box.high), 0)
    return bool((np.linalg.norm(gap, axis=1) > 0.15).all())
