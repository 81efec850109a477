"""The questions that a calibration answers, each as one value: what a client sends and the service takes apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from network_calib.observations import FloatArray
from nodes.projection.points import CovarianceOf, Points


@dataclass(frozen=True, slots=True)
class ProjectAsked:
    """Where do points appear?

    Attributes:
        points: N of them.
        cameras: names; None: all.
        covariance: what counts as uncertain; None: no covariance.
        calibration_id: the only one to answer under; empty: the current one.
    """

    points: Points
    cameras: tuple[str, ...] | None = None
    covariance: CovarianceOf | None = None
    calibration_id: str = ""


@dataclass(frozen=True, slots=True)
class RaysAsked:
    """Along which lines do pixels (N, 2) of a camera look?"""

    camera: str
    px: FloatArray
    calibration_id: str = ""


@dataclass(frozen=True, slots=True)
class FloorAsked:
    """Where do the lines of pixels (N, 2) meet a plane?

    Attributes:
        camera: name.
        px: (N, 2).
        sigma_px: standard deviation of a pixel, each axis.
        plane: normal (3,) and offset: normal . x = offset; None: z = 0.
        calibration_id: as in `ProjectAsked`.
    """

    camera: str
    px: FloatArray
    sigma_px: float
    plane: tuple[FloatArray, float] | None = None
    calibration_id: str = ""


@dataclass(frozen=True, slots=True)
class TriangulateAsked:
    """Where do the lines of the same N points in several cameras meet? Pixels (N, 2), NaN where not seen."""

    pixels: Mapping[str, FloatArray]
    sigma_px: float
    calibration_id: str = ""


@dataclass(frozen=True, slots=True)
class CameraPixels:
    """Pixels (N, 2) of a camera."""

    camera: str
    px: FloatArray


@dataclass(frozen=True, slots=True)
class BearingsAsked:
    """Which beams of a scanner meet points, at its tilt or at the tilt that it had at a stamp?

    Attributes:
        lrf: name.
        points: (N, 3) of the world, or pixels whose lines meet the scan plane.
        tilt_rad: as the scanner reports it; None to have it looked up by the stamp.
        stamp_ns: see `tilt_rad`.
        calibration_id: as in `ProjectAsked`.
    """

    lrf: str
    points: FloatArray | CameraPixels
    tilt_rad: float | None
    stamp_ns: int | None = None
    calibration_id: str = ""


LocateAsked = RaysAsked | FloorAsked | TriangulateAsked
Asked = ProjectAsked | LocateAsked | BearingsAsked
