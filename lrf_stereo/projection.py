"""Equation 14 as an array function: LRF measurements to pixels of every camera, with validity and covariance.

    u = H L(alpha)_T_W l(alpha)_p

A beam's end is found once and then projected into all cameras, a tile of cameras x beams at a time, so that what a tile
needs stays in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lrf_stereo.beams import N_SCANNER, Beams, Measurements, TiltedScanner
from lrf_stereo.lens_arrays import Brown, KannalaBrandt
from lrf_stereo.noise import LrfNoise
from lrf_stereo.pixel_covariance import ValidPixels
from lrf_stereo.pixel_tile import LensGroup, Tile
from lrf_stereo.scanner import TiltingScanner
from network_calib.camera_parameters import N_PARAMETERS
from network_calib.cameras import Cameras
from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray

# Pixels in one tile: enough to make NumPy's overhead small, few enough for the second-level cache.
TILE_PIXELS = 4096


@dataclass(frozen=True, slots=True)
class CalibrationCovariance:
    """What is uncertain in the calibration; what is left out counts as exact.

    Attributes:
        cameras: (C, 14, 14) in the order of `network_calib.result.PARAMETER_NAMES`.
        scanner: (15, 15) in the order of `lrf_stereo.scanner_part.SCANNER_TANGENT`.
        camera_scanner: (C, 14, 15) covariance of each camera's parameters (rows) with the scanner's (columns). Cameras
            and scanner are known from the same spots, and errors that they share move no pixel; without this the
            pixels' covariance is too large.
    """

    cameras: FloatArray | None = None
    scanner: FloatArray | None = None
    camera_scanner: FloatArray | None = None

    def check(self, n_cameras: int) -> None:
        """Refuse matrices of other shapes.

        Raises:
            InputError: a shape is not the one named above, or the cross covariance stands alone.
        """
        shapes = {
            "cameras": (self.cameras, (n_cameras, N_PARAMETERS, N_PARAMETERS)),
            "scanner": (self.scanner, (N_SCANNER, N_SCANNER)),
            "camera_scanner": (self.camera_scanner, (n_cameras, N_PARAMETERS, N_SCANNER)),
        }
        for name, (matrix, shape) in shapes.items():
            if matrix is not None and matrix.shape != shape:
                raise InputError(f"covariance {name} has the shape {matrix.shape}, expected {shape}")
        if self.camera_scanner is not None and (self.cameras is None or self.scanner is None):
            raise InputError("a covariance of cameras with the scanner needs those of the cameras and of the scanner")


@dataclass(frozen=True, slots=True)
class LrfProjection:
    """Pixels of measurements of shape S in C cameras.

    Attributes:
        px: (C, *S, 2); NaN behind the camera or where the measurement is not finite.
        is_valid: (C, *S) in front of the camera, before its lens folds back, and inside its image.
        depth_m: (C, *S) z in the camera frame, negative behind it.
        covariance_px2: (C, *S, 2, 2), NaN where not valid; None where neither noise nor covariance was given.
    """

    px: FloatArray
    is_valid: BoolArray
    depth_m: FloatArray
    covariance_px2: FloatArray | None


def project_lrf(
    scanner: TiltingScanner,
    cameras: Cameras,
    range_m: npt.ArrayLike,
    bearing_rad: npt.ArrayLike,
    tilt_rad: npt.ArrayLike,
    *,
    noise: LrfNoise | None = None,
    covariance: CalibrationCovariance | None = None,
) -> LrfProjection:
    """Equation 14: where measurements of a tilting scanner appear in every camera.

    Args:
        scanner: calibrated scanner, in the cameras' world.
        cameras: C cameras.
        range_m: measured ranges; NaN for beams without a range. The three broadcast to the shape S.
        bearing_rad: measured bearings.
        tilt_rad: tilts as reported; a single number for a whole scan is fastest.
        noise: of the measurement, for the covariance.
        covariance: of the calibration, for the covariance.

    Raises:
        InputError: a covariance of another shape than its parameters have.
    """
    return LrfProjector(scanner, cameras, covariance=covariance).project(range_m, bearing_rad, tilt_rad, noise=noise)


class LrfProjector:
    """Equation 14 prepared for many scans of one scanner; gives what `project_lrf` gives.

    What depends on the tilt alone is kept from scan to scan while the tilt stays. Not for two threads at a time: they
    would work in the same memory.
    """

    def __init__(
        self, scanner: TiltingScanner, cameras: Cameras, *, covariance: CalibrationCovariance | None = None
    ) -> None:
        self._covariance = covariance or CalibrationCovariance()
        self._covariance.check(len(cameras))
        self._is_calibration_uncertain = covariance is not None
        self._n_cameras = len(cameras)
        self._groups = tuple(_lens_groups(cameras, self._covariance))
        self._tilted = TiltedScanner.of(scanner, np.empty(0))
        self._spread: tuple[LrfNoise | None, FloatArray] | None = None
        self._work = np.empty(0)

    def project(
        self,
        range_m: npt.ArrayLike,
        bearing_rad: npt.ArrayLike,
        tilt_rad: npt.ArrayLike,
        *,
        noise: LrfNoise | None = None,
    ) -> LrfProjection:
        """Project measurements; arguments and result as in `project_lrf`."""
        measured = Measurements.of(range_m, bearing_rad, tilt_rad)
        self._tilt(measured.tilts_rad)
        beams = Beams.of(self._tilted, measured.tilt_of, measured.range_m, measured.bearing_rad)
        points = beams.ends_in_world()
        is_wanted = noise is not None or self._is_calibration_uncertain
        spread = self._spread_of(beams, noise) if is_wanted else None
        canvas = _Canvas.of(self._n_cameras, points.shape[1], is_with_covariance=is_wanted)
        with np.errstate(all="ignore"):  # what is behind a camera or overflows is not finite, and reported as invalid
            for group, members in self._groups:
                for rows, columns in _tiles(len(members), points.shape[1]):
                    tile = Tile.of(group.take(rows), points[:, columns])
                    canvas.put(tile, members[rows], columns)
                    if spread is not None:
                        pixels = ValidPixels.of(tile)
                        covariance = pixels.covariance(*spread.take(columns), self._memory(pixels.work_size()))
                        canvas.put_covariance(covariance, members[rows][pixels.camera], pixels.point + columns.start)
        return canvas.as_projection(measured.shape)

    def _tilt(self, tilts_rad: FloatArray) -> None:
        if not np.array_equal(tilts_rad, self._tilted.tilts_rad):
            self._tilted, self._spread = TiltedScanner.of(self._tilted.scanner, tilts_rad.copy()), None

    def _spread_of(self, beams: Beams, noise: LrfNoise | None) -> _Spread:
        if self._spread is None or self._spread[0] != noise:
            self._spread = noise, self._tilted.factors_of_spread(noise, self._covariance.scanner)
        slope = None if self._covariance.camera_scanner is None else beams.by_scanner()
        return _Spread(beams.covariance(self._spread[1], noise), slope)

    def _memory(self, size: int) -> FloatArray:
        """Numbers to overwrite, kept from one tile to the next."""
        if size > len(self._work):
            self._work = np.empty(size)
        return self._work


@dataclass(frozen=True, slots=True)
class _Spread:
    """How uncertain the ends are: (3, 3, N) covariance; (15, 3, N) slope where cameras and scanner err together."""

    covariance: FloatArray
    by_scanner: FloatArray | None

    def take(self, columns: slice) -> tuple[FloatArray, FloatArray | None]:
        return self.covariance[..., columns], None if self.by_scanner is None else self.by_scanner[..., columns]


@dataclass(frozen=True, slots=True)
class _Canvas:
    """What the tiles are put on: px (2, C, N), depth and validity (C, N), covariance xx, xy, yy (3, C, N) or None."""

    px: FloatArray
    depth_m: FloatArray
    is_valid: BoolArray
    covariance_px2: FloatArray | None

    @classmethod
    def of(cls, n_cameras: int, n_beams: int, *, is_with_covariance: bool) -> _Canvas:
        return cls(
            px=np.empty((2, n_cameras, n_beams)),
            depth_m=np.empty((n_cameras, n_beams)),
            is_valid=np.empty((n_cameras, n_beams), dtype=bool),
            covariance_px2=np.full((3, n_cameras, n_beams), np.nan) if is_with_covariance else None,
        )

    def put(self, tile: Tile, members: IntArray, columns: slice) -> None:
        # Cameras of one kind mostly stand together, and a slice is written to faster than an index array.
        is_run = members[-1] - members[0] + 1 == len(members)
        rows = slice(members[0], members[-1] + 1) if is_run else members
        self.px[:, rows, columns] = tile.px
        self.depth_m[rows, columns] = tile.depth
        self.is_valid[rows, columns] = tile.is_valid

    def put_covariance(self, covariance: FloatArray, camera: IntArray, beam: IntArray) -> None:
        assert self.covariance_px2 is not None
        place = camera * self.depth_m.shape[1] + beam
        for plane, values in zip(self.covariance_px2, covariance, strict=True):
            plane.reshape(-1)[place] = values

    def as_projection(self, shape: tuple[int, ...]) -> LrfProjection:
        whole = (len(self.depth_m), *shape)
        planes = self.covariance_px2
        return LrfProjection(
            px=self.px.reshape(2, *whole).transpose(*range(1, len(whole) + 1), 0),
            is_valid=self.is_valid.reshape(whole),
            depth_m=self.depth_m.reshape(whole),
            covariance_px2=None if planes is None else _as_matrices(planes.reshape(3, *whole)),
        )


def _as_matrices(planes: FloatArray) -> FloatArray:
    """(..., 2, 2) read-only view of the planes xx, xy, yy (3, ...): entry (a, b) is plane a + b, without a copy."""
    strides = (*planes.strides[1:], planes.strides[0], planes.strides[0])
    out = np.ndarray((*planes.shape[1:], 2, 2), np.float64, planes, strides=strides)
    out.flags.writeable = False
    return out


def _lens_groups(cameras: Cameras, given: CalibrationCovariance) -> Iterator[tuple[LensGroup, IntArray]]:
    """The cameras of each kind of lens, and their indices."""
    for lens, is_of_kind in ((Brown, ~cameras.is_fisheye), (KannalaBrandt, cameras.is_fisheye)):
        members = np.flatnonzero(is_of_kind)
        if len(members):
            yield LensGroup.of(lens, cameras, members, given.cameras, given.camera_scanner), members


def _tiles(n_cameras: int, n_beams: int) -> Iterator[tuple[slice, slice]]:
    """Ranges of cameras and beams that together cover every pixel once."""
    n_columns = max(1, min(n_beams, TILE_PIXELS))
    n_rows = TILE_PIXELS // n_columns
    for row in range(0, n_cameras, n_rows):
        for column in range(0, n_beams, n_columns):
            yield slice(row, row + n_rows), slice(column, column + n_columns)
