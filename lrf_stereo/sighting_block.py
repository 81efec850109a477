"""From the sightings of LRFs to their residual block: where the spot is when the beam hits it, and how surely."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.lrf_block import LrfBlock, by_point_in_lrf
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.spot_motion import SpotMotion, frame_times_s, motion_of
from network_calib.observations import FloatArray, IntArray
from network_calib.robust_loss import Loss
from network_calib.spots import spots_from_cameras


def spot_motion(network: NetworkData, data: LrfData, scanners: Sequence[TiltingScanner] = ()) -> SpotMotion:
    """Velocities of the M sightings' spots; still where every beam is of the cameras' instant for certain."""
    offset = np.array([scanner.clock_offset_s for scanner in scanners])
    if not (data.spots.delay_s.any() or data.sigma_clock_s.any() or offset.any()):
        return SpotMotion.still(len(data.spots))
    sigma_px = network.noise[network.views.camera] * network.views.sigma_px
    positions, spread = spots_from_cameras(network.cameras, network.views, network.points, network.is_inlier, sigma_px)
    times_s = frame_times_s(network.views, network.frame_period_s)
    motion = SpotMotion.still(len(data.spots))
    for scanner in range(data.settings.n_scanners):
        rows = np.flatnonzero(data.scanner == scanner)
        motion.put(rows, motion_of(positions, spread, times_s, data.point[rows]))
    return motion


def expected_displacement(network: NetworkData, data: LrfData) -> tuple[FloatArray, FloatArray]:
    """(M, 3) how far the spot moves from the exposure to the beam, and (M, 3, 3) how uncertain that is.

    As far as it is known before any solve: the stated delay, and a clock offset of zero with its prior sigma.
    """
    motion, delay_s, sigma_s = spot_motion(network, data), data.spots.delay_s, data.sigma_clock_s
    velocity = motion.velocity_m_s
    spread = motion.displacement_covariance_m2(np.hypot(delay_s, sigma_s))
    spread += (sigma_s**2)[:, None, None] * velocity[:, :, None] * velocity[:, None]
    return motion.displacement_m(delay_s), spread


def sighting_block(
    network: NetworkData,
    scanners: Sequence[TiltingScanner],
    data: LrfData,
    rows: IntArray,
    *,
    tilt_rad: FloatArray,
    point: IntArray,
    columns: IntArray,
    loss: Loss,
) -> LrfBlock:
    """The block of some sightings, with the spots' motion as it is known at this stage.

    Args:
        network: the camera side; its spots are where the motion and its part of the covariance are taken.
        scanners: S scanners as they stand.
        data: the LRF side.
        rows: (n,) sightings, each with a located spot.
        tilt_rad: (T,) angles of the settings as they stand.
        point: (n,) spot index in the problem.
        columns: (T, 16) global columns.
        loss: robust loss.
    """
    velocity, whitening = _moving(network, scanners, data, rows, tilt_rad)
    return LrfBlock(
        group=data.spots.setting[rows],
        point=point,
        measured=data.measured[:, rows],
        whitening=whitening,
        velocity=velocity,
        delay_s=data.spots.delay_s[rows],
        scanner_of_setting=data.settings.scanner,
        reference_rad=np.array([scanner.reference_tilt_rad for scanner in scanners]),
        columns=columns,
        loss=loss,
    )


def _moving(
    network: NetworkData, scanners: Sequence[TiltingScanner], data: LrfData, rows: IntArray, tilt_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(3, n) velocities in the LRF frame, and (3, 3, n) whitening of the sightings."""
    motion, sigma = spot_motion(network, data, scanners), data.sigma[:, rows]
    if motion.is_still:
        return np.zeros((3, len(rows))), np.eye(3)[:, :, None] / sigma
    late_s = data.spots.delay_s + np.array([one.clock_offset_s for one in scanners])[data.scanner]
    at_beam = network.points[data.point[rows]] + motion.displacement_m(late_s)[rows]
    poses = [scanners[s].world_from_lrf_at(tilt_rad[t]).inv() for t, s in enumerate(data.settings.scanner)]
    lrf_from_world = np.stack([pose.as_matrix() for pose in poses])[data.spots.setting[rows]]
    turn = lrf_from_world[:, :3, :3]
    x = np.einsum("nij,nj->ni", turn, at_beam) + lrf_from_world[:, :3, 3]
    range_scale = np.array([one.range_scale for one in scanners])[data.scanner[rows]]
    # (n, 3 residuals, 3 components)
    slope = by_point_in_lrf(x, range_scale).transpose(2, 1, 0) @ turn
    # Where the velocity is unknown, the clock's offset has nothing to work on: its sigma goes into the sighting's.
    span_s = np.where(motion.is_known, late_s, np.hypot(late_s, data.sigma_clock_s))
    total = slope @ motion.displacement_covariance_m2(span_s)[rows] @ slope.transpose(0, 2, 1)
    total[:, np.arange(3), np.arange(3)] += sigma.T**2
    whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(total)), dtype=np.float64)
    velocity = np.einsum("nij,nj->in", turn, motion.velocity_m_s[rows])
    return velocity, np.ascontiguousarray(whitening.transpose(1, 2, 0))
