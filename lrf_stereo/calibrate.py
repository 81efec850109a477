"""Sections IV and V with the general model, as a list of steps: each LRF to the network, then all together.

The own sequence of the paper is in `paper.py`; here its registration (weighted by the real noise) and the general
tilt axis only make the start of one joint maximum-likelihood solve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lrf_stereo.clock_doubts import clock_doubts
from lrf_stereo.held_cameras import CameraSpread, with_camera_errors
from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.joint_frame import JointFrame
from lrf_stereo.lrf_doubts import lrf_doubts, sighting_counts
from lrf_stereo.lrf_priors import Instruments
from lrf_stereo.one_sided import with_common_height
from lrf_stereo.paper import PlaneSamples, calibrate_screw
from lrf_stereo.range_scale import in_scale_of_ranges, start_of_joint_solve
from lrf_stereo.refine import LrfCovariance, LrfRefined, lrf_covariance, refine_jointly
from lrf_stereo.rigid import PointNoise
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.sighting_block import expected_displacement
from network_calib.errors import DegenerateError
from network_calib.observations import FloatArray, IntArray
from network_calib.result import Doubt
from network_calib.spots import located, spots_from_cameras

MIN_SIGHTINGS = 6
MIN_AGREEING_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class LrfCalibration:
    """All LRFs of a network, calibrated together with it.

    Attributes:
        refined: the joint optimum: cameras, scanners, tilt angles, which sightings were used.
        covariance: under the gauge of the world frame; of the scanners alone when the cameras were held.
        chi2_per_dof: of the whole joint problem.
        doubts: what a person should know.
    """

    refined: LrfRefined
    covariance: LrfCovariance
    chi2_per_dof: float
    doubts: tuple[Doubt, ...]


def calibrate_lrfs(
    network: NetworkData,
    spots: LrfSpots,
    settings: TiltSettings,
    *,
    rng: np.random.Generator,
    instrument: Instruments | None = None,
    rejection: float = 4.0,
    frame: JointFrame | None = None,
    held: CameraSpread | None = None,
) -> LrfCalibration:
    """Calibrate every LRF of a network.

    Args:
        network: metric cameras with their spots; held, or solved again together with the LRFs.
        spots: LRF sightings.
        settings: measured tilt angles with their covariance.
        rng: draws the triples of the start's RANSAC.
        instrument: what the scanners may be wrong by, one for all or one for each; nothing by default.
        rejection: sigma beyond which a sighting is an outlier.
        frame: names the world of cameras that are not held; by default the first camera stays where it is.
        held: what held cameras may be wrong by, which goes into the covariances; None takes them as exact.

    Raises:
        DegenerateError: too few sightings at a tilt, spots on a line, tilts that span less than 5 degrees, sightings
            most of which contradict the cameras; says where to wave or tilt next.
        ConvergenceError: no rigid motion agrees with the sightings of a tilt.
    """
    data = LrfData.of(spots, settings, network.views, instrument)
    registered, back = in_scale_of_ranges(network, data)
    scanners = tuple(_started(registered, data, scanner, rng) for scanner in range(settings.n_scanners))
    network, scanners = start_of_joint_solve(network, registered, scanners, back)
    refined = refine_jointly(
        network, scanners, spots, settings, instrument=data.instrument, rejection=rejection, frame=frame
    )
    _refuse_disagreement(refined, network, data)
    spread = lrf_covariance(refined)
    if held is not None:
        spread = with_camera_errors(spread, held, refined, network, data)
    spread = with_common_height(spread, refined, data)
    doubts = (
        *lrf_doubts(refined, network, data, held=held),
        *clock_doubts(spread, refined, network, data),
    )
    return LrfCalibration(refined, spread, refined.chi2 / max(refined.dof, 1), doubts)


def _started(network: NetworkData, data: LrfData, scanner: int, rng: np.random.Generator) -> TiltingScanner:
    """One scanner by registration at each tilt and the general axis through the poses."""
    settings = np.flatnonzero(data.settings.scanner == scanner)
    samples, local = plane_samples(network, data, settings)
    _refuse_few(data, settings, local)
    return calibrate_screw(samples, rng=rng).scanner


def plane_samples(network: NetworkData, data: LrfData, settings: IntArray) -> tuple[PlaneSamples, IntArray]:
    """The sightings at some settings, paired with where the cameras put their spots."""
    sigma_px = network.noise[network.views.camera] * network.views.sigma_px
    positions, spread = spots_from_cameras(network.cameras, network.views, network.points, network.is_inlier, sigma_px)
    is_usable = (data.point >= 0) & located(positions)[np.maximum(data.point, 0)]
    rows = np.flatnonzero(is_usable & np.isin(data.spots.setting, settings))
    local = np.searchsorted(settings, data.spots.setting[rows])
    shift, its_spread = expected_displacement(network, data)
    samples = PlaneSamples(
        spot_in_cam=positions[data.point[rows]] + shift[rows],
        range_m=data.spots.range_m[rows],
        bearing_rad=data.spots.bearing_rad[rows],
        setting=local,
        tilt_rad=data.settings.angle_rad[settings],
        noise=PointNoise(spread[data.point[rows]] + its_spread[rows], _scanner_noise(data, rows)),
    )
    return samples, local


def _scanner_noise(data: LrfData, rows: IntArray) -> FloatArray:
    """(n, 3, 3) covariance of scanner points: along the beam, across it in the plane, out of the plane."""
    bearing, reach = data.spots.bearing_rad[rows], data.spots.range_m[rows]
    cosine, sine, zero = np.cos(bearing), np.sin(bearing), np.zeros(len(rows))
    axes = np.stack(
        [
            np.stack([cosine, -sine, zero], axis=1),
            np.stack([sine, cosine, zero], axis=1),
            np.stack([zero, zero, np.ones(len(rows))], axis=1),
        ],
        axis=1,
    )
    spread = data.sigma[:, rows].copy()
    spread[1] *= reach
    return (axes * (spread.T**2)[:, None, :]) @ axes.transpose(0, 2, 1)


def _refuse_few(data: LrfData, settings: IntArray, local: IntArray) -> None:
    count = np.bincount(local, minlength=len(settings))
    poor = np.flatnonzero(count < MIN_SIGHTINGS)
    if len(poor):
        listed = ", ".join(
            f"{np.degrees(data.settings.angle_rad[settings[t]]):.1f}° ({count[t]})" for t in poor.tolist()
        )
        raise DegenerateError(
            f"too few spots in the scan plane at tilt {listed}; {MIN_SIGHTINGS} or more are needed at each",
            advice="Cross the scan plane there more often, with the spot in view of two cameras.",
        )


def _refuse_disagreement(refined: LrfRefined, network: NetworkData, data: LrfData) -> None:
    count, n_agreeing = sighting_counts(refined, network, data)
    poor = np.flatnonzero(n_agreeing < MIN_AGREEING_SHARE * count)
    if len(poor):
        scanner = int(poor[0])
        raise DegenerateError(
            f"only {n_agreeing[scanner]} of {count[scanner]} LRF sightings agree with the cameras and with each other",
            advice="Check that ranges and spots of one frame are of one instant, and the tilt angles.",
        )
