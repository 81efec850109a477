"""A device's clock in this machine's time: offset and drift, with their covariance.

Two kinds of messages tell of it. One that the device sends of itself arrives after the instant that it tells, by a
fixed latency and a delay that is never negative: the line host = f(device) + latency lies below all arrivals, and near
the quickest. Delays are taken to be spread evenly up to an unknown longest one, or to fall off exponentially with an
unknown mean, whichever they themselves make likelier; the error then falls as 1/n, that of a mean of arrivals only as
1/sqrt(n). An answer to a question tells an instant between asking and hearing: low <= f(device) <= high, without any
latency, which is learnt so. The posterior mean is taken, over offset, drift and latency.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from network_calib.observations import FloatArray
from nodes.devices.clock_posterior import ClockPrior, posterior_line

# 1300 ppm is the worst that was recorded, of an URG-04LX. One standard deviation.
GAIN_SIGMA = 1.5e-3
MIN_ARRIVALS = 3
# While few messages have come, the line is made anew whenever there are so many more.
GROWTH, GROWN = 1.08, 200


@dataclass(frozen=True, slots=True)
class ClockLine:
    """host = offset_s + gain (device - reference_s).

    Attributes:
        reference_s: a device time in the midst of the messages.
        offset_s: host time of that instant.
        gain: host seconds per device second.
        covariance: (2, 2) of offset and gain.
        latency_s: from an instant to the earliest arrival of the message that tells it.
        latency_sigma_s: its standard deviation.
    """

    reference_s: float
    offset_s: float
    gain: float
    covariance: FloatArray
    latency_s: float = 0.0
    latency_sigma_s: float = 0.0

    def host_s(self, device_s: float) -> float:
        """Host time of a device time."""
        return self.offset_s + self.gain * (device_s - self.reference_s)

    def sigma_s(self, device_s: float) -> float:
        """Standard deviation of `host_s`."""
        row = np.array([1.0, device_s - self.reference_s])
        return float(np.sqrt(row @ self.covariance @ row))


class Bounds(NamedTuple):
    """What an answer tells.

    Attributes:
        device_s: the instant, as the device calls it.
        earliest_s: host time before which it was not.
        latest_s: host time after which it was not; infinite where nothing but `heard_s` tells.
        heard_s: when the answer had come.
    """

    device_s: float
    earliest_s: float
    latest_s: float
    heard_s: float


class ClockFit:
    """Fits the line to the messages of the last while.

    Args:
        latency_s: the fixed part of an arrival's delay, as it is thought to be.
        latency_sigma_s: how well that is known; 0: exactly.
        gain: host seconds per device second, as far as known.
        gain_sigma: how well.
        resolution_s: the device's times are cut to multiples of this.
        window_s: messages older than this are forgotten, so that a drift that changes with warmth is followed. A
            latency that answers have taught is kept.
        refit_s: the line is made anew when so much device time has passed.
    """

    def __init__(
        self,
        *,
        latency_s: float = 0.0,
        latency_sigma_s: float = 0.0,
        gain: float = 1.0,
        gain_sigma: float = GAIN_SIGMA,
        resolution_s: float = 0.0,
        window_s: float = 120.0,
        refit_s: float = 1.0,
    ) -> None:
        self._prior = ClockPrior(gain, gain_sigma, latency_s, latency_sigma_s, resolution_s)
        self._window_s, self._refit_s = window_s, refit_s
        self._arrivals: deque[tuple[float, float]] = deque()
        self._bounds: list[Bounds] = []
        self._line: ClockLine | None = None
        self._fitted_s, self._n_fitted = -np.inf, 0

    def add(self, device_s: float, arrival_s: float) -> None:
        """A message that tells the instant `device_s` arrived at `arrival_s`; device times grow."""
        if self._bounds and self._bounds[-1][0] < device_s - self._window_s:
            line = self.line()
            self._prior = replace(self._prior, latency_s=line.latency_s, latency_sigma_s=line.latency_sigma_s)
            self._bounds.clear()
        self._arrivals.append((device_s, arrival_s))
        while self._arrivals[0][0] < device_s - self._window_s:
            self._arrivals.popleft()

    def bound(self, bounds: Bounds) -> None:
        """An answer told the device's clock; device times grow."""
        self._bounds.append(bounds)
        self._line = None

    @property
    def is_known(self) -> bool:
        """Anything arrived, or was answered."""
        return bool(self._arrivals or self._bounds)

    def line(self) -> ClockLine:
        """The line as known now.

        Raises:
            ValueError: nothing is known.
        """
        if not self.is_known:
            raise ValueError("no arrivals to fit a clock to")
        newest_s, n = (self._arrivals or self._bounds)[-1][0], len(self._arrivals)
        # In its first seconds a clock gains from every message.
        is_old = newest_s - self._fitted_s >= self._refit_s or (n < GROWN and n >= GROWTH * self._n_fitted)
        if self._line is None or (is_old and (n, newest_s) != (self._n_fitted, self._fitted_s)):
            self._line = fit_clock(np.array(self._arrivals), bounds=np.array(self._bounds), prior=self._prior)
            self._fitted_s, self._n_fitted = newest_s, n
        return self._line


def fit_clock(arrivals: FloatArray, *, bounds: FloatArray | None = None, prior: ClockPrior | None = None) -> ClockLine:
    """The line of messages and answers.

    Args:
        arrivals: (n, 2) device and host time, device times growing.
        bounds: (m, 4) columns of `Bounds`. Those that contradict one another are left out.
        prior: what is known of gain and latency beforehand.
    """
    prior = prior or ClockPrior(1.0, GAIN_SIGMA, 0.0, 0.0)
    heard = np.reshape(np.array(arrivals, dtype=np.float64), (-1, 2))
    told = np.reshape(np.array([] if bounds is None else bounds, dtype=np.float64), (-1, 4))
    line = None
    if len(heard) >= MIN_ARRIVALS and np.ptp(heard[:, 0]) > 0:
        line = posterior_line(heard, told, prior)
    if line is None and len(told):
        line = posterior_line(np.empty((0, 2)), told, prior)
    if line is None and len(heard) >= MIN_ARRIVALS and np.ptp(heard[:, 0]) > 0:
        line = posterior_line(heard, np.empty((0, 4)), prior)
    if line is not None:
        return ClockLine(
            line.reference_s, line.offset_s, line.gain, line.covariance, line.latency_s, line.latency_sigma_s
        )
    if not len(heard):
        heard = told[:, [0, 3]]
    return _of_few(heard, prior)


def _of_few(heard: FloatArray, prior: ClockPrior) -> ClockLine:
    """One or two messages tell an offset and nothing of the drift."""
    reference = float((heard[0, 0] + heard[-1, 0]) / 2)
    delays = heard[:, 1] - heard[:, 0]
    lowest, spread = float(delays.min()) - prior.latency_s, max(float(np.ptp(delays)), 1e-3)
    covariance = np.diag([spread**2 + prior.latency_sigma_s**2, prior.gain_sigma**2])
    return ClockLine(reference, reference + lowest, prior.gain, covariance, prior.latency_s, prior.latency_sigma_s)
