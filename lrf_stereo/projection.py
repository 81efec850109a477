"""Equation 14 as an array function: LRF measurements to pixels of every camera, with validity and covariance.

    u = H L(alpha)_T_W l(alpha)_p

A beam's end is found once and then projected into all cameras, a tile of cameras x beams at a time, so that what a tile
needs stays in the processor's cache.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lrf_stereo.beams import N_SCANNER, Beams, Measurements, TiltedScanner
from lrf_stereo.camera_array import CameraArray, PointSpread
from lrf_stereo.noise import LrfNoise
from lrf_stereo.scanner import TiltingScanner
from network_calib.camera_parameters import N_PARAMETERS
from network_calib.cameras import Cameras
from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray


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
        given = covariance or CalibrationCovariance()
        given.check(len(cameras))
        array = CameraArray(cameras, covariance=given.cameras, camera_scanner=given.camera_scanner)
        self._prepare(scanner, array, given, is_calibration_uncertain=covariance is not None)

    @classmethod
    def sharing(
        cls, array: CameraArray, scanner: TiltingScanner, scanner_covariance: FloatArray | None = None
    ) -> LrfProjector:
        """A projector into cameras that stand prepared for other scanners too.

        Without noise and without `scanner_covariance` (15, 15) it gives no covariance.
        """
        out = cls.__new__(cls)
        given = CalibrationCovariance(scanner=scanner_covariance)
        given.check(len(array))
        out._prepare(scanner, array, given, is_calibration_uncertain=scanner_covariance is not None)
        return out

    def _prepare(
        self,
        scanner: TiltingScanner,
        array: CameraArray,
        given: CalibrationCovariance,
        *,
        is_calibration_uncertain: bool,
    ) -> None:
        self._covariance = given
        self._is_calibration_uncertain = is_calibration_uncertain
        self._array = array
        self._tilted = TiltedScanner.of(scanner, np.empty(0))
        self._spread: tuple[LrfNoise | None, FloatArray] | None = None

    def project(
        self,
        range_m: npt.ArrayLike,
        bearing_rad: npt.ArrayLike,
        tilt_rad: npt.ArrayLike,
        *,
        noise: LrfNoise | None = None,
        cameras: IntArray | None = None,
    ) -> LrfProjection:
        """Project measurements; arguments and result as in `project_lrf`.

        Args:
            range_m: see `project_lrf`.
            bearing_rad: see `project_lrf`.
            tilt_rad: see `project_lrf`.
            noise: see `project_lrf`.
            cameras: indices of the cameras to project into, in the order of the result; all by default.
        """
        with np.errstate(all="ignore"):  # what is not finite ends nowhere, and is reported as invalid
            measured = Measurements.of(range_m, bearing_rad, tilt_rad)
            self._tilt(measured.tilts_rad)
            beams = Beams.of(self._tilted, measured.tilt_of, measured.range_m, measured.bearing_rad)
            is_wanted = noise is not None or self._is_calibration_uncertain
            spread = self._spread_of(beams, noise) if is_wanted else None
            sheet = self._array.project(beams.ends_in_world(), spread, cameras)
        whole = (len(sheet.depth_m), *measured.shape)
        return LrfProjection(
            px=sheet.px_of_shape(measured.shape),
            is_valid=sheet.is_valid.reshape(whole),
            depth_m=sheet.depth_m.reshape(whole),
            covariance_px2=sheet.covariance_of_shape(measured.shape),
        )

    def _tilt(self, tilts_rad: FloatArray) -> None:
        if not np.array_equal(tilts_rad, self._tilted.tilts_rad):
            self._tilted, self._spread = TiltedScanner.of(self._tilted.scanner, tilts_rad.copy()), None

    def _spread_of(self, beams: Beams, noise: LrfNoise | None) -> PointSpread:
        if self._spread is None or self._spread[0] != noise:
            self._spread = noise, self._tilted.factors_of_spread(noise, self._covariance.scanner)
        slope = None if self._covariance.camera_scanner is None else beams.by_scanner()
        return PointSpread(beams.covariance(self._spread[1], noise), slope)
