"""Fitting a model of the light to the samples of a window: Fisher scoring, with samples at full scale left out.

What a full sample says is "at least so much". To use even that much gains nothing in the position of a Gaussian, and a
column that blooms then draws the position along by more than a pixel (`benchmarks/spot_profile.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import get_lapack_funcs

from nodes.detection.profile_models import Light
from nodes.detection.spots import BoolArray, FloatArray

# Directly, because checks and copies around them cost more than five equations do.
_posv, _potrf, _potri = get_lapack_funcs(("posv", "potrf", "potri"), dtype=np.float64)

MAX_STEPS = 25
# Squared length of a step in standard deviations: what is left after a step of a tenth is far below a hundredth.
CONVERGED = 1e-2


class LightModel(Protocol):
    """A spot's light as a function of parameters: x and y first, flux fourth, the constant last."""

    def light(self, parameters: FloatArray) -> Light:
        """Light and derivatives on N pixels; the arrays are used again by the next call."""
        ...

    def limits(self, parameters: FloatArray) -> FloatArray:
        """Largest step of each parameter."""
        ...

    def is_sound(self, parameters: FloatArray) -> bool:
        """Whether the parameters still describe a spot."""
        ...


@dataclass(frozen=True, slots=True)
class Samples:
    """N samples of a window.

    Attributes:
        light: (N,) counts over the background.
        variance: of a sample without the spot's light, counts²: one number or (N,).
        gain: counts² that each count of light adds.
        is_full: (N,) samples at full scale, which tell nothing; None where there is none.
        correlation_px2: area over which samples err together; the fit weighs them as if each erred alone.
    """

    light: FloatArray
    variance: float | FloatArray
    gain: float
    is_full: BoolArray | None
    correlation_px2: float = 1.0


@dataclass(frozen=True, slots=True)
class Fit:
    """The optimum of a model, P parameters, N samples.

    Attributes:
        parameters: (P,).
        covariance: (P, P) inverse of the Fisher information.
        jacobian: (P, N); valid until the model is asked again.
        residual: (N,) counts, sample less model.
        weight: (N,) inverse variance of the samples; 0 for those that tell nothing.
    """

    parameters: FloatArray
    covariance: FloatArray
    jacobian: FloatArray
    residual: FloatArray
    weight: FloatArray


def fit(model: LightModel, start: FloatArray, samples: Samples) -> Fit | None:
    """The optimum near `start`; None where there is none that describes a spot."""
    parameters = start
    for _ in range(MAX_STEPS):
        jacobian, residual, weight = _linearise(model, parameters, samples)
        weighted = jacobian * weight
        information = weighted @ jacobian.T
        gradient = weighted @ residual
        _, step, failed = _posv(information, gradient)
        if failed:
            return None
        if step @ gradient < CONVERGED:
            covariance = _inverse(information)
            return None if covariance is None else Fit(parameters + step, covariance, jacobian, residual, weight)
        excess = np.abs(step / model.limits(parameters)).max()
        parameters = parameters + (step / excess if excess > 1 else step)
        if not model.is_sound(parameters):
            return None
    return None


def own_gain(found: Fit, samples: Samples) -> float:
    """Counts² of variance for each count of light, from the residuals of a fit without; 0 where nothing tells of it."""
    signal = found.jacobian[3] * (found.weight > 0)
    excess = found.residual**2 - samples.variance
    return max(float(signal @ excess / (signal @ signal)) / found.parameters[3], 0.0)


def _linearise(
    model: LightModel, parameters: FloatArray, samples: Samples
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Jacobian (P, N), residual (N,) and weight (N,) at the parameters."""
    signal, jacobian = model.light(parameters)
    residual = samples.light - signal
    residual -= parameters[-1]
    weight = 1.0 / (samples.gain * signal + samples.variance)
    if samples.is_full is not None:
        weight[samples.is_full] = 0.0
    return jacobian, residual, weight


def _inverse(information: FloatArray) -> FloatArray | None:
    factor, failed = _potrf(information, lower=1)
    if failed:
        return None
    lower, failed = _potri(factor, lower=1)
    # Only the lower triangle is filled; the other still holds zeros.
    return None if failed else lower + np.tril(lower, -1).T
