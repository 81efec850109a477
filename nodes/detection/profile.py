"""Where a bright spot is, to a small part of a pixel, and how well that is known.

The light on the pixels is modelled by a Gaussian on a background; Fisher scoring finds the most likely one under the
noise of the samples. A spot that moved during the exposure gets a model of its own only where a score test says that it
is elongated: of spots that stand still, one in a thousand is taken for smeared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from nodes.detection.noise_model import NoiseModel
from nodes.detection.profile_fit import Fit, LightModel, Samples, fit, own_gain
from nodes.detection.profile_misfit import Misfit, misfit, odd_misfit
from nodes.detection.profile_models import PIXEL_VARIANCE, MovingSpot, StillSpot
from nodes.detection.profile_start import bright_samples
from nodes.detection.spots import FloatArray

Window = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.floating]

# 0.999 quantile of chi² with two degrees of freedom, -2 ln 0.001: the elongation has two components.
ELONGATION_CHI2 = 13.8
# A flux below so many of its standard deviations may be noise: a window holds some hundred places to look at.
MIN_FLUX_OVER_SIGMA = 5.0
# A way below so many of its standard deviations may be no way.
MIN_SMEAR_OVER_SIGMA = 5.0


@dataclass(frozen=True, slots=True)
class Localisation:
    """A spot in one window.

    Attributes:
        px: (2,) position x, y in the image; of a smeared spot the middle of the smear.
        covariance_px2: (2, 2) of `px`.
        peak: height of the fitted profile over the background on a pixel in its centre, counts; above full scale where
            samples are saturated.
        width_px: standard deviation of the profile across the smear.
        smear_half_px: (2,) from the middle of the smear to one of its ends; zero where no smear is seen.
        smear_sigma_px: standard deviation of the smear's length; 0 where no smear is seen.
        misfit: root of the mean squared residual over the noise, where the position comes from; 1 when the profile is
            a Gaussian and the noise as stated.
        is_saturated: samples at full scale lie in the window; they were not trusted as brightness.
    """

    px: FloatArray
    covariance_px2: FloatArray
    peak: float
    width_px: float
    smear_half_px: FloatArray
    smear_sigma_px: float
    misfit: float
    is_saturated: bool

    @property
    def smear_px(self) -> float:
        """Length of the smear."""
        return 2 * math.hypot(*self.smear_half_px)


def localise(
    window: Window,
    background: float | FloatArray,
    *,
    noise: NoiseModel,
    full_scale: float,
    origin_px: tuple[float, float] = (0.0, 0.0),
) -> Localisation | None:
    """The spot in a window that holds one.

    Args:
        window: (h, w) samples, counts; the spot may be cut by a border of the image, its centre may not.
        background: counts without the spot, one number or (h, w); a constant error of it is estimated and does no harm.
        noise: of the samples, its read variance one number or (h, w).
        full_scale: samples at or above it are saturated, counts.
        origin_px: x, y of the centre of the window's top-left pixel in the image.

    Returns:
        None where no spot stands out of the noise, or where its position cannot be told to a part of its width.
    """
    shape = (window.shape[0], window.shape[1])
    samples = _samples(window, background, noise, full_scale)
    bright = bright_samples(samples, shape[1])
    if bright is None:
        return None
    if bright.is_line:
        found, of_line = _fit(MovingSpot(shape), bright.moving(), samples, noise)
        if found is not None and _is_long(found, samples):
            return _localisation(found, misfit(found), of_line, shape, origin_px)
    model = StillSpot(shape)
    found, samples = _fit(model, bright.still(), samples, noise)
    if found is None:
        return None
    quality = misfit(found)
    moving = _moving(model, found, samples, quality, shape)
    if moving is not None:
        found, quality = moving, misfit(moving)
    return _localisation(found, quality, samples, shape, origin_px)


def _fit(model: LightModel, start: FloatArray, samples: Samples, noise: NoiseModel) -> tuple[Fit | None, Samples]:
    """The fit, and the samples with the gain that it used."""
    found = fit(model, start, samples)
    if found is None or noise.gain is not None:
        return found, samples
    samples = replace(samples, gain=own_gain(found, samples))
    return fit(model, found.parameters, samples), samples


def _is_long(found: Fit, samples: Samples) -> bool:
    """Whether the way of a smeared spot exceeds what noise makes of none."""
    variance = samples.correlation_px2 * found.covariance[4, 4]
    return found.parameters[4] > MIN_SMEAR_OVER_SIGMA * math.sqrt(variance)


def _samples(window: Window, background: float | FloatArray, noise: NoiseModel, full_scale: float) -> Samples:
    light = np.subtract(window, background, dtype=np.float64).ravel()
    is_full = (window >= full_scale).ravel()
    variance = noise.background_variance
    if isinstance(variance, np.ndarray):
        variance = variance.ravel()
    return Samples(light, variance, noise.gain or 0.0, is_full if is_full.any() else None, noise.correlation_px2)


def _moving(model: StillSpot, still: Fit, samples: Samples, quality: Misfit, shape: tuple[int, int]) -> Fit | None:
    """The smeared spot where the still one leaves an elongation that noise does not explain (score test); else None."""
    columns = model.elongation(still.parameters)
    weighted = columns * still.weight
    shared = weighted @ still.jacobian.T
    information = weighted @ columns.T - shared @ still.covariance @ shared.T
    score = weighted @ still.residual
    gained = np.linalg.solve(information, score)
    if score @ gained < ELONGATION_CHI2 * samples.correlation_px2 * max(1.0, quality.ratio):
        return None
    x, y, width, flux, constant = still.parameters.tolist()
    # Elongation by d gives variances of +d along and -d across; a way of half length h has variance h²/3.
    elongation = min(math.hypot(*gained), 0.8 * width**2)
    half, angle = math.sqrt(6 * elongation), 0.5 * math.atan2(gained[1], gained[0])
    start = np.array([x, y, math.sqrt(width**2 - elongation), flux, half, angle, constant])
    return fit(MovingSpot(shape), start, samples)


def _localisation(
    found: Fit, quality: Misfit, samples: Samples, shape: tuple[int, int], origin_px: tuple[float, float]
) -> Localisation | None:
    if not 0 <= quality.ratio < math.inf:
        return None  # so few samples tell of the place that nothing is left to judge the fit by
    x, y, width, flux = found.parameters[:4].tolist()
    if not _stands_out(found, quality, samples):
        return None
    odd = odd_misfit(found, quality.leverage, shape) if quality.is_significant else 1.0
    excess = samples.correlation_px2 * max(odd, 1.0)
    covariance_px2 = excess * found.covariance[:2, :2]
    half, angle, smear_sigma = 0.0, 0.0, 0.0
    if len(found.parameters) == MovingSpot.n_parameters:
        half, angle = found.parameters[4:6].tolist()
        smear_sigma = 2 * math.sqrt(excess * found.covariance[4, 4])
    is_inside = -0.5 <= x <= shape[1] - 0.5 and -0.5 <= y <= shape[0] - 0.5
    if not is_inside or np.trace(covariance_px2) > 2 * (width + half) ** 2:
        return None
    return Localisation(
        px=found.parameters[:2] + origin_px,
        covariance_px2=covariance_px2,
        peak=_peak(flux, math.sqrt(width**2 + PIXEL_VARIANCE), half),
        width_px=width,
        smear_half_px=half * np.array([math.cos(angle), math.sin(angle)]),
        smear_sigma_px=smear_sigma,
        misfit=math.sqrt(quality.ratio),
        is_saturated=samples.is_full is not None,
    )


def _stands_out(found: Fit, quality: Misfit, samples: Samples) -> bool:
    """Whether light of this shape in this place is more than noise; how well its shape is known is another question."""
    share = found.jacobian[3]
    variance = samples.correlation_px2 * max(1.0, quality.ratio) / np.vdot(share * found.weight, share)
    return found.parameters[3] > MIN_FLUX_OVER_SIGMA * math.sqrt(variance)


def _peak(flux: float, blur: float, half: float) -> float:
    """Height in the middle of a profile."""
    still = flux / (2 * math.pi * blur**2)
    if half == 0:
        return still
    reach = half / (math.sqrt(2) * blur)
    return still * math.sqrt(math.pi) * math.erf(reach) / (2 * reach)
