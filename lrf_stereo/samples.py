"""What LRF nodes deliver to the calibration: spots in scan planes, and the tilt angles of the settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray

# A hand does not keep its way for longer: a larger delay is another frame, or another clock's zero.
MAX_DELAY_S = 1.0


@dataclass(frozen=True, slots=True)
class LrfSpots:
    """M sightings of the spot in a scan plane.

    Attributes:
        frame: (M,) frame number; equal to a camera observation's frame where they show the same spot.
        setting: (M,) tilt setting, an index into `TiltSettings`.
        range_m: (M,) measured range to the spot's centre.
        bearing_rad: (M,) measured bearing, x towards y.
        out_of_plane_m: (M,) known height of the spot's centre over the scan plane; zero after a two-sided crossing.
        sigma_range_m: (M,) standard deviation.
        sigma_bearing_rad: (M,) standard deviation.
        sigma_out_of_plane_m: (M,) standard deviation, from the crossing procedure.
        bias_bound_m: (M,) how far the centre may have been off the plane, always to the same side: of a one-sided
            crossing (`crossing.Crossings.bias_bound_m`); zero, the default, for a two-sided one.
        delay_s: (M,) time of the beam that hit the spot, less that of the cameras' exposure of this frame, on the
            stated clocks: the scan's stamp, and `ScanSteps.beam_time_s` of the bearing on top. Zero by default.
    """

    frame: IntArray
    setting: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    out_of_plane_m: FloatArray
    sigma_range_m: FloatArray
    sigma_bearing_rad: FloatArray
    sigma_out_of_plane_m: FloatArray
    bias_bound_m: FloatArray = field(default_factory=lambda: np.empty(0))
    delay_s: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        for name in ("bias_bound_m", "delay_s"):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.zeros(len(self.frame)))
        measured = np.stack([self.range_m, self.bearing_rad, self.out_of_plane_m])
        if not np.isfinite(measured).all() or (self.range_m <= 0).any():
            bad = int(np.flatnonzero(~np.isfinite(measured).all(axis=0) | ~(self.range_m > 0))[0])
            raise InputError(f"LRF sighting {bad} in frame {self.frame[bad]} is not a range and bearing")
        sigma = np.stack([self.sigma_range_m, self.sigma_bearing_rad, self.sigma_out_of_plane_m])
        if not (np.isfinite(sigma).all() and (sigma > 0).all()):
            bad = int(np.flatnonzero(~(np.isfinite(sigma) & (sigma > 0)).all(axis=0))[0])
            raise InputError(f"LRF sighting {bad} in frame {self.frame[bad]} has a sigma that is not positive")
        if len(self.bias_bound_m) != len(self.frame) or not (self.bias_bound_m >= 0).all():
            raise InputError("bounds of the crossings' bias must be numbers from 0, one for each LRF sighting")
        if len(self.delay_s) != len(self.frame) or not (np.abs(self.delay_s) <= MAX_DELAY_S).all():
            raise InputError(
                f"delays of LRF sightings must be seconds within +-{MAX_DELAY_S:g}, one for each sighting",
                advice="Count each delay from the exposure of the frame that is nearest in time, on one clock.",
            )

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, is_kept: BoolArray) -> LrfSpots:
        """The sightings where `is_kept` (M,) holds."""
        return replace(self, **{name: getattr(self, name)[is_kept] for name in self.__slots__})


@dataclass(frozen=True, slots=True)
class TiltSettings:
    """T tilt settings of S scanners.

    Attributes:
        scanner: (T,) scanner index of each setting, 0..S-1.
        angle_rad: (T,) tilt angle as measured; only differences within a scanner matter.
        covariance_rad2: (T, T) of the angles.
    """

    scanner: IntArray
    angle_rad: FloatArray
    covariance_rad2: FloatArray

    def __post_init__(self) -> None:
        n = len(self.angle_rad)
        if self.covariance_rad2.shape != (n, n) or self.scanner.shape != (n,):
            raise InputError(f"{n} tilt settings need {n} scanners and a covariance of {n} x {n}")
        if not np.isfinite(self.angle_rad).all() or np.linalg.eigvalsh(self.covariance_rad2)[0] < -1e-15:
            raise InputError("tilt angles must be finite and their covariance positive semidefinite")

    @property
    def n_scanners(self) -> int:
        return int(self.scanner.max(initial=-1)) + 1

    def reference_settings(self) -> IntArray:
        """(S,) the setting at which each scanner's pose is held: its first."""
        return np.array([int(np.flatnonzero(self.scanner == s)[0]) for s in range(self.n_scanners)], dtype=np.int64)
