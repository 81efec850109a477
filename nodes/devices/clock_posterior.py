"""The posterior of a clock line: offset, drift and latency, summed over a grid that closes in on where they can be.

With y = host - device, gain g = 1 + drift, and the arrivals' line at height c above its middle x_a:

    arrivals   y >= c + drift (x - x_a), delays spread evenly or falling off, their scale integrated out
    answers    low <= o + drift (x - x_t) <= high, the instant anywhere in the cell that its stamp is cut to; they are
               heard after delays of the same kinds
    latency    c - o - drift (x_a - x_t), normally distributed about what is known of it

For one drift the first two depend on c and on o alone, so that the grid of three is cheap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.observations import FloatArray
from nodes.devices.clock_evidence import Answers, Arrivals

N_DRIFT, DRIFT_REACH = 61, 5.0
MAX_ZOOMS, NEGLIGIBLE = 12, 1e-7


@dataclass(frozen=True, slots=True)
class ClockPrior:
    """What is known beforehand.

    Attributes:
        gain: host seconds per device second.
        gain_sigma: its standard deviation.
        latency_s: of the earliest arrival.
        latency_sigma_s: its standard deviation; 0: it is known.
        resolution_s: the device tells its time cut to multiples of this.
    """

    gain: float
    gain_sigma: float
    latency_s: float
    latency_sigma_s: float
    resolution_s: float = 0.0


@dataclass(frozen=True, slots=True)
class PosteriorLine:
    """See `clock_fit.ClockLine`."""

    reference_s: float
    offset_s: float
    gain: float
    covariance: FloatArray
    latency_s: float
    latency_sigma_s: float


def posterior_line(arrivals: FloatArray, bounds: FloatArray, prior: ClockPrior) -> PosteriorLine | None:
    """The mean line of arrivals (n, 2), three or more or none, and of bounds (m, 4); None when no line is possible."""
    heard = Arrivals.of(arrivals, prior.resolution_s) if len(arrivals) else None
    told = Answers.of(bounds, prior.resolution_s) if len(bounds) else None
    reach = DRIFT_REACH * prior.gain_sigma
    low, high = prior.gain - 1 - reach, prior.gain - 1 + reach
    if told is not None:
        low, high = told.drifts(low, high)
    grid = _Grid.of(np.linspace(low, high, N_DRIFT), heard, told, prior)
    for _ in range(MAX_ZOOMS):
        if grid is None:
            return None
        by_drift = grid.weight.sum(axis=(1, 2))
        kept = np.flatnonzero(by_drift > NEGLIGIBLE * by_drift.max())
        if kept[-1] - kept[0] > N_DRIFT // 2:
            break
        step = grid.drift[1] - grid.drift[0]
        closer = np.linspace(grid.drift[kept[0]] - step, grid.drift[kept[-1]] + step, N_DRIFT)
        grid = _Grid.of(closer, heard, told, prior)
    return None if grid is None else grid.line(prior, heard, told)


@dataclass(frozen=True, slots=True)
class _Grid:
    """The posterior at D drifts, H heights of the arrivals' line, K of the true one.

    Attributes:
        drift: (D,).
        offset_s: (D, H, K) of the true line at its reference.
        latency_s: (D, H, K).
        weight: (D, H, K), of sum 1.
        reference_s: device time.
        cell_s: the largest cell of offsets.
    """

    drift: FloatArray
    offset_s: FloatArray
    latency_s: FloatArray
    weight: FloatArray
    reference_s: float
    cell_s: float

    @classmethod
    def of(cls, drift: FloatArray, heard: Arrivals | None, told: Answers | None, prior: ClockPrior) -> _Grid | None:
        log_weight = -0.5 * ((drift - prior.gain + 1) / prior.gain_sigma)[:, None, None] ** 2
        arrived, answered = heard and heard.side(drift), told and told.side(drift)
        offset, latency = np.zeros((len(drift), 1, 1)), np.full((len(drift), 1, 1), prior.latency_s)
        reference, cell = 0.0, np.zeros(len(drift))
        if arrived is not None and heard is not None:
            reference, cell = heard.middle_s, arrived.cell_s
            offset = arrived.heights_s[:, :, None] - prior.latency_s
            log_weight = log_weight + arrived.log_weight[:, :, None]
        if answered is not None and told is not None:
            if arrived is not None and heard is not None:
                way = (drift * (heard.middle_s - told.middle_s))[:, None, None]
                latency = arrived.heights_s[:, :, None] - answered.heights_s[:, None, :] - way
                # Two cells are intervals, not points.
                sigma2 = prior.latency_sigma_s**2 + (cell**2 + answered.cell_s**2)[:, None, None] / 12
                log_weight = log_weight - 0.5 * ((latency - prior.latency_s) ** 2 / sigma2 + np.log(sigma2))
            reference, cell, offset = told.middle_s, answered.cell_s, answered.heights_s[:, None, :]
            log_weight = log_weight + answered.log_weight[:, None, :]
        highest = log_weight.max()
        if not np.isfinite(highest):
            return None
        weight = np.exp(log_weight - highest)
        weight /= weight.sum()
        likeliest = int(weight.sum(axis=(1, 2)).argmax())
        shape = weight.shape
        return cls(
            drift,
            np.broadcast_to(offset, shape),
            np.broadcast_to(latency, shape),
            weight,
            reference,
            float(cell[likeliest]),
        )

    def line(self, prior: ClockPrior, heard: Arrivals | None, told: Answers | None) -> PosteriorLine:
        by_drift = self.weight.sum(axis=(1, 2))
        drift = float(by_drift @ self.drift)
        offset, latency = float((self.weight * self.offset_s).sum()), float((self.weight * self.latency_s).sum())
        off_drift = (self.drift - drift)[:, None, None]
        off = self.offset_s - offset
        step = float(self.drift[1] - self.drift[0])
        both = float((self.weight * off * off_drift).sum())
        drift2 = float(by_drift @ (self.drift - drift) ** 2) + step**2 / 12
        offset2 = float((self.weight * off**2).sum()) + self.cell_s**2 / 12
        latency2 = float((self.weight * (self.latency_s - latency) ** 2).sum())
        if heard is None or told is None:  # nothing teaches it
            latency2 = prior.latency_sigma_s**2
            offset2 += latency2 if told is None else 0.0
        if heard is not None:  # the cut at either end of the arrivals' line
            drift2 += 2 * heard.cut_s**2 / 12 / heard.span_s**2
            offset2 += heard.cut_s**2 / 24 if told is None else 0.0
        covariance = np.array([[offset2, both], [both, drift2]])
        return PosteriorLine(
            self.reference_s, self.reference_s + offset, 1 + drift, covariance, latency, float(np.sqrt(latency2))
        )
