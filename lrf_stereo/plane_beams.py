"""Equation 3 backwards: which beams of a tilted scanner meet points in the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrf_stereo.scanner import ScanSteps, TiltingScanner
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.rays import Plane

# Half the height of an URG-04LX's beam at 4 m.
PLANE_TOLERANCE_M = 0.02


@dataclass(frozen=True, slots=True)
class SeenBeams:
    """Where a scanner would see N points.

    Attributes:
        bearing_rad: (N,) as it would be measured; NaN where the point is not finite.
        range_m: (N,) the same.
        out_of_plane_m: (N,) height of the point above the scan plane.
        step: (N,) nearest step; -1 where no step of the scan looks there.
        is_seen: (N,) the step is measured, the range can be, and the plane is near enough.
    """

    bearing_rad: FloatArray
    range_m: FloatArray
    out_of_plane_m: FloatArray
    step: IntArray
    is_seen: BoolArray


@dataclass(frozen=True, slots=True)
class PlaneBeams:
    """A scanner at one reported tilt."""

    scanner: TiltingScanner
    tilt_rad: float

    @property
    def plane(self) -> Plane:
        """The scan plane in world."""
        pose = self.scanner.world_from_lrf_at(self.tilt_rad)
        normal = pose.rotation.as_matrix()[:, 2]
        return Plane(normal, float(normal @ pose.translation))

    def seeing(
        self, points_in_world: FloatArray, steps: ScanSteps, *, tolerance_m: float = PLANE_TOLERANCE_M
    ) -> SeenBeams:
        """The beams that meet points (N, 3), those within `tolerance_m` of the plane."""
        with np.errstate(all="ignore"):  # what is not finite is not seen
            range_m, bearing, height = self.scanner.measure(points_in_world, self.tilt_rad)
            at = np.rint(np.mod(steps.step(bearing), steps.steps_per_turn))
            # A turn's last half step is nearest to step 0 of the next.
            at = np.where(at == steps.steps_per_turn, 0, at)
            is_measured = (at >= steps.first_step) & (at <= steps.last_step)
            is_seen = is_measured & steps.is_range(1e3 * range_m) & (np.abs(height) <= tolerance_m)
        step = np.where(is_measured, at, -1).astype(np.int64)
        return SeenBeams(bearing, range_m, height, step, is_seen)
