"""What a spot looks like on the pixels: a Gaussian that stands still, and one that moves during the exposure.

Each model gives the light on every pixel of a window and its derivatives by the parameters. Pixel coordinates are those
of the window: x to the right, y down, (0, 0) the centre of its top-left pixel. Flux is the light of the whole spot in
counts; the last parameter is a constant by which the background was misjudged.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from nodes.detection.spots import FloatArray

ROOT_TAU = math.sqrt(2 * math.pi)
PIXEL_VARIANCE = 1 / 12  # of a box one pixel wide, px²
MIN_WIDTH_PX, MAX_WIDTH_PX = 0.2, 60.0
# A smear shorter than this share of the width is one of second order only: its direction has lost its meaning.
MIN_SMEAR_OVER_WIDTH = 0.05


class Light(NamedTuple):
    """A model at some parameters, on N pixels.

    Attributes:
        signal: (N,) light of the spot, counts, without the constant.
        jacobian: (P, N) derivatives of signal + constant by the parameters.
    """

    signal: FloatArray
    jacobian: FloatArray


class StillSpot:
    """A round Gaussian, integrated over each pixel. Parameters: x, y, width, flux, constant."""

    n_parameters = 5

    def __init__(self, shape: tuple[int, int]) -> None:
        self._height, self._width = shape
        # Both axes in one array, for half the calls; the shorter one goes on past the window.
        self._edges = np.arange(max(shape) + 1.0) - 0.5
        self._jacobian = np.empty((5, *shape))
        self._jacobian[4] = 1.0
        self._rows = np.empty((3, 2, max(shape) + 1))

    def light(self, parameters: FloatArray) -> Light:
        """The light and its derivatives; the arrays are used again by the next call."""
        flux = parameters[3]
        along_x, along_y = self._marginals(parameters)
        jacobian = self._jacobian
        lit_y = flux * along_y
        # Both products of an outer product at once: derivatives of the x share, times the y share.
        np.multiply(along_x[1], lit_y[0], out=jacobian[0])
        np.multiply(along_x[0], lit_y[1], out=jacobian[1])
        np.multiply(along_x[2], lit_y[0], out=jacobian[2])
        jacobian[2] += along_x[0] * lit_y[2]
        np.multiply(along_x[0], along_y[0], out=jacobian[3])
        flat = jacobian.reshape(5, -1)
        return Light(flux * flat[3], flat)

    def elongation(self, parameters: FloatArray) -> FloatArray:
        """(2, N) derivatives by d and e, where [[d, e], [e, -d]] px² is what the covariance of the profile gains.

        By the heat equation they are half of f_xx - f_yy, and f_xy; and width f_xx is the derivative by the width.
        """
        flux, width = parameters[3], parameters[2]
        along_x, along_y = self._marginals(parameters)
        lit_y = flux * along_y
        columns = np.empty((2, self._height, self._width))
        columns[0] = along_x[2] * lit_y[0] - along_x[0] * lit_y[2]
        columns[0] *= 1 / (2 * width)
        np.multiply(along_x[1], lit_y[1], out=columns[1])
        return columns.reshape(2, -1)

    @staticmethod
    def limits(parameters: FloatArray) -> FloatArray:
        """(5,) largest step of each parameter that the linearisation may be trusted with."""
        width, flux = parameters[2], parameters[3]
        return np.array([width, width, 0.5 * width, 0.8 * flux, np.inf])

    @staticmethod
    def is_sound(parameters: FloatArray) -> bool:
        """Whether the parameters still describe a spot."""
        return MIN_WIDTH_PX < parameters[2] < MAX_WIDTH_PX

    def _marginals(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(3, w) and (3, h, 1): share of the light in each column and row; its derivatives by centre and by width."""
        inverse_width = 1.0 / parameters[2]
        rows = self._rows
        z = self._edges - parameters[:2, None]
        z *= inverse_width
        ndtr(z, out=rows[0])
        density = z * z
        density *= -0.5
        np.exp(density, out=density)
        np.multiply(density, -inverse_width / ROOT_TAU, out=rows[1])
        np.multiply(z, rows[1], out=rows[2])
        shares = rows[:, :, 1:] - rows[:, :, :-1]
        return shares[:, 0, : self._width], shares[:, 1, : self._height, None]


class MovingSpot:
    """A round Gaussian drawn along a straight line at constant speed.

    Parameters: x, y of the middle, width, flux, half the length of the way, its angle, constant. The pixel is taken
    into account by its variance: a box is turned into a Gaussian, which for a blurred edge is as good.
    """

    n_parameters = 7

    def __init__(self, shape: tuple[int, int]) -> None:
        height, width = shape
        self._x = np.tile(np.arange(float(width)), height)
        self._y = np.repeat(np.arange(float(height)), width)
        self._jacobian = np.empty((7, height * width))
        self._jacobian[6] = 1.0
        self._ends = np.empty((2, height * width))

    def light(self, parameters: FloatArray) -> Light:
        """The light and its derivatives; the arrays are used again by the next call."""
        x, y, width, flux, half, angle = parameters[:6].tolist()
        blur = math.sqrt(width**2 + PIXEL_VARIANCE)
        cosine, sine = math.cos(angle) / blur, math.sin(angle) / blur
        dx, dy = self._x - x, self._y - y
        # Along and across the way, and the distances to its ends, all in units of the blur.
        u = cosine * dx + sine * dy
        v = cosine * dy - sine * dx
        z = self._ends
        np.add(u, half / blur, out=z[0])
        np.subtract(u, half / blur, out=z[1])
        density = np.exp(z * z * -0.5)
        v2 = v * v
        across = np.exp(v2 * -0.5)
        across *= flux / (2 * half * blur * ROOT_TAU)
        cumulated = ndtr(z)
        signal = (cumulated[0] - cumulated[1]) * across
        density *= across * (1 / (blur * ROOT_TAU))
        by_u = density[0] - density[1]
        by_v = signal * v
        by_v *= -1 / blur
        z *= density
        jacobian = self._jacobian
        jacobian[0] = (sine * blur) * by_v - (cosine * blur) * by_u
        jacobian[1] = (-sine * blur) * by_u - (cosine * blur) * by_v
        jacobian[2] = (width / blur**2) * (signal * (v2 - 1.0)) - (width / blur) * (z[0] - z[1])
        np.multiply(signal, 1 / flux, out=jacobian[3])
        jacobian[4] = density[0] + density[1] - signal * (1 / half)
        jacobian[5] = blur * (by_u * v - by_v * u)
        return Light(signal, jacobian)

    @staticmethod
    def limits(parameters: FloatArray) -> FloatArray:
        """(7,) largest step of each parameter that the linearisation may be trusted with."""
        width, flux, half = parameters[2:5].tolist()
        return np.array([width, width, 0.5 * width, 0.8 * flux, 0.5 * half, min(0.5, width / half), np.inf])

    @staticmethod
    def is_sound(parameters: FloatArray) -> bool:
        """Whether the parameters still describe a smeared spot."""
        width, half = parameters[2], parameters[4]
        return MIN_WIDTH_PX < width < MAX_WIDTH_PX and half > MIN_SMEAR_OVER_WIDTH * width
