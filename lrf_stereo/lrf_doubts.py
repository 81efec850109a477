"""What a person should know of a calibration of LRFs: never silent where the data cannot tell, or say otherwise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lrf_stereo.joint_problem import LrfData, NetworkData
from lrf_stereo.one_sided import common_height_sigma_m
from lrf_stereo.refine import LrfRefined
from lrf_stereo.tilt_check import TiltCheck, check_tilts
from network_calib.result import Doubt

MIN_SPAN_RAD = float(np.radians(20.0))
# A surprise that chance gives as rarely as a Gaussian exceeds this is no chance.
MAX_SURPRISE_SIGMA = 4.0


def lrf_doubts(refined: LrfRefined, network: NetworkData, data: LrfData) -> Iterator[Doubt]:
    """Doubts about a joint optimum; messages about one scanner begin with its number.

    Args:
        refined: the optimum.
        network: the camera side that it started from.
        data: the LRF side.
    """
    for scanner in range(data.settings.n_scanners):
        yield from _scanner_doubts(refined, data, scanner)
    for scanner, check in enumerate(check_tilts(refined, network, data)):
        if check.is_surprising(MAX_SURPRISE_SIGMA):
            yield _tilt_doubt(scanner, check, data)
    # chi2 has variance 2 dof.
    if (refined.chi2 - refined.dof) / np.sqrt(2 * max(refined.dof, 1)) > MAX_SURPRISE_SIGMA:
        yield Doubt(
            "lrf chi2",
            f"residuals are larger than their sigmas say: chi2/dof {refined.chi2 / max(refined.dof, 1):.2f}",
            "A tilt angle or a sigma may be wrong, or a clock late: look at the residuals by tilt.",
        )
    if not refined.has_converged:
        yield Doubt("convergence", "the joint solve stopped before it settled", "Take more sightings.")


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
