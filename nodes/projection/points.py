"""What is asked of a calibration, and what it answers: NumPy arrays with names.

Arrays may be given as lists; they are kept as float64. Rows that are not finite are allowed: their answer is invalid.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lrf_stereo.noise import LrfNoise
from network_calib.observations import BoolArray, FloatArray, IntArray
from nodes.projection.errors import ErrorCode, ProjectionError


@dataclass(frozen=True, slots=True)
class Beams:
    """Measurements of one laser range finder as it reports them.

    Attributes:
        lrf: name.
        range_m: (N,); NaN for a beam without a range.
        bearing_rad: (N,) from forward to the left.
        tilt_rad: as reported: one number, or (N,) one for each beam; None to have it looked up by the stamp.
        stamp_ns: of the scan, where `tilt_rad` is None; its step 0 was measured then.
    """

    lrf: str
    range_m: FloatArray
    bearing_rad: FloatArray
    tilt_rad: float | FloatArray | None = None
    stamp_ns: int | None = None

    def __post_init__(self) -> None:
        for name in ("range_m", "bearing_rad"):
            object.__setattr__(self, name, column(getattr(self, name), name))
        if len(self.range_m) != len(self.bearing_rad):
            raise _bad(f"{len(self.range_m)} ranges, but {len(self.bearing_rad)} bearings")
        object.__setattr__(self, "tilt_rad", tilt_column(self.tilt_rad, len(self)))

    def __len__(self) -> int:
        return len(self.range_m)


@dataclass(frozen=True, slots=True)
class LrfPoints:
    """The same measurements as points: x forward, y left; the third number is zero, for they lie in the scan plane.

    Attributes:
        lrf: name.
        xyz_m: (N, 3), made of the reported ranges and bearings.
        tilt_rad: as in `Beams`.
        stamp_ns: as in `Beams`.
    """

    lrf: str
    xyz_m: FloatArray
    tilt_rad: float | FloatArray | None = None
    stamp_ns: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz_m", rows(self.xyz_m, 3, "xyz_m"))
        height = np.abs(self.xyz_m[:, 2]).max(initial=0.0, where=np.isfinite(self.xyz_m[:, 2]))
        if height > 0:
            raise _bad(f"a point of {self.lrf} lies {height:g} m off the scan plane", "ask for it as a world point")
        object.__setattr__(self, "tilt_rad", tilt_column(self.tilt_rad, len(self)))

    def __len__(self) -> int:
        return len(self.xyz_m)

    def as_beams(self) -> Beams:
        """The measurements that these points were made of."""
        x, y, z = self.xyz_m.T
        with np.errstate(invalid="ignore", over="ignore"):
            # A third number that is no number leaves no point; zero changes nothing.
            return Beams(self.lrf, np.hypot(x, y) + z, np.arctan2(y, x), self.tilt_rad, self.stamp_ns)


@dataclass(frozen=True, slots=True)
class WorldPoints:
    """Points (N, 3) in the world frame of the calibration."""

    xyz_m: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz_m", rows(self.xyz_m, 3, "xyz_m"))

    def __len__(self) -> int:
        return len(self.xyz_m)


Points = Beams | LrfPoints | WorldPoints


@dataclass(frozen=True, slots=True)
class CovarianceOf:
    """What counts as uncertain in the covariance of pixels.

    Attributes:
        calibration: cameras and LRF are as uncertain as the calibration says.
        noise: of the LRF's measurements; without effect on world points.
        point_sigma_m: standard deviation of world points along each axis; without effect on measurements.
    """

    calibration: bool = True
    noise: LrfNoise | None = field(default_factory=LrfNoise)
    point_sigma_m: float = 0.0

    def __post_init__(self) -> None:
        if not (self.point_sigma_m >= 0 and np.isfinite(self.point_sigma_m)):
            raise _bad(f"point_sigma_m {self.point_sigma_m:g}, expected a number from 0 on")


@dataclass(frozen=True, slots=True)
class Projected:
    """N points in C cameras.

    Attributes:
        calibration_id: of the calibration that was used.
        cameras: C names, in the order asked for.
        px: (C, N, 2); NaN behind the camera.
        is_valid: (C, N) in front of the camera, before its lens folds back, and inside its image.
        depth_m: (C, N) z in the camera frame, negative behind it.
        covariance_px2: (C, N, 2, 2), NaN where not valid; None when not asked for.
        tilt_rad: that was used: as given, or as looked up; None for world points.
    """

    calibration_id: str
    cameras: tuple[str, ...]
    px: FloatArray
    is_valid: BoolArray
    depth_m: FloatArray
    covariance_px2: FloatArray | None = None
    tilt_rad: float | FloatArray | None = None

    @property
    def sigma_px(self) -> FloatArray | None:
        """(C, N) standard deviation along the worst direction of the image."""
        if self.covariance_px2 is None:
            return None
        xx, xy, yy = (self.covariance_px2[..., a, b] for a, b in ((0, 0), (0, 1), (1, 1)))
        return np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))


@dataclass(frozen=True, slots=True)
class Rays:
    """Where N pixels look: origin (N, 3), unit direction (N, 3), both NaN where not valid, and validity (N,)."""

    calibration_id: str
    origin_in_world: FloatArray
    direction_in_world: FloatArray
    is_valid: BoolArray


@dataclass(frozen=True, slots=True)
class Located:
    """N points found from pixels: position (N, 3) and covariance (N, 3, 3), NaN where not valid; validity (N,)."""

    calibration_id: str
    xyz_in_world: FloatArray
    covariance_m2: FloatArray
    is_valid: BoolArray


@dataclass(frozen=True, slots=True)
class Bearings:
    """Where an LRF would see N points at its tilt.

    Attributes:
        calibration_id: of the calibration that was used.
        lrf: name.
        bearing_rad: (N,) as the LRF would report it; NaN where the point is not known.
        range_m: (N,) the same.
        out_of_plane_m: (N,) height of the point above the scan plane.
        step: (N,) step of the nearest beam; -1 where no beam of the scan looks there.
        is_seen: (N,) a beam meets the point: its step is measured, its range can be, and the plane is near enough.
    """

    calibration_id: str
    lrf: str
    bearing_rad: FloatArray
    range_m: FloatArray
    out_of_plane_m: FloatArray
    step: IntArray
    is_seen: BoolArray


def column(values: npt.ArrayLike, name: str) -> FloatArray:
    """(N,) numbers.

    Raises:
        ProjectionError: not a column of numbers.
    """
    out = _numbers(values, name)
    if out.ndim != 1:
        raise _bad(f"{name} has the shape {out.shape}, expected one column (N,)")
    return out


def rows(values: npt.ArrayLike, width: int, name: str) -> FloatArray:
    """(N, width) numbers; an empty list has no rows.

    Raises:
        ProjectionError: another shape, or not numbers.
    """
    out = _numbers(values, name)
    if out.size == 0 and out.ndim == 1:
        out = out.reshape(0, width)
    if out.ndim != 2 or out.shape[1] != width:
        raise _bad(f"{name} has the shape {out.shape}, expected (N, {width})")
    return out


def tilt_column(tilt_rad: npt.ArrayLike | None, n: int) -> float | FloatArray | None:
    """One finite tilt, or (N,) tilts of which some may be NaN.

    Raises:
        ProjectionError: another shape, or a single tilt that is not finite.
    """
    if tilt_rad is None:
        return None
    out = _numbers(tilt_rad, "tilt_rad")
    if out.ndim == 0:
        if not np.isfinite(out):
            raise ProjectionError(ErrorCode.NO_TILT, f"tilt_rad is {float(out)}, expected a finite angle")
        return float(out)
    if out.shape != (n,):
        raise _bad(f"tilt_rad has the shape {out.shape}, expected one number or ({n},)")
    return out


def _numbers(values: npt.ArrayLike, name: str) -> FloatArray:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise _bad(f"{name} is not an array of numbers: {error}") from error


def _bad(message: str, detail: str = "") -> ProjectionError:
    return ProjectionError(ErrorCode.BAD_REQUEST, message, detail)
