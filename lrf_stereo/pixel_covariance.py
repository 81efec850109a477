"""The 2 x 2 covariance of pixels: what is uncertain in the point, in the camera, and in both together.

Only the valid pixels of a tile are computed: K of them in a row, camera by camera, as the last axis of every array.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from lrf_stereo.pixel_tile import LensGroup, Tile
from network_calib.camera_parameters import ASPECT, CENTRE_X, CENTRE_Y, DISTORTION, FOCAL
from network_calib.observations import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class ValidPixels:
    """K valid pixels of a tile.

    Attributes:
        group: the tile's cameras.
        camera: (K,) row of the tile.
        point: (K,) column of the tile.
        of_camera: each camera that has any, and its range of pixels.
        u: (K,) x/z in the camera frame.
        v: (K,) y/z.
        r2: (K,) u^2 + v^2.
        inverse_z: (K,) 1/z.
        ud: (K,) distorted u.
        vd: (K,) distorted v.
        focal_x: (K,) px.
        focal_y: (K,) px.
        terms: (2 or 4, K) distortion.
    """

    group: LensGroup
    camera: IntArray
    point: IntArray
    of_camera: tuple[tuple[int, slice], ...]
    u: FloatArray
    v: FloatArray
    r2: FloatArray
    inverse_z: FloatArray
    ud: FloatArray
    vd: FloatArray
    focal_x: FloatArray
    focal_y: FloatArray
    terms: FloatArray

    @classmethod
    def of(cls, tile: Tile) -> ValidPixels:
        """Pick the valid pixels."""
        group, n_points = tile.group, tile.u.shape[1]
        place = np.flatnonzero(tile.is_valid)
        camera = place // n_points
        cuts = np.searchsorted(camera, np.arange(len(tile.u) + 1)).tolist()
        ranges = enumerate(itertools.pairwise(cuts))
        return cls(
            group=group,
            camera=camera,
            point=place - camera * n_points,
            of_camera=tuple((row, slice(begin, end)) for row, (begin, end) in ranges if end > begin),
            u=tile.u.ravel().take(place),
            v=tile.v.ravel().take(place),
            r2=tile.r2.ravel().take(place),
            inverse_z=tile.inverse_z.ravel().take(place),
            ud=tile.ud.ravel().take(place),
            vd=tile.vd.ravel().take(place),
            focal_x=group.focal_x[:, 0].take(camera),
            focal_y=group.focal_y[:, 0].take(camera),
            terms=group.terms[:, :, 0].take(camera, axis=1),
        )

    def work_size(self) -> int:
        """How many numbers `covariance` needs to work with."""
        return len(self.point) * (18 + 4 * self.group.n_parameters)

    def covariance(self, points_m2: FloatArray, by_scanner: FloatArray | None, work: FloatArray) -> FloatArray:
        """(3, K) covariance xx, xy, yy of the pixels, px^2.

        Args:
            points_m2: (3, 3, n) covariance of the tile's points in world.
            by_scanner: (15, 3, n) derivative of the points by the scanner's parameters, where cameras and scanner err
                together.
            work: at least `work_size` numbers that are overwritten: fresh memory for each tile costs more than the
                arithmetic.
        """
        n, k = len(self.point), self.group.n_parameters
        in_cam = work[: 6 * n].reshape(2, 3, n)
        of_point, product = work[: 9 * n].reshape(9, n), work[9 * n : 18 * n].reshape(3, 3, n)
        slope, spread = work[18 * n :][: 4 * k * n].reshape(2, 2, k, n)
        self._fill_by_point_in_cam(in_cam)
        self._fill_by_centre(slope[:, :3], in_cam)
        if self.group.covariance is None:
            spread[:] = 0.0
        else:
            self._fill_by_camera(slope[:, 3:], in_cam)
            if by_scanner is not None:
                # A point moves its pixel as the camera's centre does, the other way.
                turned = -by_scanner[:, :, self.point]
                np.einsum("kin,ain->akn", turned, slope[:, :3], out=slope[:, -len(by_scanner) :])
            for camera, pixels in self.of_camera:
                np.matmul(self.group.covariance[camera], slope[:, :, pixels], out=spread[:, :, pixels])
        # The memory of `in_cam` is no longer needed.
        np.take(points_m2.reshape(9, -1), self.point, axis=1, out=of_point, mode="clip")
        for a in range(2):
            np.multiply(of_point.reshape(3, 3, n), slope[a, :3], out=product)
            spread[a, :3] += product.sum(axis=1)
        return np.stack([np.einsum("kn,kn->n", slope[a], spread[b]) for a, b in ((0, 0), (0, 1), (1, 1))])

    def _fill_by_point_in_cam(self, out: FloatArray) -> None:
        """Fill (2, 3, K): derivative of the pixel (first axis) by x, y, z in the camera frame, times z."""
        a00, a01, a11 = self.group.lens.slope(self.terms, self.u, self.v, self.r2)
        np.multiply(self.focal_x, a00, out=out[0, 0])
        np.multiply(self.focal_x, a01, out=out[0, 1])
        np.multiply(self.focal_y, a01, out=out[1, 0])
        np.multiply(self.focal_y, a11, out=out[1, 1])
        np.multiply(out[:, 0], self.u, out=out[:, 2])
        out[:, 2] += out[:, 1] * self.v
        np.negative(out[:, 2], out=out[:, 2])

    def _fill_by_centre(self, out: FloatArray, in_cam: FloatArray) -> None:
        """Fill (2, 3, K): derivative by the camera's centre, minus that by the point in world."""
        for camera, pixels in self.of_camera:
            np.matmul(self.group.minus_turn[camera], in_cam[:, :, pixels], out=out[:, :, pixels])
        out *= self.inverse_z

    def _fill_by_camera(self, slope: FloatArray, in_cam: FloatArray) -> None:
        """Fill (2, k, K): derivative of the pixel by rotation and the active intrinsics."""
        # x_in_cam moves by omega x x_in_cam; the depth cancels.
        j0, j1, j2 = in_cam[:, 0], in_cam[:, 1], in_cam[:, 2]
        np.subtract(j2 * self.v, j1, out=slope[:, 0])
        np.subtract(j0, j2 * self.u, out=slope[:, 1])
        np.subtract(j1 * self.u, j0 * self.v, out=slope[:, 2])
        for place, parameter in enumerate(self.group.active, start=3):
            x, y = slope[:, place]
            if parameter == FOCAL:
                x[:] = self.ud
                np.multiply(self.focal_y / self.focal_x, self.vd, out=y)
            elif parameter == ASPECT:
                x[:] = 0.0
                np.multiply(self.focal_x, self.vd, out=y)
            elif parameter in (CENTRE_X, CENTRE_Y):
                x[:], y[:] = float(parameter == CENTRE_X), float(parameter == CENTRE_Y)
        n_terms = sum(parameter >= DISTORTION for parameter in self.group.active)
        by_terms = enumerate(self.group.lens.by_terms(self.u, self.v, self.r2), start=DISTORTION)
        for parameter, (by_u, by_v) in by_terms if n_terms else ():
            if parameter in self.group.active:
                place = 3 + self.group.active.index(parameter)
                np.multiply(self.focal_x, by_u, out=slope[:, place][0])
                np.multiply(self.focal_y, by_v, out=slope[:, place][1])
            if parameter == self.group.active[-1]:
                break
