"""Vectors measured with known noise, each judged beside the others: what is signal, and what only looks like it.

    u = v + n,  n ~ N(0, N) with N known of each,  v ~ N(m, s^2 I) with one m and s for all,  m ~ N(0, t^2 I)

Then v has the mean m + s^2 (s^2 I + N)^-1 (u - m): a precise u stays as it is, and a coarse one becomes what is usual.
A slope that is fitted to such means is not flattened by noise, nor as sure of itself as if there were none. The sizes t
and s are those of maximum likelihood: zero when the vectors show no more than noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.observations import FloatArray

# Squares down to 10^-15 of the largest; variances that keep a quotient finite; rounds of mean and size, each of which
# depends on the other weakly.
N_BISECTIONS, TINY, N_ROUNDS = 50, 1e-30, 8


@dataclass(frozen=True, slots=True)
class Usual:
    """What vectors are before one of them is measured.

    Attributes:
        mean: (3,).
        mean_covariance: (3, 3) of the mean.
        variance: on each axis, around the mean.
    """

    mean: FloatArray
    mean_covariance: FloatArray
    variance: float


@dataclass(frozen=True, slots=True)
class NoisyVectors:
    """n measured vectors, and their noise along its own axes.

    Attributes:
        value: (n, 3).
        variances: (n, 3) of the noise.
        axes: (n, 3, 3) in the columns.
    """

    value: FloatArray
    variances: FloatArray
    axes: FloatArray

    @classmethod
    def of(cls, value: FloatArray, noise: FloatArray) -> NoisyVectors:
        """From vectors (n, 3) with covariances (n, 3, 3)."""
        variances, axes = np.linalg.eigh(noise)
        return cls(value, variances, axes)

    def usual(self, variance_of_none: float) -> Usual:
        """Mean and variance of most likelihood, or one without mean where nothing is measured."""
        nothing = np.zeros((3, 3))
        if not len(self.value):
            return Usual(nothing[0], nothing, variance_of_none)
        # Nothing beyond noise leaves no mean either.
        around_zero = self.size2()
        usual = Usual(nothing[0], nothing, around_zero)
        for _ in range(N_ROUNDS if around_zero > 0 else 0):
            weight = 1 / np.maximum(usual.variance + self.variances, TINY)
            weights = (self.axes * weight[:, None, :]) @ self.axes.transpose(0, 2, 1)
            covariance = np.asarray(np.linalg.inv(weights.sum(axis=0) + np.eye(3) / around_zero), dtype=np.float64)
            mean = covariance @ np.einsum("nij,nj->i", weights, self.value)
            usual = Usual(mean, covariance, self.size2(mean))
        return usual

    def size2(self, mean: FloatArray | None = None) -> float:
        """The s^2 >= 0 of most likelihood for vectors of variance s^2 on each axis around a mean (3,), by default zero.

        It is where the sum of (deviation^2 - total) / total^2 is zero, total = s^2 + variances.
        """
        squares = self._along(0.0 if mean is None else mean) ** 2

        def pull(size2: float) -> float:
            total = np.maximum(size2 + self.variances, TINY)
            return float(((squares - total) / total**2).sum())

        # Beyond the largest square every term pulls down; if they do so at zero already, there is nothing but noise.
        low, high = 0.0, float(squares.max())
        if pull(0.0) <= 0:
            return 0.0
        for _ in range(N_BISECTIONS):
            middle = (low + high) / 2
            low, high = (middle, high) if pull(middle) > 0 else (low, middle)
        return low

    def expected(self, usual: Usual) -> tuple[FloatArray, FloatArray]:
        """(n, 3) means and (n, 3, 3) covariances of the vectors, once measured."""
        share = usual.variance / np.maximum(usual.variance + self.variances, TINY)
        mean = usual.mean + np.einsum("nij,nj->ni", self.axes, share * self._along(usual.mean))
        own = (self.axes * (share * self.variances)[:, None, :]) @ self.axes.transpose(0, 2, 1)
        left = (self.axes * (1 - share)[:, None, :]) @ self.axes.transpose(0, 2, 1)
        return mean, own + left @ usual.mean_covariance @ left

    def _along(self, mean: FloatArray | float) -> FloatArray:
        """(n, 3) deviations from a mean along the axes."""
        return np.einsum("nji,nj->ni", self.axes, self.value - mean)
