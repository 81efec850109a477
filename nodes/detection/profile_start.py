"""Where the fit of a spot starts: from the number, place and spread of the bright samples."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nodes.detection.profile_fit import Samples
from nodes.detection.spots import FloatArray

# Samples above so many standard deviations of the background are bright; one in 4,000 is noise.
BRIGHT_SIGMAS = 3.5
# Bright samples spread as a line: enough of them, and this ratio of their variances along and across.
N_OF_A_LINE, RATIO_OF_A_LINE = 12, 4.0


@dataclass(frozen=True, slots=True)
class BrightSamples:
    """The samples above a threshold.

    Attributes:
        x: centre of gravity, px of the window.
        y: the same.
        height: of the spot over the background, counts.
        area_px2: their number.
        log_height: logarithm of height over threshold.
        covariance_px2: (2, 2) spread of the samples.
    """

    x: float
    y: float
    height: float
    area_px2: int
    log_height: float
    covariance_px2: tuple[float, float, float]

    @property
    def elongation_px2(self) -> tuple[float, float]:
        """Half the difference of the variances along and across, and half their sum."""
        xx, xy, yy = self.covariance_px2
        return math.hypot((xx - yy) / 2, xy), (xx + yy) / 2

    @property
    def is_line(self) -> bool:
        """Whether a smeared spot is to be tried first; the fit has the last word."""
        difference, mean = self.elongation_px2
        return self.area_px2 >= N_OF_A_LINE and mean + difference > RATIO_OF_A_LINE * (mean - difference)

    def still(self) -> FloatArray:
        """Parameters of a StillSpot. A Gaussian of height p is above t on an area of 2 pi width² ln(p / t)."""
        variance = max(self.area_px2 / (2 * math.pi * self.log_height), 0.25)
        return np.array([self.x, self.y, math.sqrt(variance), self.height * 2 * math.pi * variance, 0.0])

    def moving(self) -> FloatArray:
        """Parameters of a MovingSpot: the bright samples fill a strip, as long as their spread says."""
        difference, mean = self.elongation_px2
        xx, xy, yy = self.covariance_px2
        half = math.sqrt(3 * (mean + difference))
        width = max(self.area_px2 / (4 * half * math.sqrt(2 * self.log_height)), 0.5)
        flux = self.height * 2 * half * math.sqrt(2 * math.pi) * width
        return np.array([self.x, self.y, width, flux, half, 0.5 * math.atan2(2 * xy, xx - yy), 0.0])


def bright_samples(samples: Samples, width: int) -> BrightSamples | None:
    """The bright samples of a window so many pixels wide; None where nothing stands out of the noise."""
    least = BRIGHT_SIGMAS * np.sqrt(samples.variance)
    seen = samples.light * (samples.light > least)
    peak = float(seen.max())
    if peak <= 0:
        return None
    threshold = max(0.5 * peak, min(float(np.mean(least)), 0.8 * peak))
    bright = np.flatnonzero(seen > threshold)
    weight = samples.light[bright]
    weight /= weight.sum()
    y, x = np.divmod(bright, width)
    mean_x, mean_y = float(weight @ x), float(weight @ y)
    dx, dy = x - mean_x, y - mean_y
    weighted = weight * dx
    spread = float(weighted @ dx), float(weighted @ dy), float((weight * dy) @ dy)
    # A full sample hides a higher peak.
    height = 1.5 * peak if samples.is_full is not None else peak
    return BrightSamples(mean_x, mean_y, height, len(bright), math.log(height / threshold), spread)
