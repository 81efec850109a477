"""A calibration that answers: laser or world points to pixels, pixels to rays and points, points to laser beams.

Wiring only; the mathematics is in `lrf_stereo.projection`, `lrf_stereo.frustums` and `network_calib.rays`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from threading import Lock

import numpy as np
import numpy.typing as npt

from lrf_stereo.plane_beams import PLANE_TOLERANCE_M, PlaneBeams
from lrf_stereo.scanner import ScanSteps
from network_calib.errors import InputError
from network_calib.formats.calibration_json import loads
from network_calib.observations import IntArray
from network_calib.rays import LocatedPoints, PixelLocator, Plane
from network_calib.result import Calibration as CalibrationResult
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.points import (
    Beams,
    Bearings,
    CovarianceOf,
    Located,
    LrfPoints,
    Points,
    Projected,
    Rays,
    WorldPoints,
    rows,
)
from nodes.projection.projectors import Projectors

PlaneGiven = tuple[npt.ArrayLike, float]
FLOOR: PlaneGiven = ((0.0, 0.0, 1.0), 0.0)


class Calibration:
    """What `ProjectionClient` asks over the bus, answered in the same process; any thread may ask.

    Attributes:
        id: names the calibration in every answer.
        result: the calibration.
    """

    def __init__(self, result: CalibrationResult, calibration_id: str) -> None:
        self.id = calibration_id
        self.result = result
        self._projectors = Projectors(result)
        self._locator = PixelLocator(self._projectors.cameras, self._projectors.covariance)
        self._number_of = {name: i for i, name in enumerate(self.camera_names)}
        # Projectors work in memory that they keep; whoever asks waits for the one before.
        self._lock = Lock()

    @classmethod
    def load(cls, path: Path | str) -> Calibration:
        """Read calibration.json; the id is that of the coordinator.

        Raises:
            InputError: the file cannot be read, or lists its faults.
        """
        try:
            text = Path(path).read_bytes()
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror or error}") from None
        return cls.from_json(text, source=path)

    @classmethod
    def from_json(cls, text: bytes, *, calibration_id: str = "", source: Path | str = "the calibration") -> Calibration:
        """The bytes of a calibration.json; without an id it is made of them, as the coordinator does.

        Raises:
            InputError: lists the faults; `source` stands in the message.
        """
        return cls(loads(text, source), calibration_id or sha256(text).hexdigest()[:16])

    @classmethod
    def of(cls, result: CalibrationResult, calibration_id: str) -> Calibration:
        """A calibration that is in memory."""
        return cls(result, calibration_id)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """All cameras, in the order of answers."""
        return self._projectors.cameras.names

    @property
    def lrf_names(self) -> tuple[str, ...]:
        """All LRFs."""
        return tuple(self._projectors.scanners)

    def project(
        self, points: Points, cameras: Sequence[str] | None = None, *, covariance: CovarianceOf | None = None
    ) -> Projected:
        """Where points appear.

        Args:
            points: N of them.
            cameras: names, in the order wanted; None: all.
            covariance: what counts as uncertain; None: no covariance. Cameras and LRF count as independent, which the
                result file cannot say better: where they were solved together, the covariance is rather too large.

        Raises:
            ProjectionError: UNKNOWN_CAMERA, UNKNOWN_LRF, NO_TILT.
        """
        indices = None if cameras is None else self._indices(cameras)
        measured = points.as_beams() if isinstance(points, LrfPoints) else points
        with self._lock:
            if isinstance(measured, WorldPoints):
                found = self._projectors.project_points(measured, covariance, indices)
            else:
                found = self._projectors.project_beams(measured, covariance, indices)
        return Projected(
            calibration_id=self.id,
            cameras=self.camera_names if cameras is None else tuple(cameras),
            px=found.px,
            is_valid=found.is_valid,
            depth_m=found.depth_m,
            covariance_px2=found.covariance_px2,
            tilt_rad=measured.tilt_rad if isinstance(measured, Beams) else None,
        )

    def cameras_seeing(self, points: Points, *, max_distance_m: float = np.inf) -> tuple[str, ...]:
        """Every camera in which any of the points may be valid, and few others: far cheaper than `project`.

        Args:
            points: neighbours one after the other, as in a scan.
            max_distance_m: points farther from a camera do not count.

        Raises:
            ProjectionError: UNKNOWN_LRF, NO_TILT.
        """
        measured = points.as_beams() if isinstance(points, LrfPoints) else points
        with self._lock:
            seeing = self._projectors.cameras_seeing(measured, max_distance_m)
        return tuple(self.camera_names[i] for i in seeing)

    def rays(self, camera: str, px: npt.ArrayLike) -> Rays:
        """Where pixels (N, 2) of a camera look.

        Raises:
            ProjectionError: UNKNOWN_CAMERA, BAD_REQUEST.
        """
        pixels = rows(px, 2, "px")
        rays = self._locator.rays(self._of_camera(camera, len(pixels)), pixels)
        return Rays(self.id, rays.origins, rays.directions, rays.is_valid)

    def floor_points(
        self, camera: str, px: npt.ArrayLike, *, sigma_px: float = 0.5, plane: PlaneGiven = FLOOR
    ) -> Located:
        """Where pixels (N, 2) of a camera meet the floor, or another plane.

        Args:
            camera: name.
            px: (N, 2).
            sigma_px: standard deviation of a pixel along each axis.
            plane: normal (3,) and offset: normal . x = offset; by default z = 0 of the world.

        Raises:
            ProjectionError: UNKNOWN_CAMERA, BAD_REQUEST.
        """
        pixels = rows(px, 2, "px")
        numbers = self._of_camera(camera, len(pixels))
        return self._located(self._locator.on_plane(numbers, pixels, _plane(plane), sigma_px=_sigma(sigma_px)))

    def triangulate(self, pixels: Mapping[str, npt.ArrayLike], sigma_px: float = 0.5) -> Located:
        """The likeliest points of pixels in two cameras or more.

        Args:
            pixels: of each camera, (N, 2): row n shows point n, or is NaN where it is not seen.
            sigma_px: standard deviation of a pixel along each axis.

        Raises:
            ProjectionError: UNKNOWN_CAMERA, BAD_REQUEST.
        """
        columns = {name: rows(px, 2, f"px of {name}") for name, px in pixels.items()}
        lengths = {name: len(px) for name, px in columns.items()}
        if len(columns) < 2 or len(set(lengths.values())) != 1:
            raise ProjectionError(
                ErrorCode.BAD_REQUEST, f"pixels of {lengths}", "Give equally many pixels of two cameras or more."
            )
        n = next(iter(lengths.values()))
        camera = np.concatenate([self._of_camera(name, n) for name in columns])
        point, px = np.tile(np.arange(n), len(columns)), np.concatenate(list(columns.values()))
        return self._located(self._locator.triangulated(camera, point, px, n, sigma_px=_sigma(sigma_px)))

    def bearings(
        self,
        lrf: str,
        xyz_in_world: npt.ArrayLike,
        tilt_rad: float,
        *,
        steps: ScanSteps | None = None,
        tolerance_m: float = PLANE_TOLERANCE_M,
    ) -> Bearings:
        """Which beams of an LRF see points (N, 3) at its tilt.

        Args:
            lrf: name.
            xyz_in_world: (N, 3).
            tilt_rad: as the LRF reports it.
            steps: of its scan; an URG-04LX's by default.
            tolerance_m: largest height above the scan plane at which a beam still meets a point.

        Raises:
            ProjectionError: UNKNOWN_LRF, BAD_REQUEST, NO_TILT.
        """
        points, beams = rows(xyz_in_world, 3, "xyz_in_world"), self._plane_beams(lrf, tilt_rad)
        found = beams.seeing(points, steps or ScanSteps(), tolerance_m=tolerance_m)
        return Bearings(self.id, lrf, found.bearing_rad, found.range_m, found.out_of_plane_m, found.step, found.is_seen)

    def bearings_of_pixels(
        self, lrf: str, camera: str, px: npt.ArrayLike, tilt_rad: float, *, steps: ScanSteps | None = None
    ) -> Bearings:
        """Which beams of an LRF end where pixels (N, 2) look, if anything is there: where rays meet the scan plane.

        Raises:
            ProjectionError: UNKNOWN_LRF, UNKNOWN_CAMERA, BAD_REQUEST, NO_TILT.
        """
        plane = self._plane_beams(lrf, tilt_rad).plane
        crossing = self.floor_points(camera, px, plane=(plane.normal, plane.offset))
        return self.bearings(lrf, crossing.xyz_in_world, tilt_rad, steps=steps)

    def _plane_beams(self, lrf: str, tilt_rad: float) -> PlaneBeams:
        scanner = self._projectors.scanner(lrf)
        if not np.isfinite(tilt_rad):
            raise ProjectionError(ErrorCode.NO_TILT, f"tilt_rad is {tilt_rad}, expected a finite angle")
        return PlaneBeams(scanner, float(tilt_rad))

    def _located(self, found: LocatedPoints) -> Located:
        return Located(self.id, found.points, found.covariance, found.is_valid)

    def _of_camera(self, camera: str, n: int) -> IntArray:
        return np.full(n, self._indices((camera,))[0])

    def _indices(self, cameras: Sequence[str]) -> IntArray:
        unknown = [name for name in cameras if name not in self._number_of]
        if unknown:
            raise ProjectionError(
                ErrorCode.UNKNOWN_CAMERA,
                f"no camera {unknown[0]!r:.80} in this calibration",
                f"It has: {_listed(self.camera_names)}.",
            )
        return np.array([self._number_of[name] for name in cameras], dtype=np.int64)


def _plane(given: PlaneGiven) -> Plane:
    try:
        return Plane(np.asarray(given[0], dtype=np.float64), float(given[1]))
    except (InputError, TypeError, ValueError) as error:
        raise ProjectionError(ErrorCode.BAD_REQUEST, f"no plane: {error}") from error


def _sigma(sigma_px: float) -> float:
    if not (sigma_px > 0 and np.isfinite(sigma_px)):
        raise ProjectionError(ErrorCode.BAD_REQUEST, f"sigma_px is {sigma_px:g}, expected a number > 0")
    return float(sigma_px)


def _listed(names: tuple[str, ...]) -> str:
    """Names for a person: the first few of many."""
    shown = ", ".join(names[:12])
    return shown if len(names) <= 12 else f"{shown} and {len(names) - 12} more"
