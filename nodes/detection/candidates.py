"""Compact bright changes against the learnt background: where the spot may be, and how like a spot each place is.

A candidate is judged by its core, which is what is connected with its peak above half of its height over the
surroundings. A person, a door or a cloud has no compact core; a spot carried by a person has.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from nodes.detection.background import Background, Box, Float32Array, Survey
from nodes.detection.channel import Plane, SampleArray
from nodes.detection.peaks import PeakFinder
from nodes.detection.silhouettes import silhouette_peaks
from nodes.detection.spots import BoolArray, FloatArray

# Windows looked into in one frame: neither crowds nor rain make a frame last longer.
MAX_PEAKS = 24
MAX_HIDDEN_PEAKS = 12
# Nearly all spots fit into the first window with their surroundings; others are looked at in larger ones.
FIRST_HALF_PX = 12
LARGER = 3
# A smear may be so many times longer than a still spot may be wide.
MAX_STRETCH = 2.5
HALF_HEIGHT = 0.5
# A streak that a saturated spot draws along its column may be brighter than half of the spot.
STREAK_HEIGHT = 0.8
# Quartiles of a normal distribution are this far apart, inverted.
SIGMA_OVER_QUARTILES = 1 / 1.349
# A candidate with this light over its noise has half of the full score.
HALF_SNR = 12.0
# Surroundings whose structure is this share of the height halve the score.
HALF_TEXTURE = 0.25
# No lens is so sharp that less than this part of the brightest sample falls on those beside it: that is noise.
MIN_NEIGHBOURS = 0.3
MIN_FACTOR = 0.02
# A candidate of this share of the largest radius has half of the score: most spots are smaller.
HALF_RADIUS = 0.5
HEIGHT_POWER = 0.5
SNR_POWER = 0.25


@dataclass(frozen=True, slots=True)
class Candidate:
    """A compact bright change; lengths and positions in samples of the plane.

    Attributes:
        px: (2,) centre of the core: x, y.
        box: of the core: left, top, right, bottom; right and bottom are outside.
        radius: half the extent of the core across its longest direction; the radius of a disc.
        length: half the extent along it.
        height: of the brightest sample over the surroundings, in samples.
        flux: sum over the surroundings within the core, in samples.
        snr: flux over its noise.
        score: 0..1, by itself: its light over noise and surroundings, and its shape.
    """

    px: FloatArray
    box: Box
    radius: float
    length: float
    height: float
    flux: float
    snr: float
    score: float

    @property
    def standing(self) -> float:
        """For comparing candidates of one frame: a spot in full light is high and stands far out of the noise.

        Its reflection is many times lower; what is on a screen is noisy, as its noise is that of all its pictures.
        """
        return self.score * self.height**HEIGHT_POWER * self.snr**SNR_POWER


class CandidateFinder:
    """Finds candidates in planes of one shape; holds the memory for it."""

    def __init__(self, plane: Plane, *, max_radius: float) -> None:
        """Begin; all planes will be like `plane`; `max_radius` of a core is in samples."""
        self._max_radius = max_radius
        self._peaks = PeakFinder(plane, max_width=2 * max_radius)

    def find(self, plane: Plane, background: Background, survey: Survey) -> list[Candidate]:
        """All compact bright changes of a frame, best first; `survey` is that of the frame."""
        found: list[Candidate] = []
        for x, y in self._all_peaks(plane, background, survey):
            if any(_is_inside(x, y, one.box) for one in found):
                continue
            candidate = _look(plane.samples, background, (x, y), self._max_radius)
            if candidate is not None and not any(
                _is_inside(candidate.px[0], candidate.px[1], one.box) for one in found
            ):
                found.append(candidate)
        return sorted(found, key=lambda one: -one.standing)

    def _all_peaks(self, plane: Plane, background: Background, survey: Survey) -> Iterator[tuple[int, int]]:
        """Peaks over the learnt threshold, then peaks in silhouettes."""
        yield from itertools.islice(self._peaks.peaks(plane, background.packed_threshold), MAX_PEAKS)
        hidden = silhouette_peaks(plane.samples, background, survey.is_darker, max_width=2 * self._max_radius)
        yield from itertools.islice(hidden, MAX_HIDDEN_PEAKS)


def _is_inside(x: float, y: float, box: Box) -> bool:
    return box[0] <= x < box[2] and box[1] <= y < box[3]


def _look(samples: SampleArray, background: Background, peak: tuple[int, int], max_radius: float) -> Candidate | None:
    """Judge a peak in a window that holds its core and as much around; None: no spot."""
    half, largest = FIRST_HALF_PX, math.ceil(1.2 * MAX_STRETCH * max_radius)
    while True:
        window = _window(samples, background, peak, half)
        if window.height <= window.noise:
            return None
        core = _core(window, HALF_HEIGHT)
        if core.is_streak:
            core = _core(window, STREAK_HEIGHT)
        is_last = half >= largest
        if not core.is_cut and (is_last or core.extent <= half):
            return _judged(window, core, max_radius)
        if is_last:
            return None
        half = min(LARGER * half, largest)


@dataclass(frozen=True, slots=True)
class _Window:
    """Light (h, w) over the background around a peak, and what the sides of the window say about the surroundings."""

    light: Float32Array
    left: int
    top: int
    is_border: tuple[bool, bool, bool, bool]  # left, top, right, bottom are those of the image
    peak: tuple[int, int]
    noise: float
    level: float
    texture: float

    @property
    def height(self) -> float:
        return float(self.light[self.peak[1], self.peak[0]]) - self.level


def _window(samples: SampleArray, background: Background, peak: tuple[int, int], half: int) -> _Window:
    (x, y), (rows, columns) = peak, samples.shape
    left, top, right, bottom = x - half, y - half, x + half + 1, y + half + 1
    is_border = left < 0, top < 0, right > columns, bottom > rows
    left, top = max(left, 0), max(top, 0)
    part = slice(top, bottom), slice(left, right)
    light = samples[part] - background.mean[part]
    sides = light[:, 0], light[0], light[:, -1], light[-1]
    around = np.sort(np.concatenate([side for side, outside in zip(sides, is_border, strict=True) if not outside]))
    quarter = len(around) // 4
    level = float(around[2 * quarter])
    texture = float(around[3 * quarter] - around[quarter]) * SIGMA_OVER_QUARTILES
    noise = float(background.spread[y, x])
    return _Window(light, left, top, is_border, (x - left, y - top), noise, level, texture)


@dataclass(frozen=True, slots=True)
class _Core:
    """Samples connected with the peak above a share of its height.

    Attributes:
        is_high: (h, w) of the box.
        box: left, top, right, bottom in the window.
        is_cut: it reaches a side of the window that is not the border of the image.
        is_streak: it is cut at top and bottom alone.
    """

    is_high: BoolArray
    box: Box
    is_cut: bool
    is_streak: bool

    @property
    def extent(self) -> int:
        return max(self.box[2] - self.box[0], self.box[3] - self.box[1])


def _core(window: _Window, share: float) -> _Core:
    x, y = window.peak
    is_high = (window.light >= window.level + share * window.height).view(np.uint8)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(is_high, connectivity=8, ltype=cv2.CV_16U)
    label = labels[y, x]
    left, top, width, height = boxes[label, :4].tolist()
    right, bottom = left + width, top + height
    rows, columns = window.light.shape
    reaches = left == 0, top == 0, right == columns, bottom == rows
    cut = [reached and not outside for reached, outside in zip(reaches, window.is_border, strict=True)]
    return _Core(
        labels[top:bottom, left:right] == label,
        (left, top, right, bottom),
        is_cut=any(cut),
        is_streak=(cut[1] or cut[3]) and not (cut[0] or cut[2]) and width < height,
    )


def _judged(window: _Window, core: _Core, max_radius: float) -> Candidate | None:
    left, top, right, bottom = core.box
    light = window.light[top:bottom, left:right][core.is_high]
    centre, radius, length = _shape(core.is_high)
    flux = float(light.sum()) - len(light) * window.level
    snr = flux / (window.noise * math.sqrt(len(light)))
    if radius > max_radius or length > MAX_STRETCH * max_radius:
        return None
    corner = window.left + left, window.top + top
    filled = min(len(light) / (math.pi * radius * length), 1.0)
    texture = max(window.texture - window.noise, 0.0)
    alone = window.height / (window.height + max(window.level, 0.0) + texture / HALF_TEXTURE)
    spread_out = min(_neighbours(window) / (MIN_NEIGHBOURS * window.height), 1.0)
    small = 1 / (1 + (radius / (HALF_RADIUS * max_radius)) ** 2)
    shape = filled**2 * math.sqrt(radius / length) * small
    return Candidate(
        px=centre + corner,
        box=(corner[0], corner[1], window.left + right, window.top + bottom),
        radius=radius,
        length=length,
        height=window.height,
        flux=flux,
        snr=snr,
        score=snr / (snr + HALF_SNR) * alone * max(spread_out, MIN_FACTOR) * shape,
    )


def _neighbours(window: _Window) -> float:
    """Mean light of the four samples beside the peak, over the surroundings."""
    x, y = window.peak
    rows, columns = window.light.shape
    beside = [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)]
    light = [float(window.light[v, u]) for u, v in beside if 0 <= u < columns and 0 <= v < rows]
    return sum(light) / len(light) - window.level


def _shape(is_high: BoolArray) -> tuple[FloatArray, float, float]:
    """Centre, and half extents across and along of the ellipse that has the second moments of these samples."""
    moments = cv2.moments(is_high.view(np.uint8), binaryImage=True)
    area = moments["m00"]
    # A sample is a square: it has a variance of its own.
    xx, yy, xy = moments["mu20"] / area + 1 / 12, moments["mu02"] / area + 1 / 12, moments["mu11"] / area
    middle, reach = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    centre = np.array([moments["m10"], moments["m01"]]) / area
    return centre, 2 * math.sqrt(max(middle - reach, 0.0)), 2 * math.sqrt(middle + reach)
