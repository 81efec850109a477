"""The room without the spot and the person, as one camera sees it: rays cast once, kept as layers of light.

The layers are linear light (levels at the reference exposure), so that a switched lamp or a drifting window is a sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from nodes.simulated.rendering.camera_view import CameraView
from nodes.simulated.rendering.room_layout import WALLS, RoomLayout, WallRect
from nodes.simulated.rendering.room_scene import RoomScene
from nodes.simulated.rendering.room_texture import RoomTextures

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
DAYLIGHT_BGR = np.array([1.08, 1.0, 0.93], dtype=np.float32)
LAMP_BGR = np.array([0.72, 0.9, 1.0], dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Screen:
    """The pixels of one camera that show a screen.

    Attributes:
        row: (N,) image rows.
        column: (N,) image columns.
        place: (N, 2) across and up the screen, 0..1.
    """

    row: IntArray
    column: IntArray
    place: Float32Array


@dataclass(frozen=True, slots=True)
class Background:
    """Layers of one camera, (h, w, 3) blue, green, red.

    Attributes:
        lit: room in its own light, with lamps; no windows.
        switched: what the switched light adds.
        windows: the windows' own light, at the mean of their drift.
        range_m: (h, w) distance along each ray to the first thing.
        screens: where screens are seen.
    """

    lit: Float32Array
    switched: Float32Array
    windows: Float32Array
    range_m: Float32Array
    screens: tuple[Screen, ...]


@dataclass(slots=True)
class _Hits:
    """What N rays meet first. Vectors have their three coordinates first, (3, N): sums over them are then fast.

    Attributes:
        place: (3, N) m.
        range_m: (N,).
        normal_axis: (N,) 0 x, 1 y, 2 z.
        is_high: (N,) the side that was met looks towards the low end of that axis.
        thing: (N,) -1 the room itself, else the index of a box; -2 a lamp.
    """

    place: Float32Array
    range_m: Float32Array
    normal_axis: npt.NDArray[np.int8]
    is_high: BoolArray
    thing: npt.NDArray[np.int16]

    def on_room(self, axis: int, *, is_high: bool) -> IntArray:
        """Indices of the rays that end on one of the room's six sides."""
        return np.flatnonzero((self.thing == -1) & (self.normal_axis == axis) & (self.is_high == is_high))


def background_of(view: CameraView, scene: RoomScene, layout: RoomLayout) -> Background:
    """Cast the rays of all pixels into the room."""
    width, height = view.size_px
    if scene.is_void:
        black = np.zeros((height, width, 3), dtype=np.float32)
        return Background(black, black, black, np.full((height, width), np.inf, dtype=np.float32), ())
    rays = np.ascontiguousarray(view.rays_in_world().reshape(-1, 3).T)
    caster = _Caster(scene, layout, RoomTextures.of(layout.texture_seed))
    hits = caster.meet(view.centre_in_world.astype(np.float32)[:, None], rays)
    layers = caster.light(hits)
    _mirror_on_floor(caster, rays, hits, layers)
    is_blind = ~rays.any(axis=0)
    for layer in layers:
        layer[is_blind] = 0
    lit, switched, windows = (layer.reshape(height, width, 3) for layer in layers)
    screens = []
    for rect in layout.screens:
        pixel, at = _on_rect(rect, hits)
        screens += [Screen(pixel // width, pixel % width, at)] if len(pixel) else []
    return Background(lit, switched, windows, hits.range_m.reshape(height, width), tuple(screens))


def _mirror_on_floor(
    caster: _Caster, rays: Float32Array, hits: _Hits, layers: tuple[Float32Array, Float32Array, Float32Array]
) -> None:
    """Add to the layers (N, 3), in place, what a glossy floor mirrors of the rays (3, N)."""
    if caster.scene.gloss == 0:
        return
    floor = hits.on_room(2, is_high=False)
    up = rays[:, floor] * np.array([[1], [1], [-1]], dtype=np.float32)
    part = mirrored_part(caster.scene.gloss, up[2])[:, None].astype(np.float32)
    for layer, mirrored in zip(layers, caster.light(caster.meet(hits.place[:, floor], up)), strict=True):
        layer[floor] += part * mirrored


def mirrored_part(gloss: float, cosine: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Part of light that the floor mirrors, by the cosine to its normal: Schlick's approximation."""
    return gloss + (1 - gloss) * (1 - np.clip(cosine, 0, 1)) ** 5 if gloss > 0 else np.zeros_like(cosine)


class _Caster:
    """Meets rays with the room and lights what they meet."""

    def __init__(self, scene: RoomScene, layout: RoomLayout, textures: RoomTextures) -> None:
        self.scene = scene
        self._layout = layout
        self._textures = textures

    def meet(self, origin: Float32Array, rays: Float32Array) -> _Hits:
        """The first thing on each ray (3, N); origins (3, N) or (3, 1) are inside the room."""
        low, high = (side.astype(np.float32)[:, None] for side in (self._layout.low, self._layout.high))
        safe = np.where(np.abs(rays) < 1e-7, np.float32(1e-7), rays)
        ahead = (np.where(safe > 0, high, low) - origin) / safe
        axis = np.argmin(ahead, axis=0).astype(np.int8)
        range_m, thing = ahead.min(axis=0), np.full(rays.shape[1], -1, dtype=np.int16)
        for index, box in enumerate(self._layout.boxes):
            one = (box.low.astype(np.float32)[:, None] - origin) / safe
            two = (box.high.astype(np.float32)[:, None] - origin) / safe
            enter, leave = np.minimum(one, two), np.maximum(one, two).min(axis=0)
            nearest = enter.max(axis=0)
            met = np.flatnonzero((nearest < leave) & (nearest > 1e-3) & (nearest < range_m))
            range_m[met], thing[met], axis[met] = nearest[met], index, np.argmax(enter[:, met], axis=0)
        for lamp in self._layout.lamps:
            offset = lamp.centre.astype(np.float32)[:, None] - origin
            along = (offset * rays).sum(axis=0)
            aside2 = (offset * offset).sum(axis=0) - along * along
            met = np.flatnonzero((aside2 < lamp.radius_m**2) & (along > 0) & (along < range_m))
            range_m[met], thing[met] = along[met] - np.sqrt(np.float32(lamp.radius_m**2) - aside2[met]), -2
        is_high = np.take_along_axis(rays, axis[None].astype(np.int64), axis=0)[0] > 0
        return _Hits(origin + range_m * rays, range_m, axis, is_high, thing)

    def light(self, hits: _Hits) -> tuple[Float32Array, Float32Array, Float32Array]:
        """(N, 3) light from what was met: in the room's light, what the switched light adds, and windows."""
        scene, albedo = self.scene, self._albedo(hits)
        shade = self._corner_shade(hits)
        lit = albedo * (self._irradiance(hits) * (np.float32(scene.light) * shade)).T
        switched = albedo * (np.float32(scene.switched_light) * shade * self._floodlight(hits))[:, None]
        is_lamp = hits.thing == -2
        lit[is_lamp], switched[is_lamp] = LAMP_BGR * np.float32(scene.lamp_radiance), 0
        windows = np.zeros_like(lit)
        for rect in self._layout.windows:
            pixel, at = _on_rect(rect, hits)
            # A cross in the frame, and a sky that is brighter above.
            is_frame = (np.abs(at[:, 0] - 0.5) < 0.02) | (np.abs(at[:, 1] - 0.62) < 0.02)
            is_frame |= (at.min(axis=1) < 0.03) | (at.max(axis=1) > 0.97)
            sky = np.where(is_frame[:, None], 0.0, (0.75 + 0.5 * at[:, 1:]) * DAYLIGHT_BGR)
            windows[pixel] = np.float32(scene.window_radiance) * sky.astype(np.float32)
        return (
            lit.astype(np.float32, copy=False),
            switched.astype(np.float32, copy=False),
            windows.astype(np.float32, copy=False),
        )

    def _albedo(self, hits: _Hits) -> Float32Array:
        """(N, 3) reflectances."""
        out = np.zeros((hits.place.shape[1], 3), dtype=np.float32)
        textures, layout = self._textures, self._layout
        floor, ceiling = hits.on_room(2, is_high=False), hits.on_room(2, is_high=True)
        out[floor] = textures.floor(hits.place[:2, floor].T)
        out[ceiling] = textures.ceiling(hits.place[:2, ceiling].T)
        for axis, is_high in WALLS:
            wall = hits.on_room(axis, is_high=is_high)
            out[wall] = textures.wall(hits.place[:, wall][[1 - axis, 2]].T)
        for number, rect in enumerate(layout.posters):
            pixel, at = _on_rect(rect, hits)
            out[pixel] = textures.poster(at, number)
        for rect in (*layout.screens, *layout.windows):
            out[_on_rect(rect, hits)[0]] = 0.04
        for index, box in enumerate(layout.boxes):
            side = np.flatnonzero(hits.thing == index)
            out[side] = textures.box(hits.place[:, side].T, hits.normal_axis[side], box)
        return out

    def _irradiance(self, hits: _Hits) -> Float32Array:
        """(3, N) the room's light, about 1 in the mean: even light, lamps, windows."""
        layout = self._layout
        out = np.full(hits.place.shape, 0.6, dtype=np.float32)
        for panel in layout.panels:
            out += 0.9 * _from_point(hits, panel, 1.2)
        for lamp in layout.lamps:
            out += LAMP_BGR[:, None] * (0.5 * _from_point(hits, lamp.centre, 0.3))
        for rect in layout.windows:
            out += DAYLIGHT_BGR[:, None] * (1.2 * _from_point(hits, rect.centre(layout.low, layout.high), 1.0))
        return out

    def _floodlight(self, hits: _Hits) -> Float32Array:
        """(N,) the switched light: a lamp under one end of the ceiling."""
        low, high = self._layout.low, self._layout.high
        offset = hits.place - (low + np.array([0.25, 0.7, 0.92]) * (high - low)).astype(np.float32)[:, None]
        return 0.5 + 1.5 / (1 + 0.4 * (offset * offset).sum(axis=0))

    def _corner_shade(self, hits: _Hits) -> Float32Array:
        """(N,) less light near the room's edges and on the floor beside furniture."""
        low, high = (side.astype(np.float32)[:, None] for side in (self._layout.low, self._layout.high))
        to_wall = np.minimum(hits.place - low, high - hits.place)
        np.put_along_axis(to_wall, hits.normal_axis[None].astype(np.int64), 9.0, axis=0)
        shade = 1 - np.float32(0.35) * np.exp(to_wall.min(axis=0).clip(0) / np.float32(-0.25))
        floor = hits.on_room(2, is_high=False)
        place = hits.place[:, floor]
        for box in self._layout.boxes:
            box_low, box_high = box.low.astype(np.float32)[:, None], box.high.astype(np.float32)[:, None]
            gap = np.maximum(np.maximum(box_low - place, place - box_high), 0)
            shade[floor] *= 1 - np.float32(0.5) * np.exp(np.hypot(gap[0], gap[1]) / np.float32(-0.12))
        return shade


def _from_point(hits: _Hits, source: FloatArray, size_m: float) -> Float32Array:
    """(N,) light of a source of this size on surfaces that may face it."""
    to_source = source.astype(np.float32)[:, None] - hits.place
    distance2 = (to_source * to_source).sum(axis=0)
    across = np.take_along_axis(to_source, hits.normal_axis[None].astype(np.int64), axis=0)[0]
    facing = np.maximum(np.where(hits.is_high, -across, across), 0)
    return facing / (np.sqrt(distance2 + np.float32(1e-6)) * (distance2 + np.float32(size_m**2)))


def _on_rect(rect: WallRect, hits: _Hits) -> tuple[IntArray, Float32Array]:
    """Indices of the M rays that end on a wall's rectangle, and where on it (M, 2): across and up, 0..1."""
    wall = hits.on_room(rect.axis, is_high=rect.is_high)
    at = hits.place[:, wall][[1 - rect.axis, 2]].T
    low = np.array([rect.across_m[0], rect.up_m[0]], dtype=np.float32)
    at = (at - low) / np.maximum(np.array([rect.across_m[1], rect.up_m[1]], dtype=np.float32) - low, 1e-6)
    inside = (at[:, 0] > 0) & (at[:, 0] < 1) & (at[:, 1] > 0) & (at[:, 1] < 1)
    return wall[inside], at[inside].astype(np.float32)


def blurred(layer: Float32Array, *, sigma_px: float, glare_part: float, glare_sigma_px: float) -> Float32Array:
    """A layer through the lens: its blur, and the skirt of scattered light around bright things."""
    sharp = cv2.GaussianBlur(layer, (0, 0), sigma_px)
    if glare_part == 0:
        return sharp  # pyright: ignore[reportReturnType] - cv2 states any dtype
    wide = cv2.GaussianBlur(layer, (0, 0), glare_sigma_px)
    return cv2.addWeighted(sharp, 1 - glare_part, wide, glare_part, 0.0)  # pyright: ignore[reportReturnType]
