"""Section IV as a list of steps: pairs of stereo spots and scanner readings at a few tilts in, the scanner's pose out.

`calibrate_paper` does what is printed; `calibrate_screw` keeps its steps, weighs the registration by the real noise of
the points where that is given, and replaces equations 10 to 13 by the general axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrf_stereo.rigid import PointNoise
from lrf_stereo.rigid_ransac import RobustRigid, fit_rigid_robust
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.tilt_axis import paper_axis, screw_axis
from network_calib.errors import InputError, SpotcalError
from network_calib.observations import BoolArray, FloatArray, IntArray

# Half a metre keeps honest spots: three standard deviations of the depth that the paper's stereo pair gives at 3 m.
THRESHOLD_M = 0.5


@dataclass(frozen=True, slots=True)
class PlaneSamples:
    """N spots in the scan plane, each seen by the stereo pair and by the scanner at one of T tilts.

    Attributes:
        spot_in_cam: (N, 3) triangulated spots (equation 6) in the camera's frame, metres.
        range_m: (N,) measured.
        bearing_rad: (N,) measured.
        setting: (N,) index of the tilt, 0..T-1.
        tilt_rad: (T,) tilts, known.
        noise: of spots (target) and scanner points (source), or None where it is not known.
    """

    spot_in_cam: FloatArray
    range_m: FloatArray
    bearing_rad: FloatArray
    setting: IntArray
    tilt_rad: FloatArray
    noise: PointNoise | None = None

    def __post_init__(self) -> None:
        lengths = {len(self.spot_in_cam), len(self.range_m), len(self.bearing_rad), len(self.setting)}
        if len(lengths) != 1:
            raise InputError(f"columns of plane samples have different lengths: {sorted(lengths)}")
        if not all(np.isfinite(column).all() for column in (self.spot_in_cam, self.range_m, self.bearing_rad)):
            raise InputError("plane samples hold values that are not finite: leave unseen spots and error codes out")
        if len(self.setting) and not 0 <= self.setting.min() <= self.setting.max() < len(self.tilt_rad):
            raise InputError(f"tilt settings {self.setting.min()}..{self.setting.max()} of {len(self.tilt_rad)} tilts")

    @property
    def point_in_lrf(self) -> FloatArray:
        """(N, 3) scanner points, in the scan plane."""
        x, y = self.range_m * np.cos(self.bearing_rad), self.range_m * np.sin(self.bearing_rad)
        return np.column_stack([x, y, np.zeros(len(x))])


@dataclass(frozen=True, slots=True)
class StereoCalibration:
    """A scanner calibrated to a stereo pair.

    Attributes:
        scanner: in the camera's frame; the paper's L(alpha)_T_C is its `world_from_lrf_at`.
        cam_from_lrf: batch of T poses, the registrations at each tilt.
        is_inlier: (N,) samples that RANSAC kept.
        rms_m: (T,) root mean square distance of the inliers at each tilt after registration.
    """

    scanner: TiltingScanner
    cam_from_lrf: RigidTransform
    is_inlier: BoolArray
    rms_m: FloatArray


def calibrate_paper(
    samples: PlaneSamples, *, rng: np.random.Generator, threshold_m: float = THRESHOLD_M
) -> StereoCalibration:
    """Section IV as printed: RANSAC and equation 8 at each of three tilts, then equations 10 to 13.

    Args:
        samples: at exactly three tilts.
        rng: draws the triples of RANSAC.
        threshold_m: largest distance of an inlier.

    Raises:
        InputError: not three tilts.
        DegenerateError: too few spots at a tilt, or on one line; says which tilt.
        ConvergenceError: no registration agrees with a third of the spots of a tilt; says which.
    """
    registered = _register_each_tilt(samples, None, rng=rng, threshold_m=threshold_m)
    cam_from_lrf = _poses(registered)
    return _with_quality(paper_axis(cam_from_lrf, samples.tilt_rad), cam_from_lrf, registered, samples)


def calibrate_screw(
    samples: PlaneSamples, *, rng: np.random.Generator, threshold_m: float = THRESHOLD_M
) -> StereoCalibration:
    """The same with the general axis, and with weights where the samples carry their noise; two tilts or more.

    Raises:
        DegenerateError: as `calibrate_paper`; or fewer than two tilts, or tilts that span less than 5 degrees.
        ConvergenceError: as `calibrate_paper`.
    """
    registered = _register_each_tilt(samples, samples.noise, rng=rng, threshold_m=threshold_m)
    cam_from_lrf = _poses(registered)
    return _with_quality(screw_axis(cam_from_lrf, samples.tilt_rad), cam_from_lrf, registered, samples)


def _register_each_tilt(
    samples: PlaneSamples, noise: PointNoise | None, *, rng: np.random.Generator, threshold_m: float
) -> list[RobustRigid]:
    """Section IV-A: RANSAC, then equation 8 on its inliers, at each tilt."""
    registered = []
    threshold = threshold_m if noise is None else None
    for k, tilt in enumerate(samples.tilt_rad):
        rows = np.flatnonzero(samples.setting == k)
        source, target = samples.point_in_lrf[rows], samples.spot_in_cam[rows]
        of_rows = None if noise is None else noise.select(rows)
        try:
            registered.append(fit_rigid_robust(source, target, rng=rng, threshold_m=threshold, noise=of_rows))
        except SpotcalError as error:
            where = f"tilt setting {k} ({np.rad2deg(tilt):.1f} degrees, {len(rows)} spots)"
            raise type(error)(f"{where}: {error.message}", advice=error.advice) from error
    return registered


def _poses(registered: list[RobustRigid]) -> RigidTransform:
    return RigidTransform.concatenate([fit.target_from_source for fit in registered])


def _with_quality(
    scanner: TiltingScanner, cam_from_lrf: RigidTransform, registered: list[RobustRigid], samples: PlaneSamples
) -> StereoCalibration:
    is_inlier, rms_m = np.zeros(len(samples.setting), dtype=bool), np.zeros(len(registered))
    for k, fit in enumerate(registered):
        rows = np.flatnonzero(samples.setting == k)
        is_inlier[rows] = fit.is_inlier
        kept = rows[fit.is_inlier]
        error = samples.spot_in_cam[kept] - fit.target_from_source.apply(samples.point_in_lrf[kept])
        rms_m[k] = np.sqrt((error**2).sum(axis=1).mean())
    return StereoCalibration(scanner, cam_from_lrf, is_inlier, rms_m)
