"""Patterns of floors, walls and furniture, drawn from a seed: reflectances by place."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from nodes.simulated.rendering.room_layout import Box

Float32Array = npt.NDArray[np.float32]
TILE = 512
PLANK_M = 0.14
PLANK_LENGTH_M = 1.3


@dataclass(frozen=True, slots=True)
class RoomTextures:
    """Tables that patterns are looked up in.

    Attributes:
        noise: (TILE, TILE) cloudy noise that repeats without a seam, mean 0, about -1..1.
        hashes: (4096,) uniform numbers 0..1, for whatever comes in pieces.
        wall_bgr: paint.
        floor_bgr: wood.
    """

    noise: Float32Array
    hashes: Float32Array
    wall_bgr: Float32Array
    floor_bgr: Float32Array

    @classmethod
    def of(cls, seed: int) -> RoomTextures:
        """Draw them."""
        rng = np.random.default_rng(np.random.SeedSequence([seed, 0x7E47]))
        noise = np.zeros((TILE, TILE), dtype=np.float32)
        for octave in range(2, 9):
            n = 1 << octave
            coarse = rng.standard_normal((n, n)).astype(np.float32)
            wrapped = np.pad(coarse, 2, mode="wrap")
            scale = TILE // n
            fine = cv2.resize(wrapped, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
            noise += fine[2 * scale : 2 * scale + TILE, 2 * scale : 2 * scale + TILE] * np.float32(1.6**-octave)
        hue = rng.uniform(0.9, 1.0, 3) * rng.uniform(0.6, 0.8)
        wood = rng.uniform(0.28, 0.42) * np.array([0.62, 0.8, 1.0])
        noise /= 2 * noise.std()
        return cls(noise, rng.random(4096, dtype=np.float32), hue.astype(np.float32), wood.astype(np.float32))

    def floor(self, place_m: Float32Array) -> Float32Array:
        """(N, 3) of planks at x, y (N, 2)."""
        plank = np.floor(place_m[:, 1] / PLANK_M).astype(np.int64)
        along = place_m[:, 0] + self._hash(plank) * PLANK_LENGTH_M
        piece = np.floor(along / PLANK_LENGTH_M).astype(np.int64)
        tone = 0.8 + 0.4 * self._hash(plank * 31 + piece * 7)
        grain = self._noise(place_m[:, 0] * 60 + 97 * plank, place_m[:, 1] * 900)
        edge = np.minimum(np.mod(place_m[:, 1], PLANK_M), np.mod(along, PLANK_LENGTH_M) + 0.002)
        joint = np.where(edge < 0.006, 0.55, 1.0)
        return ((tone * (1 + 0.15 * grain) * joint)[:, None] * self.floor_bgr).astype(np.float32)

    def ceiling(self, place_m: Float32Array) -> Float32Array:
        """(N, 3) of ceiling tiles at x, y (N, 2)."""
        edge = np.mod(place_m, 0.6).min(axis=1)
        tone = np.where(edge < 0.012, 0.6, 0.85 + 0.02 * self._noise(place_m[:, 0] * 200, place_m[:, 1] * 200))
        return np.repeat(tone[:, None], 3, axis=1).astype(np.float32)

    def wall(self, place_m: Float32Array) -> Float32Array:
        """(N, 3) of paint and a skirting board, by place across and up (N, 2)."""
        rough = 1 + 0.03 * self._noise(place_m[:, 0] * 40, place_m[:, 1] * 40)
        skirting = np.where(place_m[:, 1] < 0.09, 0.45, 1.0)
        return ((rough * skirting)[:, None] * self.wall_bgr).astype(np.float32)

    def poster(self, at: Float32Array, number: int) -> Float32Array:
        """(N, 3) of picture or print number n, by place on it (N, 2) 0..1."""
        if number % 2 == 0:
            cell = np.floor(at * np.array([5, 7])).astype(np.int64)
            key = 977 * number + cell[:, 0] * 13 + cell[:, 1] * 101
            out = np.stack([self._hash(3 * key + channel) for channel in range(3)], axis=1) * 0.8 + 0.05
        else:
            line = np.mod(at[:, 1] * 24, 1) < 0.55
            word = self._hash(np.floor(at[:, 0] * 30).astype(np.int64) + 57 * np.floor(at[:, 1] * 24).astype(np.int64))
            is_ink = line & (word > 0.25) & (np.abs(at[:, 0] - 0.5) < 0.42)
            out = np.repeat(np.where(is_ink, 0.1, 0.85)[:, None], 3, axis=1)
        is_frame = np.abs(at - 0.5).max(axis=1) > 0.47
        return np.where(is_frame[:, None], 0.06, out).astype(np.float32)

    def box(self, place_m: Float32Array, normal_axis: npt.NDArray[np.int8], box: Box) -> Float32Array:
        """(N, 3) of a piece of furniture at places (N, 3) on its sides."""
        across = np.where(normal_axis == 0, place_m[:, 1], place_m[:, 0])
        up = np.where(normal_axis == 2, place_m[:, 1], place_m[:, 2])
        tone = 1 + 0.12 * self._noise(across * 400, up * 50)
        gap = np.minimum(np.abs(place_m - box.low), np.abs(place_m - box.high))
        np.put_along_axis(gap, normal_axis[:, None].astype(np.int64), 9.0, axis=1)
        tone = np.where(gap.min(axis=1) < 0.018, 0.7 * tone, tone)
        is_side = normal_axis < 2
        if box.style == 1:
            drawer = np.mod(up - box.low[2], 0.38)
            tone = np.where(is_side & (drawer < 0.014), 0.35 * tone, tone)
            handle = (np.abs(drawer - 0.3) < 0.012) & (np.abs(np.mod(across, 0.45) - 0.22) < 0.06)
            tone = np.where(is_side & handle, 2.0, tone)
        out = tone[:, None] * np.array(box.bgr, dtype=np.float32)
        if box.style == 2:
            is_book = is_side & (gap.min(axis=1) > 0.03)
            out[is_book] = self._books(across[is_book], up[is_book])
        return np.clip(out, 0, 0.95).astype(np.float32)

    def _books(self, across_m: Float32Array, up_m: Float32Array) -> Float32Array:
        shelf, column = np.floor(up_m / 0.33).astype(np.int64), np.floor(across_m / 0.036).astype(np.int64)
        key = shelf * 173 + column
        height = 0.2 + 0.11 * self._hash(key * 5 + 1)
        colour = np.stack([self._hash(key * 7 + channel) for channel in range(3)], axis=1) * 0.5 + 0.04
        is_empty = (np.mod(up_m, 0.33) > height) | (np.mod(up_m, 0.33) < 0.02)
        return np.where(is_empty[:, None], 0.05, colour).astype(np.float32)

    def _hash(self, key: npt.NDArray[np.int64]) -> Float32Array:
        return self.hashes[(key * 2654435761 >> 7) & 4095]

    def _noise(self, x: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> Float32Array:
        return self.noise[np.floor(y).astype(np.int64) % TILE, np.floor(x).astype(np.int64) % TILE]
