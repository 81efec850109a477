"""The demonstration's calibration beside the truth: errors, their predicted sigmas, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from rich.table import Table
from rich.text import Text

from lrf_stereo.calibrated_scanner import scanner_of
from lrf_stereo.scanner import TiltingScanner
from network_calib.cameras import Cameras
from network_calib.evaluate import evaluate
from network_calib.observations import FloatArray, IntArray
from network_calib.result import PARAMETER_NAMES, CalibratedLrf, Calibration
from network_calib.synthetic import CameraErrors, Room, Sighting, compare
from nodes.report.tables import plain_table

# A vector error of this many of its own standard deviations: chance under one in 10^5 for a centre (3 dof). Beyond it
# the predicted sigma is wrong, not the luck bad.
MAX_SIGMA = 5.0
# What is to be reached in the smart room; for a centre (3 dof) three of its sigmas are one chance in 30 or rarer.
MAX_CENTRE_SIGMA, MAX_CENTRE_M, MAX_HOLDOUT_PX, MAX_LRF_PX = 3.0, 5e-3, 0.2, 0.5
# m or px: what a few products of numbers up to 1e3 leave of a value that is exact by definition.
ROUNDING = 1e-9
# Beams whose ends are projected: where people are, seen from the scanner.
LRF_RANGE_M, LRF_BEARING_RAD = np.linspace(1.0, 3.5, 11), np.linspace(-0.8, 0.8, 17)


@dataclass(frozen=True, slots=True)
class CameraComparison:
    """Estimated cameras against the true ones, in the first camera's frame, where the covariances are stated.

    Attributes:
        errors: differences of each camera.
        centre_sigma_m: (C,) predicted, root of the sum over the axes.
        focal_sigma_px: (C,) predicted.
    """

    errors: CameraErrors
    centre_sigma_m: FloatArray
    focal_sigma_px: FloatArray

    @property
    def centre_in_sigma(self) -> FloatArray:
        """(C,) error over sigma; 0 for the camera that holds the frame."""
        return _ratio(self.errors.centre_m, self.centre_sigma_m)

    @property
    def focal_in_sigma(self) -> FloatArray:
        """(C,) error over sigma."""
        return _ratio(np.abs(self.errors.focal_px), self.focal_sigma_px)

    @property
    def is_as_predicted(self) -> bool:
        """No error exceeds MAX_SIGMA."""
        return bool(max(self.centre_in_sigma.max(), self.focal_in_sigma.max()) <= MAX_SIGMA)


@dataclass(frozen=True, slots=True)
class LrfComparison:
    """Where an LRF's points are projected to, against where they truly appear; over all cameras that see them.

    Attributes:
        name: of the LRF.
        tilt_rad: (T,) true tilts.
        median_px: (T,) of the pixels' distances.
        p95_px: (T,) of the same.
        n_points: (T,) pixels that were compared.
    """

    name: str
    tilt_rad: FloatArray
    median_px: FloatArray
    p95_px: FloatArray
    n_points: IntArray


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was missed; empty when everything was reached."""

    missed: tuple[str, ...]

    @property
    def text(self) -> Text:
        """For the terminal."""
        if not self.missed:
            return Text(
                f"Reached: centres within {MAX_CENTRE_SIGMA:g} of their predicted σ and {1e3 * MAX_CENTRE_M:g} mm, "
                f"hold-out within {MAX_HOLDOUT_PX:g} px, LRF points within {MAX_LRF_PX:g} px.",
                style="green",
            )
        return Text(f"Missed: {'; '.join(self.missed)}.", style="bold red")


def compare_cameras(calibration: Calibration, truth: Cameras) -> CameraComparison:
    """Errors in the frame of the first camera, without any alignment: this frame and its scale are the claim."""
    sigma = np.array([camera.sigma for camera in calibration.cameras])
    return CameraComparison(
        errors=compare(calibration.as_cameras(), _in_first_frame(truth), align="none"),
        centre_sigma_m=np.linalg.norm(sigma[:, 3:6], axis=1),
        focal_sigma_px=sigma[:, PARAMETER_NAMES.index("focal_px")],
    )


@dataclass(frozen=True, slots=True)
class Comparison:
    """Cameras, and the detections that were told apart.

    Attributes:
        cameras: against the true ones.
        mask_share: share of the detections that were rightly taken as spot or as false.
    """

    cameras: CameraComparison
    mask_share: float


def compare_with_truth(calibration: Calibration, built: Room, sighting: Sighting) -> Comparison:
    """Cameras and detections of a simulated room against the truth."""
    evaluation = evaluate(calibration, sighting.observations)
    is_evaluated = sighting.observations.n_views() >= 2
    share = float((evaluation.is_inlier == sighting.is_usable[is_evaluated]).mean())
    return Comparison(compare_cameras(calibration, built.cameras), share)


def compare_lrf(
    calibration: Calibration, lrf: CalibratedLrf, cameras: Cameras, scanner: TiltingScanner, tilts_rad: Sequence[float]
) -> LrfComparison:
    """Beams of the calibrated LRF at its solved tilts, against the same beams of the true one at the true tilts.

    Args:
        calibration: of the cameras too.
        lrf: of the calibration.
        cameras: the true ones, in their order in the calibration.
        scanner: the true one.
        tilts_rad: true tilts of the settings, in order.
    """
    range_m, bearing_rad = (axis.ravel() for axis in np.meshgrid(LRF_RANGE_M, LRF_BEARING_RAD))
    found_scanner, found_cameras = scanner_of(lrf), calibration.as_cameras()
    error_px: list[FloatArray] = []
    for found_rad, true_rad in zip(lrf.tilt_rad.tolist(), tilts_rad, strict=True):
        found = _pixels(found_cameras, found_scanner.points_in_world(range_m, bearing_rad, found_rad))
        true = _pixels(cameras, scanner.points_in_world(range_m, bearing_rad, true_rad))
        distance = np.linalg.norm(found - true, axis=-1)
        error_px.append(distance[np.isfinite(distance)])
    return LrfComparison(
        name=lrf.name,
        tilt_rad=np.array(tilts_rad),
        median_px=np.array([np.median(error) for error in error_px]),
        p95_px=np.array([np.percentile(error, 95) for error in error_px]),
        n_points=np.array([len(error) for error in error_px]),
    )


def truth_table(comparison: CameraComparison) -> Table:
    """Errors beside the standard deviations that the calibration predicts for them."""
    heads = ("rotation, °", "centre, mm", "its σ", "focal, px", "its σ", "errors / σ")
    table = plain_table("Errors against the truth", "camera", *heads)
    errors = comparison.errors
    for k, name in enumerate(errors.names):
        centre_sigma = comparison.centre_sigma_m[k]
        table.add_row(
            Text(name),
            f"{errors.rotation_deg[k]:.4f}",
            f"{1e3 * errors.centre_m[k]:.2f}",
            f"{1e3 * centre_sigma:.2f}" if centre_sigma > ROUNDING else "–",
            f"{errors.focal_px[k]:+.2f}",
            f"{comparison.focal_sigma_px[k]:.2f}",
            f"{comparison.centre_in_sigma[k]:.1f}, {comparison.focal_in_sigma[k]:.1f}",
        )
    return table


def lrf_truth_table(comparisons: Sequence[LrfComparison]) -> Table:
    """Pixel errors of projected LRF points, by tilt."""
    table = plain_table("LRF points projected into the cameras", "LRF", "tilt, °", "points", "median, px", "95 %, px")
    for one in comparisons:
        for k, tilt_rad in enumerate(one.tilt_rad):
            table.add_row(
                Text(one.name),
                f"{np.degrees(tilt_rad):.2f}",
                str(one.n_points[k]),
                f"{one.median_px[k]:.3f}",
                f"{one.p95_px[k]:.3f}",
            )
    return table


def verdict_of(calibration: Calibration, cameras: CameraComparison, lrfs: Sequence[LrfComparison]) -> Verdict:
    """What was to be reached, and was not."""
    missed: list[str] = []
    for k, name in enumerate(cameras.errors.names):
        centre_m, in_sigma = cameras.errors.centre_m[k], cameras.centre_in_sigma[k]
        if not (centre_m <= MAX_CENTRE_M and in_sigma <= MAX_CENTRE_SIGMA):
            missed.append(f"the centre of {name} is off by {1e3 * centre_m:.2f} mm, {in_sigma:.1f} of its σ")
        if not cameras.focal_in_sigma[k] <= MAX_SIGMA:
            missed.append(f"the focal length of {name} is off by {cameras.focal_in_sigma[k]:.1f} of its σ")
    holdout_px = calibration.quality.holdout.rms_px
    if not holdout_px <= MAX_HOLDOUT_PX:
        missed.append(f"hold-out is {holdout_px:.3f} px RMS, at most {MAX_HOLDOUT_PX:g} was to be reached")
    if not lrfs:
        missed.append("no LRF was calibrated")
    for one in lrfs:
        for tilt_rad, median_px in zip(one.tilt_rad, one.median_px, strict=True):
            if not median_px <= MAX_LRF_PX:
                missed.append(f"points of {one.name} at {np.degrees(tilt_rad):.1f}° are off by {median_px:.2f} px")
    return Verdict(tuple(missed))


def _pixels(cameras: Cameras, points: FloatArray) -> FloatArray:
    """(C, N, 2) of points (N, 3); NaN where a camera does not have one in its image."""
    out: list[FloatArray] = []
    for camera in range(len(cameras)):
        index = np.full(len(points), camera)
        px, is_valid = cameras.img_from_world(index, points)
        out.append(np.where((is_valid & cameras.is_in_image(index, px))[:, None], px, np.nan))
    return np.stack(out)


def _ratio(error: FloatArray, sigma: FloatArray) -> FloatArray:
    """error / sigma; where sigma is rounding the value is held, and any error beyond rounding is infinitely wrong."""
    is_free = sigma > ROUNDING
    held = np.where(error > ROUNDING, np.inf, 0.0)
    return np.where(is_free, error / np.where(is_free, sigma, 1.0), held)


def _in_first_frame(cameras: Cameras) -> Cameras:
    poses = cameras.cam_from_world
    return replace(cameras, cam_from_world=poses * poses[0].inv())
