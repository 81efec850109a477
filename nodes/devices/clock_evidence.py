"""What two kinds of messages say of a clock line: arrivals after an unknown delay, and answers between two times.

Each gives, for some drifts, the log probability of the line's height at the middle of its own messages.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from network_calib.observations import FloatArray

N_BELOW, N_OFFSET = 40, 24
# An exponential tail of so many decay lengths holds all but 1e-7.
TAIL = 16.0
MAX_ZOOMS, N_SEARCH = 12, 61
TINY_S = 1e-12
# Delays of one length only, as on a line without any, still leave this of their times' last digits.
ROUNDING_S = 1e-7


@dataclass(frozen=True, slots=True)
class Side:
    """What one kind of messages says, at a grid: for D drifts and H heights of the line at the kind's own middle.

    Attributes:
        heights_s: (D, H).
        log_weight: (D, H) with the size of the cells.
        cell_s: (D,) their size.
    """

    heights_s: FloatArray
    log_weight: FloatArray
    cell_s: FloatArray


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Arrivals about their middle, by the corners of their hull.

    Attributes:
        middle_s: device time.
        base_s: what is taken off host - device, so that the rest is small.
        low: (2, k) x and y of the lower hull; no other arrival can touch a line from above.
        high: (2, k) of the upper hull.
        mean: (2,) of all.
        n: how many.
        span_s: from the first to the last.
        cut_s: width of what the device's cut of its times adds to the delays unseen.
    """

    middle_s: float
    base_s: float
    low: FloatArray
    high: FloatArray
    mean: FloatArray
    n: int
    span_s: float
    cut_s: float

    @classmethod
    def of(cls, arrivals: FloatArray, resolution_s: float) -> Arrivals:
        """Of (n, 2) device and host times."""
        middle = float((arrivals[0, 0] + arrivals[-1, 0]) / 2)
        base = float(arrivals[0, 1] - arrivals[0, 0])
        x, y = arrivals[:, 0] - middle, arrivals[:, 1] - arrivals[:, 0] - base
        low, high = _lower_hull(x, y), _lower_hull(x, -y)
        points = np.stack([x, y])
        mean = points.mean(axis=1)
        slope = float(np.polyfit(x, y, 1)[0])
        delay = float(np.mean(y - slope * x) - np.min(y - slope * x))
        # Of long delays the cut is a small part: the shortest of them may stand anywhere in their cell. Where there are
        # no others, the cut itself is the delay, and is in the posterior already.
        cut = resolution_s * np.sqrt(1 - min(1.0, resolution_s / 2 / max(delay, TINY_S)) ** 2)
        return cls(middle, base, points[:, low], points[:, high], mean, len(x), float(np.ptp(x)), float(cut))

    def side(self, drift: FloatArray) -> Side:
        """See `Side`; drifts (D,)."""
        top = (self.low[1] - drift[:, None] * self.low[0]).min(axis=1)
        longest = (self.high[1] - drift[:, None] * self.high[0]).max(axis=1) - top
        mean = self.mean[1] - drift * self.mean[0] - top
        cell = TAIL * (np.minimum(longest, 2 * mean) + ROUNDING_S) / self.n / N_BELOW
        below = cell[:, None] * (np.arange(N_BELOW) + 0.5)
        weight = _log_of_delays(longest[:, None] + below, mean[:, None] + below, self.n) + np.log(cell)[:, None]
        return Side(top[:, None] - below + self.base_s - self.cut_s / 2, weight, cell)


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers about their middle.

    Attributes:
        middle_s: device time.
        x: (m,) device times.
        low: (m,) bound of host - device.
        high: (m,) the other, apart from when the answer was heard; infinite where there is none.
        heard: (m,) of when it was: a delay after the instant, as an arrival's.
        cut_s: the true instant is up to so much after the one that is told.
    """

    middle_s: float
    x: FloatArray
    low: FloatArray
    high: FloatArray
    heard: FloatArray
    cut_s: float

    @classmethod
    def of(cls, bounds: FloatArray, resolution_s: float) -> Answers:
        """Of (m, 4) columns of `clock_fit.Bounds`."""
        device, low, high, heard = bounds.T
        middle = float((device.min() + device.max()) / 2)
        return cls(middle, device - middle, low - device, high - device, heard - device, max(resolution_s, ROUNDING_S))

    def drifts(self, low: float, high: float) -> tuple[float, float]:
        """The part of a range in which there is a line within all bounds: answers a minute apart leave but a sliver."""
        for _ in range(MAX_ZOOMS):
            drift = np.linspace(low, high, N_SEARCH)
            least, most = self._between(drift)
            # The room between the bounds is a concave function of the drift.
            room = most - least
            inside = np.flatnonzero(room > 0)
            widest = int(room.argmax())
            first, last = (inside[0], inside[-1]) if len(inside) else (widest, widest)
            low, high = drift[max(first - 1, 0)], drift[min(last + 1, N_SEARCH - 1)]
            if len(inside):
                break
        return float(low), float(high)

    def _between(self, drift: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(D,) and (D,) between which the line's height is."""
        way = drift[:, None] * self.x
        least = (self.low - way).max(axis=1) - self.cut_s
        return least, np.minimum((self.high - way).min(axis=1), (self.heard - way).min(axis=1))

    def side(self, drift: FloatArray) -> Side:
        """See `Side`; drifts (D,)."""
        way = drift[:, None] * self.x
        least, most = self._between(drift)
        cell = np.maximum(most - least, 0.0) / N_OFFSET
        heights = least[:, None] + cell[:, None] * (np.arange(N_OFFSET) + 0.5)
        line = heights[:, :, None] + way[:, None, :]
        possible = np.minimum(self.high - line, self.cut_s) - np.maximum(self.low - line, 0.0)
        delay = np.maximum(self.heard - line, 0.0)
        with np.errstate(divide="ignore"):
            weight = np.log(np.maximum(possible / self.cut_s, 0.0)).sum(axis=2) + np.log(cell)[:, None]
        weight += _log_of_delays(delay.max(axis=2), delay.mean(axis=2), len(self.x))
        return Side(heights, weight, cell)


def _log_of_delays(longest_s: FloatArray, mean_s: FloatArray, n: int) -> FloatArray:
    """Log probability of n delays; their scale is integrated out under a prior 1/scale."""
    even = -np.log(n) - n * np.log(np.maximum(longest_s, TINY_S))
    # The integral over an exponential's mean gives (n - 1)! / (n mean)^n.
    falling = gammaln(n) - n * np.log(n * np.maximum(mean_s, TINY_S))
    return np.logaddexp(even, falling)


def _lower_hull(x: FloatArray, y: FloatArray) -> list[int]:
    """Indices of the lower convex hull of points with growing x (Andrew's monotone chain)."""
    hull: list[int] = []
    for k in range(len(x)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[k] - y[a]) - (y[b] - y[a]) * (x[k] - x[a]) > 0:
                break
            hull.pop()
        hull.append(k)
    return hull
