"""Robust losses rho(s) of the squared norm s of one whitened observation, for iteratively reweighted least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from network_calib.observations import FloatArray


class Loss(Protocol):
    """A loss rho with rho(s) = s near zero; its weight is d rho / d s."""

    def cost(self, s: FloatArray) -> FloatArray:
        """rho(s) for each squared norm."""
        ...

    def weight(self, s: FloatArray) -> FloatArray | None:
        """d rho / d s for each squared norm; None means one everywhere."""
        ...


@dataclass(frozen=True, slots=True)
class SquaredLoss:
    """Plain least squares."""

    def cost(self, s: FloatArray) -> FloatArray:
        """s itself."""
        return s

    def weight(self, s: FloatArray) -> FloatArray | None:  # noqa: ARG002 - the protocol's signature
        """None: every weight is one."""
        return None


@dataclass(frozen=True, slots=True)
class CauchyLoss:
    """c^2 log(1 + s/c^2): bounded influence, falling for gross errors. `scale` c is in standard deviations."""

    scale: float

    def cost(self, s: FloatArray) -> FloatArray:
        """c^2 log(1 + s/c^2)."""
        c2 = self.scale**2
        return c2 * np.log1p(s / c2)

    def weight(self, s: FloatArray) -> FloatArray | None:
        """1 / (1 + s/c^2)."""
        return 1.0 / (1.0 + s / self.scale**2)


@dataclass(frozen=True, slots=True)
class HuberLoss:
    """Squared up to `scale` standard deviations, linear beyond."""

    scale: float

    def cost(self, s: FloatArray) -> FloatArray:
        """s up to c^2, then 2 c sqrt(s) - c^2."""
        c = self.scale
        return np.where(s <= c * c, s, 2 * c * np.sqrt(s) - c * c)

    def weight(self, s: FloatArray) -> FloatArray | None:
        """1 up to c^2, then c / sqrt(s)."""
        return np.minimum(1.0, self.scale / np.sqrt(np.maximum(s, 1e-300)))
