"""How far to each side a camera sees: bounds that no valid pixel's ray exceeds, whatever the distortion.

The rays of a camera are cut into cells of angle off the axis x azimuth. Over a cell the radial part of the distortion
lies between its values at the cell's ends, for it grows up to where the lens folds back; the tangential part p1, p2
moves a point by no more than 3 |p| r^2. So each cell's pixels lie in a rectangle, and a cell whose rectangle misses the
image holds no valid pixel: intervals, not samples, so that nothing falls between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrf_stereo.lens_arrays import Brown, KannalaBrandt
from network_calib.cameras import Cameras
from network_calib.observations import BoolArray, FloatArray

# Cells along the way from the axis outwards: first over 90 degrees, then between the first and last ring that matter.
N_RINGS, N_FINE_RINGS, N_SECTORS = 128, 24, 48
# Left, right, up, down.
SIDES_RAD = np.pi / 2 * np.arange(4)
# Cameras bounded at once: their cells stay below some 10 MB.
CHUNK = 64
# Widens each cell's rectangle against rounding, in units of the focal length.
SLACK = 1e-9


def side_bounds(cameras: Cameras) -> FloatArray:
    """(C, 4) largest angle of a valid pixel's ray towards each of SIDES_RAD, rad, up to pi/2.

    The angle towards a side is that of the ray's projection onto the plane of the axis and the side; it is negative
    where the whole image lies on the other side, and -pi/2 where no ray meets the image.
    """
    chunks = [np.arange(begin, min(begin + CHUNK, len(cameras))) for begin in range(0, len(cameras), CHUNK)]
    out = np.empty((len(cameras), len(SIDES_RAD)))
    for members in chunks:
        lenses = _Lenses.of(cameras, members)
        with np.errstate(all="ignore"):  # at 90 degrees the tangent may overflow; infinite bounds are bounds
            out[members] = _bounds(lenses)
    return out


@dataclass(frozen=True, slots=True)
class _Lenses:
    """c lenses; the image's sides in distorted coordinates, (c,) each, and the angle where the lens folds back."""

    is_fisheye: BoolArray
    terms: FloatArray
    left: FloatArray
    right: FloatArray
    top: FloatArray
    bottom: FloatArray
    fold_rad: FloatArray

    @classmethod
    def of(cls, cameras: Cameras, members: np.ndarray) -> _Lenses:
        focal_x, focal_y, centre_x, centre_y, *_ = rows = cameras.intrinsics[members].T
        width, height = cameras.size_px[members].T
        terms, is_fisheye = rows[4:], cameras.is_fisheye[members]
        columns = terms[:, :, None]
        # The tile's own folds, so that both agree about what is valid.
        fold_r2 = np.where(is_fisheye, KannalaBrandt.fold_r2(columns), Brown.fold_r2(columns))
        return cls(
            is_fisheye=is_fisheye,
            terms=terms,
            left=(-0.5 - centre_x) / focal_x - SLACK,
            right=(width - 0.5 - centre_x) / focal_x + SLACK,
            top=(-0.5 - centre_y) / focal_y - SLACK,
            bottom=(height - 0.5 - centre_y) / focal_y + SLACK,
            fold_rad=np.arctan(np.sqrt(fold_r2)),
        )

    def radius(self, angle_rad: FloatArray) -> FloatArray:
        """Distorted radius, without the tangential part, of rays (c, ...) off the axis."""
        shape = (-1, *(1,) * (angle_rad.ndim - 1))
        d0, d1, d2, d3 = (term.reshape(shape) for term in self.terms)
        r, t2 = np.tan(angle_rad), angle_rad * angle_rad
        r2 = r * r
        fisheye = angle_rad * (1 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3))))
        return np.where(self.is_fisheye.reshape(shape), fisheye, r * (1 + r2 * (d0 + r2 * d1)))

    def tangential(self, angle_rad: FloatArray) -> FloatArray:
        """Most that the tangential part moves rays (c, ...)."""
        size = np.where(self.is_fisheye, 0.0, 3 * np.hypot(self.terms[2], self.terms[3]))
        return size.reshape(-1, *(1,) * (angle_rad.ndim - 1)) * np.tan(angle_rad) ** 2


def _bounds(lenses: _Lenses) -> FloatArray:
    begin, end = _rings(lenses)
    share = np.linspace(0.0, 1.0, N_FINE_RINGS + 1)
    edges = begin[:, None] + (end - begin)[:, None] * share
    sectors = np.linspace(-np.pi, np.pi, N_SECTORS + 1)
    can_see = _meets_image(lenses, edges, sectors)
    inner, outer = edges[:, :-1, None], edges[:, 1:, None]
    out = np.empty((len(begin), len(SIDES_RAD)))
    for side, azimuth in enumerate(SIDES_RAD):
        cosine = _cosine_range(sectors - azimuth)[1]
        # Towards the side the outer edge reaches farthest, away from it the inner edge.
        reach = np.where(cosine > 0, np.tan(outer) * cosine, np.tan(inner) * cosine)
        out[:, side] = np.arctan(np.where(can_see, reach, -np.inf).max(axis=(1, 2)))
    return out


def _rings(lenses: _Lenses) -> tuple[FloatArray, FloatArray]:
    """(c,) angles off the axis between which all valid pixels lie; both zero where there are none."""
    edges = np.minimum(np.linspace(0.0, np.pi / 2, N_RINGS + 1), lenses.fold_rad[:, None])
    margin = lenses.tangential(edges[:, 1:])
    nearest = np.hypot(
        np.maximum(np.maximum(lenses.left, -lenses.right), 0.0), np.maximum(np.maximum(lenses.top, -lenses.bottom), 0.0)
    )
    farthest = np.hypot(np.maximum(-lenses.left, lenses.right), np.maximum(-lenses.top, lenses.bottom))
    radius = lenses.radius(edges)
    can_see = (radius[:, :-1] - margin <= farthest[:, None]) & (radius[:, 1:] + margin >= nearest[:, None])
    # What cannot be said, because two infinities cancel, counts as seen.
    can_see |= ~np.isfinite(radius[:, 1:] + margin)
    can_see &= edges[:, 1:] > edges[:, :-1]
    has_any = can_see.any(axis=1)
    first, last = can_see.argmax(axis=1), can_see.shape[1] - can_see[:, ::-1].argmax(axis=1)
    row = np.arange(len(edges))
    return np.where(has_any, edges[row, first], 0.0), np.where(has_any, edges[row, last], 0.0)


def _meets_image(lenses: _Lenses, edges: FloatArray, sectors: FloatArray) -> BoolArray:
    """(c, rings, sectors) whether a cell's rectangle of pixels meets the image."""
    radius, margin = lenses.radius(edges), lenses.tangential(edges[:, 1:])[:, :, None]
    inner, outer = radius[:, :-1, None], radius[:, 1:, None]
    can_see = np.ones((len(edges), N_FINE_RINGS, N_SECTORS), dtype=bool)
    for azimuth, low, high in ((0.0, lenses.left, lenses.right), (np.pi / 2, lenses.top, lenses.bottom)):
        least, most = _cosine_range(sectors - azimuth)
        smallest = np.where(least > 0, inner, outer) * least - margin
        largest = np.where(most > 0, outer, inner) * most + margin
        can_see &= ~((smallest > high[:, None, None]) | (largest < low[:, None, None]))
    return can_see


def _cosine_range(edges_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) smallest and largest cosine on each of n intervals that are shorter than half a turn."""
    ends = np.cos(edges_rad)
    least, most = np.minimum(ends[:-1], ends[1:]), np.maximum(ends[:-1], ends[1:])
    turns = edges_rad / (2 * np.pi)
    has_top = np.floor(turns[1:]) > np.floor(turns[:-1])
    has_bottom = np.floor(turns[1:] + 0.5) > np.floor(turns[:-1] + 0.5)
    return np.where(has_bottom, -1.0, least), np.where(has_top, 1.0, most)
