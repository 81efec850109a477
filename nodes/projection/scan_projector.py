"""Whole scans of one LRF into the cameras that can see them: what a stream does forty times a second.

Most cameras of a site see nothing of a scan: those whose view holds none of its points are left out before anything is
projected, and of the others those that nobody listens to. Walls are not known: where a scan is seen through them, a
largest distance keeps the cameras of other rooms away.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lrf_stereo.frustums import FrustumIndex
from lrf_stereo.noise import LrfNoise
from lrf_stereo.projection import LrfProjection
from lrf_stereo.scanner import ScanSteps
from network_calib.observations import BoolArray, FloatArray, IntArray
from nodes.projection.points import Beams, CovarianceOf
from nodes.projection.projectors import Projectors
from nodes.projection.scan_message import F4, F8

# Standard deviations of a tilt are brought up to the next of these steps, so that what depends on them can be kept.
SIGMA_STEP = 1.02
# Cameras at once: what is computed for them stays in the processor's caches, and the first are told early.
N_AT_ONCE = 45
# So few cost less to project into than to look through.
FEW = 12


@dataclass(frozen=True, slots=True)
class Sweep:
    """One scan with everything that is known of its beams.

    Attributes:
        range_m: (N,) NaN without a range.
        bearing_rad: (N,).
        tilt_rad: (N,) at each beam's own time; NaN where not known.
        tilt_sigma_rad: (N,).
    """

    range_m: FloatArray
    bearing_rad: FloatArray
    tilt_rad: FloatArray
    tilt_sigma_rad: FloatArray


@dataclass(frozen=True, slots=True)
class SeenScan:
    """A scan in C of the cameras that see it.

    Attributes:
        camera: (C,) their indices in the calibration.
        px: (C, N, 2) NaN behind the camera or without a range.
        is_valid: (C, N).
        sigma_px: (C, N) float32, along the long axis of the error ellipse; NaN where not valid.
    """

    camera: IntArray
    px: FloatArray
    is_valid: BoolArray
    sigma_px: npt.NDArray[np.float32]


class ScanProjector:
    """Of one LRF and one calibration. Not for two threads at a time.

    Args:
        projectors: of the calibration; used by this thread alone.
        lrf: name.
        longest_m: that it measures.
        max_distance_m: cameras that no point is so near to are left out.

    Raises:
        ProjectionError: UNKNOWN_LRF.
    """

    def __init__(self, projectors: Projectors, lrf: str, *, longest_m: float, max_distance_m: float = np.inf) -> None:
        self._projectors, self._lrf = projectors, lrf
        self._scanner = projectors.scanner(lrf)
        # Whatever the tilt, the mirror stays on a circle about the axis, and beams end this far from its middle.
        foot = self._foot()
        arm_m = float(np.linalg.norm(np.asarray(self._scanner.world_from_lrf.translation) - foot))
        reach_m = (longest_m - self._scanner.range_bias_m) / self._scanner.range_scale + arm_m
        self._index = FrustumIndex.of(projectors.cameras, max_distance_m=max_distance_m).around(foot, reach_m)

    @property
    def clock_offset_s(self) -> float:
        """What the LRF's stamps lack to the cameras'."""
        return self._scanner.clock_offset_s

    def project(
        self, sweep: Sweep, steps: ScanSteps, *, is_wanted: Callable[[int], bool] | None = None
    ) -> Iterator[SeenScan]:
        """Project a scan into all cameras that see it, some of them at a time.

        Args:
            sweep: the scan.
            steps: of the scanner.
            is_wanted: whether anybody asks for a camera, by its index; None: all are wanted.
        """
        cameras = self._candidates(sweep)
        if is_wanted is not None and len(cameras):
            cameras = cameras[[is_wanted(int(index)) for index in cameras]]
        tilt_rad = float(sweep.tilt_rad[0]) if np.ptp(sweep.tilt_rad) == 0 else sweep.tilt_rad
        beams = Beams(self._lrf, sweep.range_m, sweep.bearing_rad, tilt_rad)
        covariance = CovarianceOf(noise=_noise(sweep, steps))
        for begin in range(0, len(cameras), N_AT_ONCE):
            some = cameras[begin : begin + N_AT_ONCE]
            projection = self._projectors.project_beams(beams, covariance, some)
            is_seen = projection.is_valid.any(axis=1)
            # As they travel, for all cameras at once.
            px = np.ascontiguousarray(projection.px[is_seen], F8)
            sigma_px = _long_axis(projection)[is_seen].astype(F4)
            yield SeenScan(some[is_seen], px, projection.is_valid[is_seen], sigma_px)

    def _candidates(self, sweep: Sweep) -> IntArray:
        """Cameras that may see any of it."""
        if len(self._index) <= FEW and np.isinf(self._index.max_distance_m):
            return self._index.cameras
        return self._index.seeing(self._ends(sweep))

    def _ends(self, sweep: Sweep) -> FloatArray:
        """(n, 3) ends of the beams that have one, in world."""
        has_end = np.isfinite(sweep.range_m) & np.isfinite(sweep.tilt_rad)
        columns = (column[has_end] for column in (sweep.range_m, sweep.bearing_rad, sweep.tilt_rad))
        return self._scanner.points_in_world(*columns)

    def _foot(self) -> FloatArray:
        """(3,) the point of the tilt axis beside the mirror."""
        point, direction = self._scanner.axis_point_in_world, self._scanner.axis_direction_in_world
        origin = np.asarray(self._scanner.world_from_lrf.translation)
        return point + ((origin - point) @ direction) * direction


def _noise(sweep: Sweep, steps: ScanSteps) -> LrfNoise:
    largest = float(np.nanmax(sweep.tilt_sigma_rad))
    tilt_rad = SIGMA_STEP ** np.ceil(np.log(largest) / np.log(SIGMA_STEP)) if largest > 0 else 0.0
    return LrfNoise(bearing_rad=steps.step_rad / np.sqrt(12), tilt_rad=float(tilt_rad))


def _long_axis(projection: LrfProjection) -> FloatArray:
    """(C, N) root of the larger eigenvalue of each covariance; NaN where not valid."""
    covariance, is_valid = projection.covariance_px2, projection.is_valid
    assert covariance is not None
    xx, xy, yy = (covariance[..., a, b][is_valid] for a, b in ((0, 0), (0, 1), (1, 1)))
    out = np.full(is_valid.shape, np.nan)
    out[is_valid] = np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    return out
