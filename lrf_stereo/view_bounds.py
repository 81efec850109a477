"""How far to each side a camera sees: bounds that no valid pixel's ray exceeds, whatever the distortion.

Up to where the lens folds back, the radial part of the distortion maps rays to the image one to one, so the rays that
reach farthest to a side belong to the image's border. The border is cut into short pieces; over a piece, radius and
azimuth lie between bounds, and so does the angle to the side: intervals, not samples, so that nothing falls between.
The tangential part p1, p2 moves a point by no more than 3 |p| r^2; the border is moved outwards by as much.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lrf_stereo.lens_arrays import Brown, KannalaBrandt
from network_calib.cameras import Cameras
from network_calib.observations import FloatArray

# Right, down, left, up in the image: azimuths from x towards y.
SIDES_RAD = np.pi / 2 * np.arange(4)
# A piece is a 128th of a side of the image, a ring at most 90 / 256 degrees: together some 0.7 degrees too much.
N_PIECES, N_RINGS = 128, 256
# Moves the border outwards against rounding, in units of the focal length.
SLACK = 1e-9


def side_bounds(cameras: Cameras) -> FloatArray:
    """(C, 4) largest angle of a valid pixel's ray towards each of SIDES_RAD, rad, up to pi/2.

    The angle towards a side is that of the ray's projection onto the plane of the axis and the side; it is negative
    where the whole image lies on the other side.
    """
    folds_rad = _folds_rad(cameras)
    with np.errstate(all="ignore"):  # at 90 degrees the tangent may overflow; infinite bounds are bounds
        return np.stack([_bounds(lens) for lens in _lenses(cameras, folds_rad)])


@dataclass(frozen=True, slots=True)
class _Lens:
    """One lens.

    Attributes:
        is_fisheye: which of the two models.
        terms: (4,) distortion.
        low: (2,) left and upper end of the image in distorted coordinates.
        high: (2,) right and lower end.
        fold_rad: angle off the axis where the lens folds back, at most 90 degrees.
    """

    is_fisheye: bool
    terms: FloatArray
    low: FloatArray
    high: FloatArray
    fold_rad: float

    @property
    def farthest(self) -> float:
        """The radius of the farthest corner."""
        return float(np.linalg.norm(np.maximum(-self.low, self.high)))

    def radius(self, angle_rad: FloatArray) -> FloatArray:
        """Distorted radius of rays off the axis, without the tangential part."""
        d0, d1, d2, d3 = self.terms
        if self.is_fisheye:
            t2 = angle_rad * angle_rad
            return angle_rad * (1 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3))))
        r = np.tan(angle_rad)
        r2 = r * r
        return r * (1 + r2 * (d0 + r2 * d1))

    def tangential(self) -> float:
        """Most that the tangential part moves a ray that is in the image: 3 |p| r^2 at the largest r."""
        size = 0.0 if self.is_fisheye else 3 * float(np.hypot(self.terms[2], self.terms[3]))
        if size == 0:
            return 0.0
        return size * min(float(np.tan(self.fold_rad)), self._largest_r(size)) ** 2

    def _largest_r(self, size: float) -> float:
        """The r from which on r + k1 r^3 + k2 r^5 - size r^2 stays beyond the farthest corner; infinite if never."""
        k1, k2 = self.terms[:2]
        leading = k2 if k2 != 0 else k1
        if leading <= 0:
            return np.inf
        # In x = 1/r, so that the largest r is the smallest x. Exact zeros are r = infinity, excluded by `leading`.
        x = np.roots([self.farthest, -1.0, size, -k1, 0.0, -k2])
        x = x[x != 0]
        # A double root comes out as a pair with a small imaginary part, good to some 1e-8 of its size.
        near_real = x.real[(x.real > 0) & (np.abs(x.imag) <= 1e-3 * np.abs(x))]
        smallest = float(near_real.min(initial=np.inf))
        return 1.001 / smallest if np.isfinite(smallest) else np.inf


def _lenses(cameras: Cameras, folds_rad: FloatArray) -> Iterator[_Lens]:
    for row, size, is_fisheye, fold_rad in zip(
        cameras.intrinsics, cameras.size_px, cameras.is_fisheye, folds_rad, strict=True
    ):
        low = (-0.5 - row[2:4]) / row[:2] - SLACK
        high = (size - 0.5 - row[2:4]) / row[:2] + SLACK
        yield _Lens(bool(is_fisheye), row[4:], low, high, float(fold_rad))


def _folds_rad(cameras: Cameras) -> FloatArray:
    """(C,) where lenses fold back: the tile's own folds, so that both agree about what is valid."""
    terms = cameras.intrinsics.T[4:, :, None]
    fold_r2 = np.where(cameras.is_fisheye, KannalaBrandt.fold_r2(terms), Brown.fold_r2(terms))
    return np.minimum(np.arctan(np.sqrt(fold_r2)) * (1 + SLACK), np.pi / 2)


def _bounds(lens: _Lens) -> FloatArray:
    """(4,) bounds of one lens."""
    margin = lens.tangential()
    if not np.isfinite(margin):
        return np.full(4, np.pi / 2)
    border = _border(lens.low - margin, lens.high + margin)
    inner, outer = _angles(lens, border)
    azimuth = np.arctan2(border[:, 1], border[:, 0])
    turn = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    begin, end = azimuth[:-1] + np.minimum(turn, 0), azimuth[:-1] + np.maximum(turn, 0)
    cosine = np.stack([_largest_cosine(begin - side, end - side) for side in SIDES_RAD])
    # Towards the side the outer edge reaches farthest, away from it the inner one.
    reach = np.where(cosine > 0, np.tan(outer), np.tan(inner)) * cosine
    return np.arctan(reach).max(axis=1)


def _border(low: FloatArray, high: FloatArray) -> FloatArray:
    """(4 N_PIECES + 1, 2) points around a rectangle; the last is the first."""
    share = np.linspace(0.0, 1.0, N_PIECES, endpoint=False)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    sides = [corners[k] + share * (corners[k + 1] - corners[k]) for k in range(4)]
    return np.concatenate([*sides, low[None]])


def _angles(lens: _Lens, border: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest angle off the axis over each piece of the border, at most the fold's."""
    ends, steps = border[:-1], np.diff(border, axis=0)
    share = np.clip(-(ends * steps).sum(axis=1) / np.maximum((steps**2).sum(axis=1), 1e-300), 0.0, 1.0)
    nearest = np.linalg.norm(ends + share[:, None] * steps, axis=1)
    at_ends = np.linalg.norm(border, axis=1)
    farthest = np.maximum(at_ends[:-1], at_ends[1:])
    rings = np.linspace(0.0, lens.fold_rad, N_RINGS + 1)
    radius = np.maximum.accumulate(lens.radius(rings))
    below = np.searchsorted(radius, nearest, side="left") - 1
    above = np.searchsorted(radius, farthest, side="right")
    return rings[np.clip(below, 0, N_RINGS)], rings[np.clip(above, 0, N_RINGS)]


def _largest_cosine(begin_rad: FloatArray, end_rad: FloatArray) -> FloatArray:
    """The largest cosine on intervals of at most half a turn."""
    turns = np.floor(end_rad / (2 * np.pi)) > np.floor(begin_rad / (2 * np.pi))
    # Half a turn, of a piece that runs through the axis itself, may be either half.
    return np.where(turns | (end_rad - begin_rad > 3.0), 1.0, np.maximum(np.cos(begin_rad), np.cos(end_rad)))
