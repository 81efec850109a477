"""The room as one chip sees it at any instant: still layers, and the moving things drawn where they are."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from nodes.simulated.rendering.camera_view import CameraView
from nodes.simulated.rendering.person import PersonPatch, Shadow
from nodes.simulated.rendering.room_background import Screen, background_of, blurred
from nodes.simulated.rendering.room_layout import RoomLayout
from nodes.simulated.rendering.room_scene import RoomScene
from nodes.simulated.rendering.sensor import SensorModel, add_light, bloom, on_mosaic, surplus_of
from nodes.simulated.rendering.spot_image import Beams, Patch, SpotColour, patch_of

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
# A screen's picture changes so often; between, it moves sideways and flickers.
SCREEN_CUT_S = 0.8
SCREEN_CELLS = (9, 16)
INDICATOR_RADIUS_M = 0.003
INDICATOR_RADIANCE = 12.0
INDICATOR_PERIOD_S = 1.7
SHADOW_DEPTH = 0.45
# What is dimmer than this part of full scale does not widen the rectangle in which a layer is drawn.
DIM = 2e-4


@dataclass(frozen=True, slots=True)
class _Layer:
    """Light in a rectangle of the chip: values (h, w) from column x, row y."""

    x: int
    y: int
    values: Float32Array

    def add_to(self, plane: Float32Array, factor: float) -> None:
        height, width = self.values.shape
        plane[self.y : self.y + height, self.x : self.x + width] += np.float32(factor) * self.values

    def around(self, x: int, y: int, shape: tuple[int, ...]) -> Float32Array:
        """The layer's light in a rectangle of this shape from column x, row y of the chip."""
        out = np.zeros(shape, dtype=np.float32)
        for row in range(shape[0]):
            for column in range(shape[1]):
                place = y + row - self.y, x + column - self.x
                if 0 <= place[0] < self.values.shape[0] and 0 <= place[1] < self.values.shape[1]:
                    out[row, column] = self.values[place]
        return out


@dataclass(frozen=True, slots=True)
class _LitScreen:
    """A screen's pixels on the chip, and which colour each sees (-1: the mean)."""

    screen: Screen
    colour: npt.NDArray[np.int64]


class RoomView:
    """The still layers of one camera, ready to be summed: levels (h, w) on its chip."""

    def __init__(
        self, view: CameraView, scene: RoomScene, sensor: SensorModel, layout: RoomLayout, *, seed: int
    ) -> None:
        self._view, self._scene, self._sensor, self._seed = view, scene, sensor, seed
        background = background_of(view, scene, layout)
        lit = self._on_chip(background.lit)
        self._with_switch = self._finished(lit + self._on_chip(background.switched))
        self._without_switch = self._finished(lit)
        self._windows = None
        if scene.n_windows:
            # The charge that windows let run over belongs to their layer, and drifts with them.
            windows = self._finished(lit + self._on_chip(background.windows)) - self._without_switch
            self._windows = _cropped(windows)
        self._screens = tuple(self._lit_screen(screen) for screen in background.screens)
        self._indicators = self._drawn_indicators(layout)
        self._range_m = background.range_m

    def draw(self, time_s: float, plane: Float32Array) -> None:
        """Fill a plane (h, w) with the empty room at an instant."""
        scene = self._scene
        np.multiply(self._still(time_s), np.float32(scene.flicker_at(time_s)), out=plane)
        if self._windows is not None:
            self._windows.add_to(plane, scene.window_at(time_s))
        for number, lit in enumerate(self._screens):
            self._draw_screen(plane, lit, number, time_s)
        for number, patch in enumerate(self._indicators):
            if (time_s / INDICATOR_PERIOD_S + 0.37 * number) % 1 < 0.5:
                self.add(plane, patch, SpotColour.RED.bgr)

    def level_at(self, px: FloatArray, time_s: float) -> float:
        """Highest level of the still room and its windows at a pixel (2,) and its neighbours; 0 outside."""
        if not self._view.is_in_image(px):
            return 0.0
        x, y = (int(place) for place in np.rint(px))
        left, top = max(x - 1, 0), max(y - 1, 0)
        around = self._still(time_s)[top : y + 2, left : x + 2] * np.float32(self._scene.flicker_at(time_s))
        if self._windows is not None:
            around = around + self._scene.window_at(time_s) * self._windows.around(left, top, around.shape)
        return float(around.max())

    def _still(self, time_s: float) -> Float32Array:
        return self._with_switch if self._scene.is_switched_on(time_s) else self._without_switch

    def add(self, plane: Float32Array, patch: Patch, bgr: tuple[float, float, float]) -> None:
        """Add a patch of coloured light to the plane; with a streak in its columns where the chip makes one."""
        mosaic, values = self._sensor.mosaic, patch.values.astype(np.float32)
        add_light(plane, values, bgr=bgr, mosaic=mosaic, x=patch.x, y=patch.y)
        if self._sensor.streak > 0:
            columns = np.float32(self._sensor.streak * max(bgr)) * values.sum(axis=0)
            plane[:, patch.x : patch.x + values.shape[1]] += columns

    def draw_shadow(self, plane: Float32Array, shadow: Shadow) -> None:
        """Take light from the floor around the feet."""
        height, width = shadow.dark.shape
        target = plane[shadow.y : shadow.y + height, shadow.x : shadow.x + width]
        target *= 1 - np.float32(SHADOW_DEPTH / 255) * shadow.dark

    def draw_person(self, plane: Float32Array, patch: PersonPatch, time_s: float) -> None:
        """Draw the person over the plane, behind what is nearer than they are."""
        height, width = patch.cover.shape
        rows, columns = slice(patch.y, patch.y + height), slice(patch.x, patch.x + width)
        cover = patch.cover.astype(np.float32) * np.float32(1 / 255)
        cover *= self._range_m[rows, columns] > patch.range_m - 0.3
        # Limbs look round when their middle is lighter than their rim.
        shade = 0.55 + 0.45 * cv2.blur(cover, (15, 15))
        light = self._scene.light_at(time_s) * self._sensor.brightness / 255
        person = on_mosaic(patch.bgr.astype(np.float32), self._sensor.mosaic, x=patch.x, y=patch.y)
        person *= np.float32(light) * shade
        target = plane[rows, columns]
        person -= target
        person *= cover
        target += person

    def _on_chip(self, layer: Float32Array) -> Float32Array:
        sensor = self._sensor
        if not layer.any():
            return np.zeros(layer.shape[:2], dtype=np.float32)
        soft = blurred(
            layer, sigma_px=sensor.psf_sigma_px, glare_part=sensor.glare_part, glare_sigma_px=sensor.glare_sigma_px
        )
        return on_mosaic(soft, sensor.mosaic) * np.float32(sensor.brightness)

    def _finished(self, still: Float32Array) -> Float32Array:
        out = still + np.float32(self._sensor.streak) * still.sum(axis=0)
        bloom(out, np.float32(self._sensor.blooming) * surplus_of(out))
        return out

    def _lit_screen(self, screen: Screen) -> _LitScreen:
        mosaic = self._sensor.mosaic
        if mosaic is None:
            return _LitScreen(screen, np.full(len(screen.row), -1))
        return _LitScreen(screen, np.array(mosaic)[2 * (screen.row % 2) + screen.column % 2])

    def _draw_screen(self, plane: Float32Array, lit: _LitScreen, number: int, time_s: float) -> None:
        """Coloured cells that move sideways, change now and then, and beat with the exposure."""
        cut = int(time_s // SCREEN_CUT_S)
        rng = np.random.default_rng(np.random.SeedSequence([self._seed, 0x5C, number, max(cut, 0)]))
        cells = rng.random((*SCREEN_CELLS, 3), dtype=np.float32) ** 2
        n_rows, n_columns = SCREEN_CELLS
        moved = lit.screen.place[:, 0] + np.float32(0.15 * time_s)
        column = (moved * n_columns).astype(np.int64) % n_columns
        row = np.minimum((lit.screen.place[:, 1] * n_rows).astype(np.int64), n_rows - 1)
        is_mono = self._sensor.mosaic is None
        values = cells.mean(axis=2)[row, column] if is_mono else cells[row, column, lit.colour]
        beat = 0.85 + 0.15 * np.sin(2 * np.pi * 3.7 * time_s)
        level = self._scene.screen_radiance * self._sensor.brightness * beat
        plane[lit.screen.row, lit.screen.column] += np.float32(level) * values

    def _drawn_indicators(self, layout: RoomLayout) -> tuple[Patch, ...]:
        """Patches of the indicator lamps that this camera sees."""
        out: list[Patch] = []
        for place in layout.indicators:
            px, is_seen = self._view.project(place)
            if not is_seen or layout.hides(self._view.centre_in_world, place[None])[0]:
                continue
            distance_m = float(np.linalg.norm(place - self._view.centre_in_world))
            radius_px = self._view.focal_px * INDICATOR_RADIUS_M / distance_m
            weight = INDICATOR_RADIANCE * self._sensor.brightness * np.pi * radius_px**2
            beam = Beams(px[None], np.array([weight]), radius_px / 2)
            patch = patch_of(beam, sigma_px=self._sensor.psf_sigma_px, size_px=self._view.size_px)
            out += [patch] if patch is not None else []
        return tuple(out)


def _cropped(layer: Float32Array) -> _Layer | None:
    """The rectangle of a layer that holds its light; None when it has none."""
    rows, columns = np.flatnonzero((layer > DIM).any(axis=1)), np.flatnonzero((layer > DIM).any(axis=0))
    if len(rows) == 0:
        return None
    return _Layer(int(columns[0]), int(rows[0]), layer[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].copy())
