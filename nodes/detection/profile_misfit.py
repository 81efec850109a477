"""How far the residuals of a fit exceed the noise, where its position comes from.

A glowing ball is no Gaussian: its residuals exceed the noise, but alike on both sides of its centre, and push the
position nowhere. Only what the residuals differ by between opposite pixels speaks against a position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nodes.detection.profile_fit import Fit
from nodes.detection.spots import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Misfit:
    """Mean squared residuals over their variance, weighted by how much each sample tells of the position.

    Attributes:
        ratio: 1 where the model and the noise are as assumed.
        leverage: (N,) the weights: Fisher information of the position.
    """

    ratio: float
    leverage: FloatArray

    @property
    def is_significant(self) -> bool:
        """Above what noise alone gives in about 98 % of fits."""
        n_telling = self.leverage.sum() ** 2 / (self.leverage @ self.leverage)
        return self.ratio > 1 + 2 * math.sqrt(2 / n_telling)


def misfit(found: Fit) -> Misfit:
    """Of all that the residuals hold."""
    weight, jacobian = found.weight, found.jacobian
    leverage = weight * (jacobian[0] * jacobian[0] + jacobian[1] * jacobian[1])
    leveraged = leverage * weight
    # A fit follows the noise: of the variance of a sample it leaves 1 - w J' C J.
    followed = np.vdot(found.covariance, (jacobian * leveraged) @ jacobian.T)
    residual = found.residual
    return Misfit(float(leveraged @ (residual * residual) / (leverage.sum() - followed)), leverage)


def odd_misfit(found: Fit, leverage: FloatArray, shape: tuple[int, int]) -> float:
    """The ratio of the part that is not alike on both sides of the centre.

    The residuals are turned by half a turn about the fitted centre, linearly interpolated, and subtracted. Where the
    opposite pixel is outside the window or tells nothing, the residual stands alone.
    """
    whitened = found.residual * np.sqrt(found.weight)
    opposite, share = _turned(whitened.reshape(shape), (found.weight > 0).reshape(shape), found.parameters[:2])
    difference = whitened - opposite.ravel()
    return float(leverage @ (difference * difference / (1.0 + share.ravel())) / leverage.sum())


def _turned(image: FloatArray, is_known: BoolArray, centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(h, w) the image turned by half a turn about x, y, and the variance of white noise in it; 0 where unknown."""
    height, width = image.shape
    whole = np.floor(2 * centre).astype(int)
    along_x, along_y = 2 * centre - whole
    x = whole[0] - np.arange(width)
    y = (whole[1] - np.arange(height))[:, None]
    turned, variance = np.zeros_like(image), np.zeros_like(image)
    is_complete = np.ones(image.shape, dtype=bool)
    for dx, share_x in ((0, 1 - along_x), (1, along_x)):
        for dy, share_y in ((0, 1 - along_y), (1, along_y)):
            at_x, at_y = np.clip(x + dx, 0, width - 1), np.clip(y + dy, 0, height - 1)
            is_complete &= (at_x == x + dx) & (at_y == y + dy) & is_known[at_y, at_x]
            turned += share_x * share_y * image[at_y, at_x]
            variance += (share_x * share_y) ** 2
    return turned * is_complete, variance * is_complete
