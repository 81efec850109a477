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
class ScannerFrame:
    """A scanner with what is the same for all its scans.

    Attributes:
        scanner: the scanner.
        pose: (4, 4) world_from_lrf at the reference tilt.
        across: (3, 2) unit vectors across the tilt axis.
        skew: (3, 3) the cross product with the axis.
        outer: (3, 3) the projection onto the axis.
    """

    scanner: TiltingScanner
    pose: FloatArray
    across: FloatArray
    skew: FloatArray
    outer: FloatArray

    @classmethod
    def of(cls, scanner: TiltingScanner) -> ScannerFrame:
        """Take a scanner."""
        n = scanner.axis_direction_in_world
        return cls(scanner, scanner.world_from_lrf.as_matrix(), across(n), _skew(n), n[:, None] * n)

    def turns(self, angle_rad: FloatArray) -> FloatArray:
        """(T, 3, 3) rotations about the axis by angles (T,): Rodrigues' formula."""
        cosine, sine = np.cos(angle_rad)[:, None, None], np.sin(angle_rad)[:, None, None]
        return sine * self.skew + cosine * (np.eye(3) - self.outer) + self.outer


@dataclass(frozen=True, slots=True)
class Beams:
    """N beam ends at T different tilts.

    Attributes:
        frame: the scanner.
        range_m: (N,) measured ranges.
        terms: (5, N) the numbers 1, x, y, cos, sin of the true range and bearing.
        tilt_of: (N,) index of the tilt; None where there is only one.
        swing_rad: (T,) reported tilts over the reference tilt.
        turn: (T, 3, 3) rotations about the tilt axis.
        rotation: (T, 3, 3) world_from_lrf.
        origin: (T, 3) mirror in world.
    """

    frame: ScannerFrame
    range_m: FloatArray
    terms: FloatArray
    tilt_of: IntArray | None
    swing_rad: FloatArray
    turn: FloatArray
    rotation: FloatArray
    origin: FloatArray

    @classmethod
    def of(
        cls,
        frame: ScannerFrame,
        range_m: FloatArray,
        bearing_rad: FloatArray,
        tilts_rad: FloatArray,
        tilt_of: IntArray | None,
    ) -> Beams:
        """Beams of measured ranges and bearings (N,) at the tilts `tilts_rad` (T,)."""
        scanner, pose, foot = frame.scanner, frame.pose, frame.scanner.axis_point_in_world
        swing = tilts_rad - scanner.reference_tilt_rad
        turn = frame.turns(scanner.tilt_gain * swing)
        terms = np.ones((5, len(range_m)))
        true_bearing = bearing_rad - scanner.bearing_zero_rad
        np.cos(true_bearing, out=terms[3])
        np.sin(true_bearing, out=terms[4])
        np.multiply((range_m - scanner.range_bias_m) / scanner.range_scale, terms[3:], out=terms[1:3])
        return cls(frame, range_m, terms, tilt_of, swing, turn, turn @ pose[:3, :3], turn @ (pose[:3, 3] - foot) + foot)

    def ends_in_world(self) -> FloatArray:
        """(3, N) points."""
        return self._sum(np.concatenate([self.origin[:, :, None], self.rotation[:, :, :2]], axis=2), self.terms[:3])

    def by_scanner(self) -> FloatArray:
        """(14, 3, N) derivative of the ends by the scanner's parameters, in the order of SCANNER_TANGENT."""
        slope = self._slope_of_terms() @ self._by_scanner()[:, None]
        n_tilts = len(slope)
        return self._sum(slope.transpose(0, 3, 2, 1).reshape(n_tilts, -1, 5), self.terms).reshape(N_SCANNER, 3, -1)

    def covariance(self, noise: LrfNoise | None, scanner_covariance: FloatArray | None) -> FloatArray:
        """(3, 3, N) covariance of the ends in world, m^2, from what is given: noise, and the scanner's (14, 14)."""
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
        squares = (self.terms[:, None] * self.terms).reshape(25, -1)
        out = self._sum(products.transpose(0, 2, 4, 1, 3).reshape(n_tilts, 9, 25), squares).reshape(3, 3, -1)
        if noise is not None:
            along = self._sum(self.rotation[:, :, :2], self.terms[3:])
            along *= noise.range_m(self.range_m) / self.frame.scanner.range_scale
            out += along[:, None] * along
        return out

    def _by_scanner(self) -> FloatArray:
        """(T, 8, 14) derivative of (shift of the mirror, turn about it, range bias, range scale) by the scanner."""
        out = np.zeros((len(self.turn), 8, N_SCANNER))
        basis, arm = self.frame.across, self.origin - self.frame.scanner.axis_point_in_world
        out[:, 3:6, 0:3] = self.turn
        out[:, 0:3, 3:6] = self.turn
        # The axis turns by psi = n x change: exp(psi) R exp(-psi) turns what it carries by psi - R psi, about the foot.
        psi = np.stack([basis[:, 1], -basis[:, 0]], axis=1)
        out[:, 3:6, 6:8] = psi - self.turn @ psi
        out[:, 0:3, 6:8] = -_skew(arm) @ out[:, 3:6, 6:8]
        out[:, 0:3, 8:10] = basis - self.turn @ basis
        out[:, :, 10] = self._by_tilt() * (self.swing_rad / self.frame.scanner.tilt_gain)[:, None]
        out[:, 6, 11] = out[:, 7, 12] = 1.0
        out[:, 3:6, 13] = -self.rotation[:, :, 2]
        return out

    def _by_tilt(self) -> FloatArray:
        """(T, 8) the same derivative by the reported tilt."""
        out = np.zeros((len(self.turn), 8))
        out[:, 0:3] = (self.origin - self.frame.scanner.axis_point_in_world) @ self.frame.skew.T
        out[:, 3:6] = self.frame.scanner.axis_direction_in_world
        return self.frame.scanner.tilt_gain * out

    def _slope_of_terms(self) -> FloatArray:
        """(T, 5, 3, 8): derivative of each term's factor by (shift of the mirror, turn about it, range bias, scale)."""
        out = np.zeros((len(self.turn), 5, 3, 8))
        out[:, 0, :, :3] = np.eye(3)
        for k in range(2):
            axis = self.rotation[:, :, k]
            out[:, 1 + k, :, 3:6] = -_skew(axis)
            out[:, 1 + k, :, 7] = out[:, 3 + k, :, 6] = -axis / self.frame.scanner.range_scale
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


def flat_beams(
    frame: ScannerFrame, range_m: npt.ArrayLike, bearing_rad: npt.ArrayLike, tilt_rad: npt.ArrayLike
) -> tuple[Beams, tuple[int, ...]]:
    """Beams of measurements of any shapes that broadcast, flattened, and the common shape."""
    rho, theta, tilt = (np.asarray(a, dtype=np.float64) for a in (range_m, bearing_rad, tilt_rad))
    shape = np.broadcast_shapes(rho.shape, theta.shape, tilt.shape)
    if tilt.size == 1:
        tilts, tilt_of = tilt.ravel(), None
    else:
        tilts, inverse = np.unique(tilt, return_inverse=True)
        tilt_of = np.broadcast_to(inverse.reshape(tilt.shape), shape).ravel()
    if not rho.shape == theta.shape == shape:
        rho, theta = np.broadcast_to(rho, shape), np.broadcast_to(theta, shape)
    rho, theta = rho.ravel(), theta.ravel()
    return Beams.of(frame, rho, theta, tilts, tilt_of), shape


def _skew(vector: FloatArray) -> FloatArray:
    """(..., 3, 3) matrices that multiply as the cross product with vectors (..., 3) on the left."""
    out = np.zeros((*vector.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = vector[..., 0], vector[..., 1], vector[..., 2]
    return out - np.swapaxes(out, -1, -2)
