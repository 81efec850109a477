"""Learning a background from some frames at once: of the empty scene, after a change of light, or of a whole recording.

Order statistics of a few frames spread over the time: as the spot is at any one place only briefly, neither the middle
nor the lower half of what a sample was ever knows of it.
"""

from __future__ import annotations

import numpy as np

from nodes.detection.background import MIN_SPREAD_STEPS, SIGMA_OVER_DEVIATION, Background, Float32Array
from nodes.detection.channel import Plane, SampleArray
from nodes.detection.spots import Channel

# Frames held at most: fewer make the spread uncertain, more make the memory large.
N_HELD = 24
MIN_HELD = 9
MAX_HELD_BYTES = 128 * 2**20
# Where the spot may be in the picture, so many of the brightest frames are left out: one in six.
N_FRAMES_PER_OUTLIER = 6
ROWS_AT_ONCE = 64
# Standard deviation of a normal distribution over the mean of what lies between its median and its 5/6 quantile.
SIGMA_OVER_UPPER = 2.24


class BackgroundLearner:
    """Collects planes of one channel; memory does not grow with their number."""

    def __init__(self, channel: Channel, *, is_empty: bool) -> None:
        """Begin.

        Args:
            channel: what the planes are of.
            is_empty: the scene is known to hold no spot: then the maximum of all frames is trusted.
        """
        self.channel = channel
        self.n_seen = 0
        self._is_empty = is_empty
        self._held: list[SampleArray] = []
        self._stride = 1
        self._maximum: SampleArray | None = None
        self._full_scale = 0.0
        self._lane, self._n_lanes = 0, 1

    def add(self, plane: Plane) -> None:
        """Take the next frame into account; the planes must all have one shape and type."""
        samples = plane.samples
        if self.n_seen % self._stride == 0:
            if len(self._held) == _n_held(samples):
                self._held = self._held[::2]
                self._stride *= 2
            if self.n_seen % self._stride == 0:
                self._held.append(samples.copy())
        if self._is_empty:
            self._note_maximum(samples)
        self._full_scale = plane.full_scale
        self._lane, self._n_lanes = plane.lane, plane.packed.shape[1] // samples.shape[1]
        self.n_seen += 1

    def _note_maximum(self, samples: SampleArray) -> None:
        if self._maximum is None:
            self._maximum = samples.copy()
        else:
            np.maximum(self._maximum, samples, out=self._maximum)

    def background(self) -> Background:
        """What was learnt; the learner must have seen a frame."""
        shape, dtype = self._held[0].shape, self._held[0].dtype
        mean, spread = np.empty(shape, np.float32), np.empty(shape, np.float32)
        maximum = np.empty(shape, dtype)
        for top in range(0, shape[0], ROWS_AT_ONCE):
            rows = slice(top, top + ROWS_AT_ONCE)
            ordered = np.stack([samples[rows] for samples in self._held])
            _sort(ordered)
            mean[rows], spread[rows] = _middle_and_spread(ordered)
            maximum[rows] = ordered[len(ordered) - 1 - len(ordered) // N_FRAMES_PER_OUTLIER]
        step = self._full_scale / 255
        return Background(
            self.channel,
            mean=mean,
            spread=np.maximum(spread, np.float32(MIN_SPREAD_STEPS * step)),
            maximum=maximum if self._maximum is None else self._maximum.copy(),
            full_scale=self._full_scale,
            lane=self._lane,
            n_lanes=self._n_lanes,
        )


def _n_held(samples: SampleArray) -> int:
    return min(max(MAX_HELD_BYTES // samples.nbytes, MIN_HELD), N_HELD)


def _sort(stack: SampleArray) -> None:
    """Sort (n, h, w) along its first axis, in place: odd-even transposition, whole images compared at once."""
    n = len(stack)
    for k in range(n):
        lower, upper = stack[k % 2 : n - 1 : 2], stack[k % 2 + 1 : n : 2]
        low, high = np.minimum(lower, upper), np.maximum(lower, upper)
        lower[:], upper[:] = low, high


def _middle_and_spread(ordered: SampleArray) -> tuple[Float32Array, Float32Array]:
    """Mean of the middle half of (n, h, w) in order, and standard deviation as the larger of two sides tells it.

    The lower half is free of the spot, but nothing where black is cut off; the upper side stops below the spot.
    """
    n = len(ordered)
    middle = ordered[n // 4 : n - n // 4].mean(axis=0, dtype=np.float32)
    lower = middle - ordered[: (n + 1) // 2].mean(axis=0, dtype=np.float32)
    upper = ordered[n // 2 : max(n - n // N_FRAMES_PER_OUTLIER, n // 2 + 1)].mean(axis=0, dtype=np.float32) - middle
    return middle, np.maximum(SIGMA_OVER_DEVIATION * lower, SIGMA_OVER_UPPER * upper)
