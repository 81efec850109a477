"""Points into the pixels of many cameras at once: a tile of cameras x points at a time, or of some cameras only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lrf_stereo.lens_arrays import Brown, KannalaBrandt
from lrf_stereo.pixel_covariance import ValidPixels
from lrf_stereo.pixel_tile import LensGroup, Tile
from network_calib.cameras import Cameras
from network_calib.observations import BoolArray, FloatArray, IntArray

# Pixels in one tile: enough to make NumPy's overhead small, few enough for the second-level cache.
TILE_PIXELS = 16384
# Choices of cameras that are kept prepared: a few for each LRF of a room.
MAX_KEPT = 64


@dataclass(frozen=True, slots=True)
class PointSpread:
    """How uncertain N points in world are.

    Attributes:
        covariance: (3, 3, N) m^2.
        by_scanner: (15, 3, N) derivative by the scanner's parameters, where cameras and scanner err together.
    """

    covariance: FloatArray
    by_scanner: FloatArray | None = None

    def take(self, columns: slice) -> tuple[FloatArray, FloatArray | None]:
        """Some of the points."""
        return self.covariance[..., columns], None if self.by_scanner is None else self.by_scanner[..., columns]


@dataclass(frozen=True, slots=True)
class PixelSheet:
    """N points in C cameras: px (2, C, N), depth and validity (C, N), covariance xx, xy, yy (3, C, N) or None."""

    px: FloatArray
    depth_m: FloatArray
    is_valid: BoolArray
    covariance_px2: FloatArray | None

    @classmethod
    def of(cls, n_cameras: int, n_points: int, *, is_with_covariance: bool) -> PixelSheet:
        """A sheet to be filled."""
        return cls(
            px=np.empty((2, n_cameras, n_points)),
            depth_m=np.empty((n_cameras, n_points)),
            is_valid=np.empty((n_cameras, n_points), dtype=bool),
            covariance_px2=np.full((3, n_cameras, n_points), np.nan) if is_with_covariance else None,
        )

    def put(self, tile: Tile, members: IntArray, columns: slice) -> None:
        """Fill in a tile of the cameras `members`, which grow."""
        # Cameras of one kind mostly stand together, and a slice is written to faster than an index array.
        is_run = members[-1] - members[0] + 1 == len(members)
        rows = slice(members[0], members[-1] + 1) if is_run else members
        self.px[:, rows, columns] = tile.px
        self.depth_m[rows, columns] = tile.depth
        self.is_valid[rows, columns] = tile.is_valid

    def put_covariance(self, covariance: FloatArray, camera: IntArray, point: IntArray) -> None:
        """Fill in covariances (3, K) of pixels (K,)."""
        assert self.covariance_px2 is not None
        place = camera * self.depth_m.shape[1] + point
        for plane, values in zip(self.covariance_px2, covariance, strict=True):
            plane.reshape(-1)[place] = values

    def px_of_shape(self, shape: tuple[int, ...]) -> FloatArray:
        """(C, *S, 2) view."""
        whole = (2, len(self.depth_m), *shape)
        return self.px.reshape(whole).transpose(*range(1, len(whole)), 0)

    def covariance_of_shape(self, shape: tuple[int, ...]) -> FloatArray | None:
        """(C, *S, 2, 2) read-only view: entry (a, b) is plane a + b, without a copy."""
        if self.covariance_px2 is None:
            return None
        planes = self.covariance_px2.reshape(3, len(self.depth_m), *shape)
        strides = (*planes.strides[1:], planes.strides[0], planes.strides[0])
        out = np.ndarray((*planes.shape[1:], 2, 2), np.float64, planes, strides=strides)
        out.flags.writeable = False
        return out


class CameraArray:
    """Cameras prepared for many projections.

    Not for two threads at a time: they would work in the same memory.
    """

    def __init__(
        self, cameras: Cameras, *, covariance: FloatArray | None = None, camera_scanner: FloatArray | None = None
    ) -> None:
        """Prepare C cameras; covariances (C, 14, 14), and (C, 14, 15) with the scanner's, as `LensGroup` takes them."""
        self._n_cameras = len(cameras)
        self._groups = tuple(_lens_groups(cameras, covariance, camera_scanner))
        self._some: dict[bytes, tuple[tuple[LensGroup, IntArray], ...]] = {}
        self._work = np.empty(0)

    def __len__(self) -> int:
        return self._n_cameras

    def project(self, points: FloatArray, spread: PointSpread | None, cameras: IntArray | None = None) -> PixelSheet:
        """Project points (3, N) into all cameras, or into those of the given indices (C',), in their order."""
        groups = self._groups if cameras is None else self._groups_of(cameras)
        n_cameras = self._n_cameras if cameras is None else len(cameras)
        sheet = PixelSheet.of(n_cameras, points.shape[1], is_with_covariance=spread is not None)
        with np.errstate(all="ignore"):  # what is behind a camera or overflows is not finite, and reported as invalid
            for group, members in groups:
                for rows, columns in _tiles(len(members), points.shape[1]):
                    is_whole = rows.stop - rows.start >= len(members)
                    tile = Tile.of(group if is_whole else group.take(rows), points[:, columns])
                    sheet.put(tile, members[rows], columns)
                    if spread is not None:
                        pixels = ValidPixels.of(tile)
                        covariance = pixels.covariance(*spread.take(columns), self._memory(pixels.work_size()))
                        sheet.put_covariance(covariance, members[rows][pixels.camera], pixels.point + columns.start)
        return sheet

    def _groups_of(self, cameras: IntArray) -> tuple[tuple[LensGroup, IntArray], ...]:
        """The lens groups of some cameras; kept, for the next scan mostly is seen by the same."""
        key = np.ascontiguousarray(cameras, dtype=np.int64).tobytes()
        if key not in self._some:
            if len(self._some) >= MAX_KEPT:
                del self._some[next(iter(self._some))]
            self._some[key] = tuple(_some_of(self._groups, cameras))
        return self._some[key]

    def _memory(self, size: int) -> FloatArray:
        """Numbers to overwrite, kept from one tile to the next."""
        if size > len(self._work):
            self._work = np.empty(size)
        return self._work


def _lens_groups(
    cameras: Cameras, covariance: FloatArray | None, camera_scanner: FloatArray | None
) -> Iterator[tuple[LensGroup, IntArray]]:
    """The cameras of each kind of lens, and their indices."""
    for lens, is_of_kind in ((Brown, ~cameras.is_fisheye), (KannalaBrandt, cameras.is_fisheye)):
        members = np.flatnonzero(is_of_kind)
        if len(members):
            yield LensGroup.of(lens, cameras, members, covariance, camera_scanner), members


def _some_of(groups: tuple[tuple[LensGroup, IntArray], ...], cameras: IntArray) -> Iterator[tuple[LensGroup, IntArray]]:
    """Of each group the wanted cameras, and their places among the wanted."""
    for group, members in groups:
        places = np.flatnonzero(np.isin(cameras, members))
        if len(places):
            yield group.take(np.searchsorted(members, cameras[places])), places


def _tiles(n_cameras: int, n_points: int) -> Iterator[tuple[slice, slice]]:
    """Ranges of cameras and points that together cover every pixel once."""
    n_columns = max(1, min(n_points, TILE_PIXELS))
    n_rows = TILE_PIXELS // n_columns
    for row in range(0, n_cameras, n_rows):
        for column in range(0, n_points, n_columns):
            yield slice(row, row + n_rows), slice(column, column + n_columns)
