"""A device's clock in this machine's time, from when its messages arrive: offset and drift, with their covariance.

A message arrives after the instant that it tells, by a fixed latency and a delay that is never negative. So the true
line host = f(device) lies below all arrivals, and near the quickest. Of the lines that do, the posterior mean is taken,
for delays that are either spread evenly up to an unknown longest one or fall off exponentially with an unknown mean,
whichever the delays themselves make likelier. Its error falls as 1/n, that of a mean of arrivals only as 1/sqrt(n).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from network_calib.observations import FloatArray

# No clock of an instrument is worse: 1300 ppm is the worst that was recorded. One standard deviation.
GAIN_SIGMA = 2e-3
GRID, GRID_REACH = 61, 14.0
MIN_ARRIVALS = 3
TINY_S = 1e-12


@dataclass(frozen=True, slots=True)
class ClockLine:
    """host = offset_s + gain (device - reference_s).

    Attributes:
        reference_s: device time in the middle of the arrivals.
        offset_s: host time of that instant.
        gain: host seconds per device second.
        covariance: (2, 2) of offset and gain.
    """

    reference_s: float
    offset_s: float
    gain: float
    covariance: FloatArray

    def host_s(self, device_s: float) -> float:
        """Host time of a device time."""
        return self.offset_s + self.gain * (device_s - self.reference_s)

    def sigma_s(self, device_s: float) -> float:
        """Standard deviation of `host_s`."""
        row = np.array([1.0, device_s - self.reference_s])
        return float(np.sqrt(row @ self.covariance @ row))


class ClockFit:
    """Fits the line to the arrivals of the last while.

    Args:
        latency_s: the fixed part of the delay, from the instant that is told to the earliest arrival.
        window_s: arrivals older than this are forgotten, so that a drift that changes with warmth is followed.
        refit_s: the line is made anew when so much device time has passed.
    """

    def __init__(self, *, latency_s: float = 0.0, window_s: float = 120.0, refit_s: float = 1.0) -> None:
        self._latency_s, self._window_s, self._refit_s = latency_s, window_s, refit_s
        self._arrivals: deque[tuple[float, float]] = deque()
        self._line: ClockLine | None = None
        self._fitted_s = -np.inf

    def add(self, device_s: float, arrival_s: float) -> None:
        """A message that tells the instant `device_s` arrived at `arrival_s`; device times grow."""
        self._arrivals.append((device_s, arrival_s - self._latency_s))
        while self._arrivals[0][0] < device_s - self._window_s:
            self._arrivals.popleft()

    def line(self) -> ClockLine:
        """The line as known now.

        Raises:
            ValueError: nothing has arrived.
        """
        if not self._arrivals:
            raise ValueError("no arrivals to fit a clock to")
        newest_s = self._arrivals[-1][0]
        # In its first seconds a clock gains from every message.
        if self._line is None or newest_s - self._fitted_s >= self._refit_s or len(self._arrivals) < 100:
            self._line, self._fitted_s = fit_clock(np.array(self._arrivals)), newest_s
        return self._line


def fit_clock(arrivals: FloatArray) -> ClockLine:
    """The line under arrivals (n, 2) of device and host time, device times growing."""
    device, host = arrivals[:, 0], arrivals[:, 1]
    reference = float((device[0] + device[-1]) / 2)
    x = device - reference
    y = host - device
    span, n = float(x[-1] - x[0]), len(x)
    if n < MIN_ARRIVALS or span == 0:
        lowest, spread = float(y.min()), max(float(np.ptp(y)), 1e-3)
        return ClockLine(reference, reference + lowest, 1.0, np.diag([spread**2, GAIN_SIGMA**2]))
    # Only corners of the convex hull can touch a line from above, or be the farthest from it.
    low, high = _lower_hull(x, y), _lower_hull(x, -y)
    left, right = _touching_line(x[low], y[low])
    scale = 2 * float(np.mean(y - (left + (right - left) * (x - x[0]) / span))) / n + 1e-9
    # Not symmetric: no line of the grid then touches a point exactly, where rounding would decide whether it counts.
    offsets = scale * np.linspace(-GRID_REACH, 1.0137 * GRID_REACH, GRID)
    ends = np.stack(np.meshgrid(left + offsets, right + offsets, indexing="ij"), axis=-1).reshape(-1, 2)
    log_weight = (
        _log_posterior(ends, (x - x[0]) / span, y, low, high)
        - 0.5 * ((ends[:, 1] - ends[:, 0]) / span / GAIN_SIGMA) ** 2
    )
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean = weight @ ends
    # A cell of the grid is an interval, not a point.
    spread = (ends - mean).T @ (weight[:, None] * (ends - mean)) + np.eye(2) * (offsets[1] - offsets[0]) ** 2 / 12
    to_line = np.array([[0.5, 0.5], [-1 / span, 1 / span]])
    offset, gain = to_line @ mean
    return ClockLine(reference, reference + float(offset), 1 + float(gain), to_line @ spread @ to_line.T)


def _log_posterior(ends: FloatArray, u: FloatArray, y: FloatArray, low: list[int], high: list[int]) -> FloatArray:
    """(m,) of lines by their heights (m, 2) at u = 0 and 1; the delays' scale integrated out under a prior 1/scale."""
    n = len(y)
    shortest = (y[low] - ends[:, :1] * (1 - u[low]) - ends[:, 1:] * u[low]).min(axis=1)
    longest = (y[high] - ends[:, :1] * (1 - u[high]) - ends[:, 1:] * u[high]).max(axis=1)
    mean = y.mean() - ends[:, 0] * (1 - u.mean()) - ends[:, 1] * u.mean()
    even = -np.log(n) - n * np.log(np.maximum(longest, TINY_S))
    # The integral over an exponential's mean gives (n - 1)! / (n mean)^n.
    falling = gammaln(n) - n * np.log(n * np.maximum(mean, TINY_S))
    return np.where(shortest >= 0, np.logaddexp(even, falling), -np.inf)


def _touching_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Heights at both ends of the edge of a lower hull that spans the middle: the highest line below all points."""
    middle = (x[0] + x[-1]) / 2
    k = min(int(np.searchsorted(x, middle, side="right")) - 1, len(x) - 2)
    slope = (y[k + 1] - y[k]) / (x[k + 1] - x[k])
    return float(y[k] + slope * (x[0] - x[k])), float(y[k] + slope * (x[-1] - x[k]))


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
