"""What a person should know of a calibration of LRFs: never silent where the data cannot tell, or say otherwise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lrf_stereo.held_cameras import CameraSpread, Sensitivity
from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.one_sided import common_height_sigma_m
from lrf_stereo.refine import LrfRefined
from lrf_stereo.scale_check import ScaleCheck, check_scales
from lrf_stereo.tilt_check import TiltCheck, check_tilts
from network_calib.observations import IntArray
from network_calib.result import Doubt
from network_calib.spots import located

MIN_SPAN_RAD = float(np.radians(20.0))
MIN_AGREEING_SHARE = 0.75
# A surprise that chance gives as rarely as a Gaussian exceeds this is no chance.
MAX_SURPRISE_SIGMA = 4.0


def lrf_doubts(
    refined: LrfRefined, network: NetworkData, data: LrfData, *, held: CameraSpread | None = None
) -> Iterator[Doubt]:
    """Doubts about a joint optimum; messages about one scanner begin with its number.

    Args:
        refined: the optimum.
        network: the camera side that it started from.
        data: the LRF side.
        held: what held cameras may be wrong by; None takes them as exact.
    """
    for scanner in range(data.settings.n_scanners):
        yield from _scanner_doubts(refined, data, scanner)
    for scanner, (count, agreeing) in enumerate(zip(*sighting_counts(refined, network, data), strict=True)):
        if agreeing < MIN_AGREEING_SHARE * count:
            yield Doubt(
                "lrf outliers",
                f"LRF {scanner}: only {agreeing} of {count} sightings agree with the cameras",
                "Look for other things in the scan plane, late clocks, and spots that are paired with other frames.",
            )
    for scanner, check in enumerate(check_tilts(refined, network, data, held=held)):
        if check.is_surprising(MAX_SURPRISE_SIGMA):
            yield _tilt_doubt(scanner, check, data)
    for scanner, scale in enumerate(check_scales(refined, network, data, held=held)):
        if scale.is_surprising(MAX_SURPRISE_SIGMA):
            yield _scale_doubt(scanner, scale)
    # chi2 has variance 2 dof; what uncertain cameras add has one of twice its mean's square at most.
    added = 0.0 if held is None else Sensitivity.at(refined, network, data).misfit(held)
    spread = np.sqrt(2 * max(refined.dof, 1) + 2 * added**2)
    if (refined.chi2 - refined.dof - added) / spread > MAX_SURPRISE_SIGMA:
        yield Doubt(
            "lrf chi2",
            f"residuals are larger than their sigmas say: chi2/dof {refined.chi2 / max(refined.dof, 1):.2f}",
            "A tilt angle or a sigma may be wrong, or a clock late: look at the residuals by tilt.",
        )
    if not refined.has_converged:
        yield Doubt("convergence", "the joint solve stopped before it settled", "Take more sightings.")


def sighting_counts(refined: LrfRefined, network: NetworkData, data: LrfData) -> tuple[IntArray, IntArray]:
    """(S,) sightings of each scanner whose spots the cameras located, and those of them that were used."""
    is_usable = (data.point >= 0) & located(network.points)[np.maximum(data.point, 0)]
    n = data.settings.n_scanners
    count, n_used = (np.bincount(data.scanner[rows], minlength=n) for rows in (is_usable, refined.is_inlier))
    return count, n_used


def _scanner_doubts(refined: LrfRefined, data: LrfData, scanner: int) -> Iterator[Doubt]:
    angles = data.settings.angle_rad[data.settings.scanner == scanner]
    if np.ptp(angles) < MIN_SPAN_RAD:
        yield Doubt(
            "tilt span",
            f"LRF {scanner}: its tilts span {np.degrees(np.ptp(angles)):.1f}°",
            "The axis is weak beyond them: add tilts that span 20° or more.",
        )
    sigma_m = common_height_sigma_m(data, refined.is_inlier, scanner)
    if sigma_m > 0:
        yield Doubt(
            "one-sided crossing",
            f"LRF {scanner}: crossings that were seen from one side only may all be off the scan plane the same way; "
            f"no residual can show it, and it puts ± {1e3 * sigma_m:.1f} mm on the scanner's position along its z",
            "Raise the spot through the plane and lower it again at the same place.",
        )


def _scale_doubt(scanner: int, check: ScaleCheck) -> Doubt:
    off, word = 100 * (check.ratio - 1), "longer" if check.ratio > 1 else "shorter"
    return Doubt(
        "lrf scale",
        f"LRF {scanner}: its ranges are {abs(off):.2f} ± {100 * check.sigma:.2g} % {word} than the cameras' metres",
        "Check the distance or the positions that were given; else the LRF: free its range_bias_m or range_scale.",
    )


def _tilt_doubt(scanner: int, check: TiltCheck, data: LrfData) -> Doubt:
    listed = ", ".join(
        f"{np.degrees(data.settings.angle_rad[setting]):.1f}° by {np.degrees(off):+.2f}° ± {np.degrees(sigma):.2f}°"
        for setting, off, sigma in zip(check.setting, check.difference_rad, check.sigma_rad, strict=True)
    )
    reference = np.degrees(data.settings.angle_rad[data.settings.reference_settings()[scanner]])
    return Doubt(
        "tilt angles",
        f"LRF {scanner}: the spots ask for other tilts than were measured: against {reference:.1f}°, {listed}",
        "Check the tilt unit and the IMU's bias, or give the angles the sigma that they have.",
    )
