"""The projectors of one calibration: its cameras prepared once, shared by all LRFs."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from lrf_stereo.calibrated_scanner import scanner_of
from lrf_stereo.camera_array import CameraArray, PointSpread
from lrf_stereo.frustums import FrustumIndex
from lrf_stereo.projection import LrfProjection, LrfProjector
from lrf_stereo.scanner import TiltingScanner
from network_calib.cameras import Cameras
from network_calib.observations import FloatArray, IntArray
from network_calib.result import Calibration as CalibrationResult
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.points import Beams, CovarianceOf, WorldPoints


class Projectors:
    """Prepared when first needed, and kept. Not for two threads at a time."""

    def __init__(self, result: CalibrationResult) -> None:
        self.cameras: Cameras = result.as_cameras()
        self.covariance: FloatArray = np.stack([camera.covariance for camera in result.cameras])
        self.scanners: dict[str, TiltingScanner] = {lrf.name: scanner_of(lrf) for lrf in result.lrfs}
        self._lrfs = {lrf.name: lrf for lrf in result.lrfs}
        self._of_lrf: dict[tuple[str, bool], LrfProjector] = {}
        self._index: FrustumIndex | None = None

    def scanner(self, lrf: str) -> TiltingScanner:
        """The scanner of a name.

        Raises:
            ProjectionError: UNKNOWN_LRF.
        """
        if lrf not in self.scanners:
            known = ", ".join(self.scanners) or "none"
            raise ProjectionError(ErrorCode.UNKNOWN_LRF, f"no LRF {lrf!r} in this calibration", f"It has: {known}.")
        return self.scanners[lrf]

    def project_beams(self, beams: Beams, covariance: CovarianceOf | None, cameras: IntArray | None) -> LrfProjection:
        """Measurements; their tilt is known.

        Raises:
            ProjectionError: UNKNOWN_LRF, NO_TILT.
        """
        is_uncertain = covariance is not None and covariance.calibration
        projector = self._projector(beams.lrf, is_uncertain=is_uncertain)
        noise = None if covariance is None else covariance.noise
        if covariance is not None and not is_uncertain and noise is None:
            raise ProjectionError(ErrorCode.BAD_REQUEST, "a covariance was asked for, of nothing that is uncertain")
        tilt_rad = known_tilt(beams)
        return projector.project(beams.range_m, beams.bearing_rad, tilt_rad, noise=noise, cameras=cameras)

    def project_points(
        self, points: WorldPoints, covariance: CovarianceOf | None, cameras: IntArray | None
    ) -> LrfProjection:
        """Points in world."""
        array = self._uncertain if covariance is not None and covariance.calibration else self._exact
        in_rows = np.ascontiguousarray(points.xyz_m.T)
        spread = None
        if covariance is not None:
            one = covariance.point_sigma_m**2 * np.eye(3)
            spread = PointSpread(np.repeat(one[:, :, None], len(points), axis=2))
        sheet = array.project(in_rows, spread, cameras)
        shape = (len(points),)
        return LrfProjection(sheet.px_of_shape(shape), sheet.is_valid, sheet.depth_m, sheet.covariance_of_shape(shape))

    def cameras_seeing(self, points: Beams | WorldPoints, max_distance_m: float) -> IntArray:
        """Indices of all cameras in which any of the points may be valid.

        Raises:
            ProjectionError: UNKNOWN_LRF, NO_TILT.
        """
        if isinstance(points, WorldPoints):
            return self.index(max_distance_m).seeing(points.xyz_m)
        with np.errstate(all="ignore"):  # what is not finite ends nowhere
            ends = self.scanner(points.lrf).points_in_world(points.range_m, points.bearing_rad, known_tilt(points))
        return self.index(max_distance_m).seeing(ends)

    def index(self, max_distance_m: float) -> FrustumIndex:
        """Which cameras see what, up to a distance; kept for the distance asked for last."""
        if self._index is None or self._index.max_distance_m != max_distance_m:
            self._index = FrustumIndex.of(self.cameras, max_distance_m=max_distance_m)
        return self._index

    def _projector(self, lrf: str, *, is_uncertain: bool) -> LrfProjector:
        key = lrf, is_uncertain
        if key not in self._of_lrf:
            scanner = self.scanner(lrf)
            array = self._uncertain if is_uncertain else self._exact
            spread = self._lrfs[lrf].covariance if is_uncertain else None
            self._of_lrf[key] = LrfProjector.sharing(array, scanner, spread)
        return self._of_lrf[key]

    @cached_property
    def _exact(self) -> CameraArray:
        return CameraArray(self.cameras)

    @cached_property
    def _uncertain(self) -> CameraArray:
        return CameraArray(self.cameras, covariance=self.covariance)


def known_tilt(beams: Beams) -> float | FloatArray:
    """The tilt of measurements.

    Raises:
        ProjectionError: NO_TILT: it is not given; only the service can look it up by the stamp.
    """
    if beams.tilt_rad is None:
        raise ProjectionError(
            ErrorCode.NO_TILT,
            f"no tilt of {beams.lrf} is given",
            "Give tilt_rad; a stamp is looked up by the service alone, which hears the tilts.",
        )
    return beams.tilt_rad
