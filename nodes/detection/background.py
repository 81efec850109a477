"""What one channel looks like without the spot: mean, spread and recent maximum of every sample, in constant memory.

A spot must exceed both the mean by many spreads and all that was seen there lately: the maximum over a window of time
covers screens and lamps that flicker. Watching costs little, because only one stripe of rows learns in each frame.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from nodes.detection.channel import SampleArray
from nodes.detection.spots import BoolArray, Channel

Float32Array = npt.NDArray[np.float32]

# Of a normal distribution, 2e-8 lies above: one sample in twenty frames of 1080p, and one sample alone is no spot.
MEAN_SPREADS = 5.5
# The window's maximum has seen some of the noise already.
MAXIMUM_SPREADS = 2.0
# Steps of 8 bits that the codec's and the sensor's quantisation may add to anything.
MARGIN_STEPS = 1.5
# A spread below the half of a step of 8 bits was learnt from a coder that left blocks unchanged.
MIN_SPREAD_STEPS = 0.5
NEIGHBOURHOOD = 9
STRIPE_ROWS = 16
FRAMES_A_STRIPE = 2
HURRIED_STRIPES = 6
# A visit moves the mean by this share of what is new; 1080 rows, a stripe in every second frame, are visited in 5 s: a
# time constant of some 20 s.
RATE = 1 / 4
# The spread needs more samples to be as certain.
SPREAD_RATE = 1 / 2
NOISE_SPREADS = 6.0
# The maximum is that of the last 4 to 8 visits.
WINDOW_VISITS = 4
# One sample in 16 x 16 tells whether the light has changed, and where somebody stands. One row of them to a stripe.
GRID_STEP = STRIPE_ROWS
# Mean absolute deviation of a normal distribution to its standard deviation.
SIGMA_OVER_DEVIATION = float(np.sqrt(np.pi / 2))

# Left, top, right, bottom of samples that must not be learnt; right and bottom are outside.
Box = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class Survey:
    """A frame beside what is expected, on a grid of one sample in each `GRID_STEP` x `GRID_STEP`, at its middle.

    Attributes:
        changed_share: share 0..1 of the grid that is brighter or darker than anything expected there.
        is_darker: (rows, columns) of the grid.
    """

    changed_share: float
    is_darker: BoolArray


class Background:
    """The learnt scene of one channel.

    Attributes:
        channel: what was learnt.
        full_scale: the sample of a saturated pixel.
        mean: (h, w) float32, in samples.
        spread: (h, w) float32, standard deviation, in samples.
        packed_threshold: (h, w n) as `Plane.packed`.
    """

    def __init__(
        self,
        channel: Channel,
        *,
        mean: Float32Array,
        spread: Float32Array,
        maximum: SampleArray,
        full_scale: float,
        lane: int = 0,
        n_lanes: int = 1,
    ) -> None:
        self.channel = channel
        self.full_scale = full_scale
        self.mean = mean
        self.spread = spread
        height, width = maximum.shape
        # Out of reach in other channels.
        self.packed_threshold = np.full_like(maximum, np.iinfo(maximum.dtype).max, shape=(height, width * n_lanes))
        self._lane, self._n_lanes = lane, n_lanes
        self._maxima = np.stack([maximum, maximum])
        self._is_hidden: BoolArray | None = None
        self._next_row = self._n_rounds = self._wait = 0
        shape = maximum[GRID_STEP // 2 :: GRID_STEP, GRID_STEP // 2 :: GRID_STEP].shape
        self._grid_low = np.zeros_like(maximum, shape=shape)
        self._grid_high = np.zeros_like(maximum, shape=shape)
        self.watch_only(None)

    @property
    def step(self) -> float:
        """A step of 8 bits, in samples."""
        return self.full_scale / 255

    @property
    def threshold(self) -> SampleArray:
        """(h, w) of the samples' type: a sample above it is new."""
        return self.packed_threshold[:, self._lane :: self._n_lanes]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.mean.shape[0], self.mean.shape[1]

    def copy(self) -> Background:
        """Another one, which learns for itself."""
        return copy.deepcopy(self)

    def watch_only(self, mask: BoolArray | None) -> None:
        """Let nothing be new where `mask` (h, w) is False; None: watch everywhere."""
        self._is_hidden = None if mask is None else ~mask
        for top in range(0, len(self.mean), STRIPE_ROWS):
            self._renew_threshold(slice(top, top + STRIPE_ROWS))

    def survey(self, samples: SampleArray) -> Survey:
        """Compare a grid of samples of a frame with what is expected there."""
        seen = samples[GRID_STEP // 2 :: GRID_STEP, GRID_STEP // 2 :: GRID_STEP].copy()
        is_darker = seen < self._grid_low
        n_changed = np.count_nonzero(seen > self._grid_high) + np.count_nonzero(is_darker)
        return Survey(n_changed / max(seen.size, 1), is_darker)

    def blind_share(self) -> float:
        """Share 0..1 of the picture so bright that no spot can stand out of it."""
        return np.count_nonzero(self._grid_high >= self.full_scale) / max(self._grid_high.size, 1)

    def learn(self, samples: SampleArray, *, without: Iterable[Box] = (), is_hurried: bool = False) -> None:
        """Learn from the next stripe of rows, in every second frame.

        Args:
            samples: (h, w) of the whole frame; to be called with each.
            without: what may be a spot: learnt as if it were not there.
            is_hurried: learn from several stripes of every frame, to catch up with light that changes.
        """
        self._wait -= 1
        if self._wait > 0 and not is_hurried:
            return
        self._wait = FRAMES_A_STRIPE
        boxes = tuple(without)
        for _ in range(HURRIED_STRIPES if is_hurried else 1):
            top = self._next_row
            rows = slice(top, min(top + STRIPE_ROWS, len(self.mean)))
            self._learn_rows(rows, self._without(np.ascontiguousarray(samples[rows]), rows, boxes))
            self._renew_threshold(rows)
            self._next_row = rows.stop
            if rows.stop == len(self.mean):
                self._next_row = 0
                self._n_rounds += 1
                # Visits in step with a flicker would never see its other phases.
                self._wait += self._n_rounds * 5 % 7

    def _without(self, samples: SampleArray, rows: slice, boxes: tuple[Box, ...]) -> SampleArray:
        """The stripe with the mean in place of the boxes."""
        crossing = [box for box in boxes if box[1] < rows.stop and box[3] > rows.start]
        if not crossing:
            return samples
        samples = samples.copy()
        for left, top, right, bottom in crossing:
            part = slice(max(top, rows.start), min(bottom, rows.stop)), slice(max(left, 0), right)
            samples[part[0].start - rows.start : part[0].stop - rows.start, part[1]] = np.rint(self.mean[part])
        return samples

    def _learn_rows(self, rows: slice, seen: SampleArray) -> None:
        mean, spread = self.mean[rows], self.spread[rows]
        deviation = cv2.subtract(seen, mean, dtype=cv2.CV_32F)
        # The first visits weigh more: a background learnt while a spot moved about forgets it soon.
        rate = max(RATE, 1 / (self._n_rounds + 2))
        cv2.scaleAdd(deviation, rate, mean, dst=mean)
        # What is far off is no noise but somebody, who would widen the spread until no spot stood out of it.
        size = np.abs(deviation)
        is_noise = size < NOISE_SPREADS * spread + 2 * self.step
        size *= SIGMA_OVER_DEVIATION
        size -= spread
        size *= rate * SPREAD_RATE
        np.add(spread, size, out=spread, where=is_noise)
        np.maximum(spread, MIN_SPREAD_STEPS * self.step, out=spread)
        current, previous = self._maxima[0, rows], self._maxima[1, rows]
        if self._n_rounds % WINDOW_VISITS == WINDOW_VISITS - 1:
            np.copyto(previous, current)
            np.copyto(current, seen)
        else:
            cv2.max(current, seen, dst=current)

    def _renew_threshold(self, rows: slice) -> None:
        mean, spread = self.mean[rows], self.spread[rows]
        # Among millions of samples, some have a spread that is much too small by chance: the neighbours know better.
        spread = cv2.max(spread, cv2.blur(spread, (NEIGHBOURHOOD, NEIGHBOURHOOD)))
        depth = cv2.CV_8U if self._maxima.dtype == np.uint8 else cv2.CV_16U
        margin = MARGIN_STEPS * self.step
        above_mean = cv2.addWeighted(spread, MEAN_SPREADS, mean, 1.0, margin, dtype=depth)
        highest = cv2.max(self._maxima[0, rows], self._maxima[1, rows])
        above_maximum = cv2.addWeighted(spread, MAXIMUM_SPREADS, highest, 1.0, margin, dtype=depth)
        threshold = cv2.max(above_mean, above_maximum)
        below = cv2.addWeighted(mean, 2.0, threshold, -1.0, 0.0, dtype=depth)
        is_hidden = None if self._is_hidden is None else self._is_hidden[rows]
        if is_hidden is not None:
            threshold[is_hidden] = np.iinfo(self._maxima.dtype).max
            below[is_hidden] = 0
        self.threshold[rows] = threshold
        if len(threshold) > GRID_STEP // 2:
            index = rows.start // GRID_STEP
            self._grid_high[index] = threshold[GRID_STEP // 2, GRID_STEP // 2 :: GRID_STEP]
            self._grid_low[index] = below[GRID_STEP // 2, GRID_STEP // 2 :: GRID_STEP]
