"""Laser beams in the world: where they end, and how that end moves with measurement and calibration.

At one tilt a beam's end is linear in five numbers of its measurement, (1, x, y, cos, sin) with x and y its end in the
scan plane; what multiplies them depends on the tilt alone. So a scan costs one small matrix for its tilt and one matrix
product for its beams. Arrays have the beam as their last axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lrf_stereo.noise import LrfNoise
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.scanner_part import SCANNER_TANGENT, across
from network_calib.observations import FloatArray, IntArray

N_SCANNER = len(SCANNER_TANGENT)
# Beams whose matrices are gathered at once where every beam has a tilt of its own.
GATHERED_BEAMS = 4096


@dataclass(frozen=True, slots=True)
class TiltedScanner:
    """A scanner at T different tilts: all that does not depend on the beam.

    Attributes:
        scanner: the scanner.
        tilts_rad: (T,) reported tilts.
        turn: (T, 3, 3) rotations about the tilt axis.
        rotation: (T, 3, 3) world_from_lrf.
        origin: (T, 3) mirror in world.
    """

    scanner: TiltingScanner
    tilts_rad: FloatArray
    turn: FloatArray
    rotation: FloatArray
    origin: FloatArray

    @classmethod
    def of(cls, scanner: TiltingScanner, tilts_rad: FloatArray) -> TiltedScanner:
        """Turn the scanner by Rodrigues' formula."""
        pose, foot, n = scanner.world_from_lrf.as_matrix(), scanner.axis_point_in_world, scanner.axis_direction_in_world
        angle = scanner.tilt_gain * (tilts_rad - scanner.reference_tilt_rad)
        cosine, sine, outer = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None], n[:, None] * n
        turn = sine * _skew(n) + cosine * (np.eye(3) - outer) + outer
        return cls(scanner, tilts_rad, turn, turn @ pose[:3, :3], turn @ (pose[:3, 3] - foot) + foot)

    def factors_of_ends(self) -> FloatArray:
        """(T, 3, 3) factors of the terms 1, x, y of a beam, whose sum is its end in world."""
        return np.concatenate([self.origin[:, :, None], self.rotation[:, :, :2]], axis=2)

    def factors_of_slopes(self) -> FloatArray:
        """(T, 45, 5) factors of a beam's terms, whose sums are the derivatives (15, 3) of its end by the scanner."""
        slope = self._slope_of_terms() @ self._by_scanner()[:, None]
        return slope.transpose(0, 3, 2, 1).reshape(len(slope), -1, 5)

    def factors_of_spread(self, noise: LrfNoise | None, scanner_covariance: FloatArray | None) -> FloatArray:
        """(T, 9, 25) factors of products of a beam's terms, whose sums are the covariance (3, 3) of its end in world.

        Of what is given, all but the noise of the range: that depends on the beam.
        """
        n_tilts = len(self.turn)
        of_scan = np.zeros((n_tilts, 8, 8))
        if scanner_covariance is not None:
            by_scanner = self._by_scanner()
            of_scan += by_scanner @ scanner_covariance @ by_scanner.transpose(0, 2, 1)
        if noise is not None:
            # A bearing's error is a turn about the scan plane's normal, a tilt's a turn about the axis.
            by_tilt, by_bearing = self._by_tilt(), np.zeros((n_tilts, 8))
            by_bearing[:, 3:6] = self.rotation[:, :, 2]
            of_scan += noise.tilt_rad**2 * by_tilt[:, :, None] * by_tilt[:, None]
            of_scan += noise.bearing_rad**2 * by_bearing[:, :, None] * by_bearing[:, None]
        slope = self._slope_of_terms().reshape(n_tilts, 15, 8)
        products = (slope @ of_scan @ slope.transpose(0, 2, 1)).reshape(n_tilts, 5, 3, 5, 3)
        return products.transpose(0, 2, 4, 1, 3).reshape(n_tilts, 9, 25)

    def _by_scanner(self) -> FloatArray:
        """(T, 8, 15) derivative of (shift of the mirror, turn about it, range bias, range scale) by the scanner.

        The clock offset moves no point that stands still: its column stays zero.
        """
        out = np.zeros((len(self.turn), 8, N_SCANNER))
        basis, arm = across(self.scanner.axis_direction_in_world), self.origin - self.scanner.axis_point_in_world
        out[:, 3:6, 0:3] = self.turn
        out[:, 0:3, 3:6] = self.turn
        # The axis turns by psi = n x change: exp(psi) R exp(-psi) turns what it carries by psi - R psi, about the foot.
        psi = _skew(self.scanner.axis_direction_in_world) @ basis
        out[:, 3:6, 6:8] = psi - self.turn @ psi
        out[:, 0:3, 6:8] = -_skew(arm) @ out[:, 3:6, 6:8]
        out[:, 0:3, 8:10] = basis - self.turn @ basis
        swing = (self.tilts_rad - self.scanner.reference_tilt_rad) / self.scanner.tilt_gain
        out[:, :, 10] = self._by_tilt() * swing[:, None]
        out[:, 6, 11] = out[:, 7, 12] = 1.0
        out[:, 3:6, 13] = -self.rotation[:, :, 2]
        return out

    def _by_tilt(self) -> FloatArray:
        """(T, 8) the same derivative by the reported tilt."""
        out = np.zeros((len(self.turn), 8))
        direction = self.scanner.axis_direction_in_world
        out[:, 0:3] = (self.origin - self.scanner.axis_point_in_world) @ _skew(direction).T
        out[:, 3:6] = direction
        return self.scanner.tilt_gain * out

    def _slope_of_terms(self) -> FloatArray:
        """(T, 5, 3, 8): derivative of each term's factor by (shift of the mirror, turn about it, range bias, scale)."""
        out = np.zeros((len(self.turn), 5, 3, 8))
        out[:, 0, :, :3] = np.eye(3)
        for k in range(2):
            axis = self.rotation[:, :, k]
            out[:, 1 + k, :, 3:6] = -_skew(axis)
            out[:, 1 + k, :, 7] = out[:, 3 + k, :, 6] = -axis / self.scanner.range_scale
        return out


@dataclass(frozen=True, slots=True)
class Beams:
    """N beam ends.

    Attributes:
        tilted: the scanner at the beams' tilts.
        tilt_of: (N,) index of each beam's tilt; None where there is only one.
        range_m: (N,) measured ranges.
        terms: (5, N) the numbers 1, x, y, cos, sin of the true range and bearing.
    """

    tilted: TiltedScanner
    tilt_of: IntArray | None
    range_m: FloatArray
    terms: FloatArray

    @classmethod
    def of(cls, tilted: TiltedScanner, tilt_of: IntArray | None, range_m: FloatArray, bearing_rad: FloatArray) -> Beams:
        """Beams of measured ranges and bearings (N,)."""
        scanner = tilted.scanner
        terms = np.ones((5, len(range_m)))
        true_bearing = bearing_rad - scanner.bearing_zero_rad
        np.cos(true_bearing, out=terms[3])
        np.sin(true_bearing, out=terms[4])
        np.multiply((range_m - scanner.range_bias_m) / scanner.range_scale, terms[3:], out=terms[1:3])
        return cls(tilted, tilt_of, range_m, terms)

    def ends_in_world(self) -> FloatArray:
        """(3, N) points."""
        return self._sum(self.tilted.factors_of_ends(), self.terms[:3])

    def by_scanner(self) -> FloatArray:
        """(15, 3, N) derivative of the ends by the scanner's parameters, in the order of SCANNER_TANGENT."""
        return self._sum(self.tilted.factors_of_slopes(), self.terms).reshape(N_SCANNER, 3, -1)

    def covariance(self, factors: FloatArray, noise: LrfNoise | None) -> FloatArray:
        """(3, 3, N) covariance of the ends in world, m^2, from the tilts' `factors_of_spread` and the range's noise."""
        squares = (self.terms[:, None] * self.terms).reshape(25, -1)
        out = self._sum(factors, squares).reshape(3, 3, -1)
        if noise is not None:
            along = self._sum(self.tilted.rotation[:, :, :2], self.terms[3:])
            along *= noise.range_m(self.range_m) / self.tilted.scanner.range_scale
            out += along[:, None] * along
        return out

    def _sum(self, factors: FloatArray, terms: FloatArray) -> FloatArray:
        """(k, N) sums of terms (m, N) with the factors (T, k, m) of each beam's tilt."""
        if self.tilt_of is None:
            return factors[0] @ terms
        out = np.empty((factors.shape[1], terms.shape[1]))
        for begin in range(0, out.shape[1], GATHERED_BEAMS):
            columns = slice(begin, begin + GATHERED_BEAMS)
            np.einsum("nkm,mn->kn", factors[self.tilt_of[columns]], terms[:, columns], out=out[:, columns])
        return out


@dataclass(frozen=True, slots=True)
class Measurements:
    """Measurements of a shape S, flattened to N; `tilts_rad` (T,) are the different tilts, `tilt_of` as in `Beams`."""

    shape: tuple[int, ...]
    range_m: FloatArray
    bearing_rad: FloatArray
    tilts_rad: FloatArray
    tilt_of: IntArray | None

    @classmethod
    def of(cls, range_m: npt.ArrayLike, bearing_rad: npt.ArrayLike, tilt_rad: npt.ArrayLike) -> Measurements:
        """Flatten measurements of any shapes that broadcast."""
        rho, theta, tilt = (np.asarray(a, dtype=np.float64) for a in (range_m, bearing_rad, tilt_rad))
        shape = np.broadcast_shapes(rho.shape, theta.shape, tilt.shape)
        if tilt.size == 1:
            tilts, tilt_of = tilt.ravel(), None
        else:
            tilts, inverse = np.unique(tilt, return_inverse=True)
            tilt_of = np.broadcast_to(inverse.reshape(tilt.shape), shape).ravel()
        if not rho.shape == theta.shape == shape:
            rho, theta = np.broadcast_to(rho, shape), np.broadcast_to(theta, shape)
        return cls(shape, rho.ravel(), theta.ravel(), tilts, tilt_of)


def _skew(vector: FloatArray) -> FloatArray:
    """(..., 3, 3) matrices that multiply as the cross product with vectors (..., 3) on the left."""
    out = np.zeros((*vector.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = vector[..., 0], vector[..., 1], vector[..., 2]
    return out - np.swapaxes(out, -1, -2)
