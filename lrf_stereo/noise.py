"""What a laser range finder gets wrong, in numbers: the noise of an URG-04LX as measured on 34 still scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from network_calib.observations import FloatArray

# Correlation of the range noise of beams 0, 1, 2, 3 steps apart in one scan; further ones are independent. In time the
# noise is white.
NEIGHBOUR_CORRELATION = (1.0, 0.47, 0.29, 0.17)
URG_STEP_RAD = 2 * np.pi / 1024


@dataclass(frozen=True, slots=True)
class LrfNoise:
    """Standard deviations of one beam.

    Attributes:
        range_floor_m: of the range, at no distance.
        range_per_m: growth of the range's with the distance.
        bearing_rad: of the bearing; the default is a uniform error of one step's width.
        tilt_rad: of the tilt angle of the scan; the default leaves it exact.
    """

    range_floor_m: float = 2.25e-3
    range_per_m: float = 0.73e-3
    bearing_rad: float = URG_STEP_RAD / np.sqrt(12)
    tilt_rad: float = 0.0

    def range_m(self, range_m: npt.ArrayLike) -> FloatArray:
        """Standard deviations of ranges of any shape."""
        return self.range_floor_m + self.range_per_m * np.asarray(range_m, dtype=np.float64)


def mean_variance_factor(n_beams: npt.ArrayLike) -> FloatArray:
    """Variance of the mean of n neighbouring beams over the variance of one; 1/n if they were independent.

    Args:
        n_beams: any shape, at least one each.
    """
    n = np.asarray(n_beams, dtype=np.float64)
    pairs = sum((np.maximum(n - lag, 0) * rho for lag, rho in enumerate(NEIGHBOUR_CORRELATION[1:], start=1)), 0.0)
    return (n + 2 * pairs) / n**2


def correlated_noise(shape: tuple[int, ...], *, rng: np.random.Generator) -> FloatArray:
    """Unit Gaussian noise (..., beams), neighbours along the last axis correlated as NEIGHBOUR_CORRELATION says."""
    taps = _moving_average()
    white = rng.standard_normal((*shape[:-1], shape[-1] + len(taps) - 1))
    return sum((tap * white[..., k : k + shape[-1]] for k, tap in enumerate(taps)), np.zeros(shape))


def _moving_average() -> FloatArray:
    """Four weights whose autocorrelation is NEIGHBOUR_CORRELATION.

    The autocorrelation is the product of the weights' polynomial and its mirror, so its roots come in pairs x, 1/x; the
    ones inside the unit circle make the weights.
    """
    one_sided = np.array(NEIGHBOUR_CORRELATION)
    roots = np.roots(np.concatenate([one_sided[::-1], one_sided[1:]]))
    weights = np.poly(roots[np.abs(roots) < 1]).real
    return weights / np.linalg.norm(weights)
