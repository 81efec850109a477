"""Requests in, answers out, whatever comes: the projection service without its bus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from lrf_stereo.scanner import ScanSteps
from network_calib.errors import SpotcalError
from network_calib.observations import FloatArray
from nodes.projection.calibration import Calibration
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.points import CovarianceOf, LrfPoints, WorldPoints
from nodes.projection.requests import (
    Asked,
    BearingsAsked,
    CameraPixels,
    FloorAsked,
    LocateAsked,
    ProjectAsked,
    RaysAsked,
    TriangulateAsked,
)
from nodes.projection.services import Service
from nodes.projection.wire_answers import Answer, encode_answer, encode_error
from nodes.projection.wire_requests import bearings_asked, locate_asked, project_asked, too_large

# An answer of more than a message may hold would be lost without a word.
MAX_REPLY_BYTES = 12 * 2**20
# Position and depth as doubles, validity as a byte; covariance as four doubles more.
PIXEL_BYTES, COVARIANCE_BYTES = 25, 32
S_NS = 1e9


class TiltLookup(Protocol):
    """What is known of all tilts; `TiltTable` is one."""

    def at(self, lrf: str, stamp_ns: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Tilts and standard deviations at times (N,); NaN where not known.

        Raises:
            ProjectionError: NO_TILT: known at none of them.
        """
        ...


@dataclass(frozen=True, slots=True)
class Told:
    """What is sent back: an answer, or an ErrorReply."""

    payload: bytes
    is_error: bool


class Desk:
    """Answers one request after the other.

    Args:
        current: gives the calibration in force.
        tilts: to look stamps up in.
        steps: of the scanners, for the time of each beam within a scan.
    """

    def __init__(
        self, current: Callable[[], Calibration | None], tilts: TiltLookup, *, steps: ScanSteps | None = None
    ) -> None:
        self._current, self._tilts, self._steps = current, tilts, steps or ScanSteps()

    def answer(self, service: Service, payload: bytes) -> Told:
        """The answer to a payload; never raises."""
        try:
            # What overflows is not finite, and reported as not valid.
            with np.errstate(all="ignore"):
                return Told(encode_answer(self._answer(service, payload)), is_error=False)
        except ProjectionError as error:
            return _refusal(error.code, error.message, error.detail)
        except SpotcalError as error:
            return _refusal(ErrorCode.BAD_REQUEST, error.message, error.advice)
        except Exception as error:  # a defect, but one request must not end the answering of all others
            return _refusal(ErrorCode.FAILED, f"{type(error).__name__}: {error}", "")

    def _answer(self, service: Service, payload: bytes) -> Answer:
        match service:
            case Service.PROJECT:
                return self._project(project_asked(payload))
            case Service.LOCATE:
                return self._locate(locate_asked(payload))
            case Service.BEARINGS:
                return self._bearings(bearings_asked(payload))

    def _calibration(self, asked: Asked) -> Calibration:
        calibration = self._current()
        if calibration is None:
            raise ProjectionError(ErrorCode.NO_CALIBRATION, "the service has no calibration yet", "ask again later")
        if asked.calibration_id not in ("", calibration.id):
            raise ProjectionError(
                ErrorCode.STALE_CALIBRATION,
                f"calibration {asked.calibration_id} is not in force, {calibration.id} is",
                calibration.id,
            )
        return calibration

    def _project(self, asked: ProjectAsked) -> Answer:
        calibration = self._calibration(asked)
        n_cameras = len(calibration.camera_names if asked.cameras is None else asked.cameras)
        n_pixels = n_cameras * len(asked.points)
        size = n_pixels * (PIXEL_BYTES if asked.covariance is None else PIXEL_BYTES + COVARIANCE_BYTES)
        if size > MAX_REPLY_BYTES:
            raise too_large(
                f"{len(asked.points)} points in {n_cameras} cameras make an answer of {size} bytes",
                f"{MAX_REPLY_BYTES} at most: ask for fewer cameras or points at a time",
            )
        asked = self._with_tilt(asked, calibration)
        return calibration.project(asked.points, asked.cameras, covariance=asked.covariance)

    def _with_tilt(self, asked: ProjectAsked, calibration: Calibration) -> ProjectAsked:
        """The request with the tilt of each beam at its own time, where it gave a stamp in place of a tilt."""
        points = asked.points
        if isinstance(points, WorldPoints) or points.tilt_rad is not None or points.stamp_ns is None:
            return asked
        _check_lrf(points.lrf, calibration)
        bearing_rad = np.arctan2(*points.xyz_m.T[1::-1]) if isinstance(points, LrfPoints) else points.bearing_rad
        after_s = self._steps.beam_time_s(np.where(np.isfinite(bearing_rad), bearing_rad, 0.0))
        tilt_rad, sigma_rad = self._tilts.at(points.lrf, points.stamp_ns + np.rint(S_NS * after_s).astype(np.int64))
        if len(tilt_rad) and np.ptp(tilt_rad) == 0:
            tilt_rad = float(tilt_rad[0])
        covariance = asked.covariance and _with_tilt_sigma(asked.covariance, sigma_rad)
        return replace(asked, points=replace(points, tilt_rad=tilt_rad, stamp_ns=None), covariance=covariance)

    def _locate(self, asked: LocateAsked) -> Answer:
        calibration = self._calibration(asked)
        match asked:
            case RaysAsked():
                return calibration.rays(asked.camera, asked.px)
            case FloorAsked(plane=None):
                return calibration.floor_points(asked.camera, asked.px, sigma_px=asked.sigma_px)
            case FloorAsked(plane=(normal, offset)):
                return calibration.floor_points(asked.camera, asked.px, sigma_px=asked.sigma_px, plane=(normal, offset))
            case TriangulateAsked():
                return calibration.triangulate(asked.pixels, asked.sigma_px)
        raise AssertionError(asked)

    def _bearings(self, asked: BearingsAsked) -> Answer:
        calibration = self._calibration(asked)
        tilt_rad = asked.tilt_rad
        if tilt_rad is None and asked.stamp_ns is not None:
            _check_lrf(asked.lrf, calibration)
            tilt_rad = float(self._tilts.at(asked.lrf, [asked.stamp_ns])[0][0])
        if tilt_rad is None:
            raise ProjectionError(ErrorCode.NO_TILT, f"no tilt of {asked.lrf} is given", "give a tilt or a stamp")
        match asked.points:
            case CameraPixels(camera, px):
                return calibration.bearings_of_pixels(asked.lrf, camera, px, tilt_rad, steps=self._steps)
            case points:
                return calibration.bearings(asked.lrf, points, tilt_rad, steps=self._steps)


def _check_lrf(lrf: str, calibration: Calibration) -> None:
    if lrf not in calibration.lrf_names:
        known = ", ".join(calibration.lrf_names) or "none"
        raise ProjectionError(ErrorCode.UNKNOWN_LRF, f"LRF {lrf!r} is not in the calibration", f"there are: {known}")


def _with_tilt_sigma(covariance: CovarianceOf, sigma_rad: FloatArray) -> CovarianceOf:
    """With the uncertainty of a tilt that was looked up; the largest of the scan counts for all of it."""
    noise = covariance.noise
    if noise is None:
        return covariance
    tilt_rad = float(np.hypot(noise.tilt_rad, np.nanmax(sigma_rad, initial=0.0)))
    return replace(covariance, noise=replace(noise, tilt_rad=tilt_rad))


def _refusal(code: str, message: str, detail: str) -> Told:
    return Told(encode_error(code, message, detail), is_error=True)
