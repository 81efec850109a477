"""The paper's set-up as a named scene: a stereo head of 320 x 240 pixels under a tilting scanner, spots in its plane.

The head (f = 260 px, baseline 90 mm) looks 30 degrees down, so that the tilts 12.1, 23.2 and 50 degrees lie in its
image; the scanner's axis stands 150 mm above the left camera; its mirror is 40 mm ahead of the axis and 60 mm above.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.paper import PlaneSamples
from lrf_stereo.rigid import PointNoise
from lrf_stereo.scanner import ScanSteps, TiltingScanner

FOCAL_PX, WIDTH_PX, HEIGHT_PX, BASELINE_M = 260.0, 320, 240, 0.09
TILTS = np.deg2rad([12.1, 23.2, 50.0])
CHECKED_TILTS = np.deg2rad([2.0, 12.1, 23.2, 35.0, 50.0])
STEPS = ScanSteps()


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations: of a pixel coordinate, of the range, of the height above the scan plane."""

    pixel: float = 0.3
    range_m: float = 3e-3
    height_m: float = 4e-3


def scanner(dx_m=0.04, dz_m=0.06, *, mount_roll_rad=0.0, mount_yaw_rad=0.0):
    """The true scanner in the left camera's frame."""
    # LRF axes x forward, y left, z up as columns in a level camera: z, -x, -y; then the camera looks down.
    level = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    pitch = Rotation.from_rotvec([np.deg2rad(30), 0.0, 0.0])
    axis = RigidTransform.from_components(pitch.apply([0.03, -0.15, 0.02]), pitch * Rotation.from_matrix(level))
    return TiltingScanner.from_paper(axis, dx_m, dz_m, mount_roll_rad=mount_roll_rad, mount_yaw_rad=mount_yaw_rad)


def project(points_in_cam):
    """(..., 2) pixels of the left camera."""
    centre = np.array([(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2])
    return FOCAL_PX * points_in_cam[..., :2] / points_in_cam[..., 2:] + centre


def spots_in_plane(truth, tilt_rad, n, rng, *, height_m=0.0):
    """Ranges, bearings and positions in the camera of n spots seen by both cameras, 1 to 3.5 m away.

    Spots lie off the plane by Gaussian heights; range and bearing are those of their feet.
    """
    reach, bearing = rng.uniform(1.0, 3.5, 60 * n), rng.uniform(-0.5, 0.5, 60 * n)
    flat = np.column_stack([reach * np.cos(bearing), reach * np.sin(bearing), height_m * rng.standard_normal(60 * n)])
    points = truth.world_from_lrf_at(tilt_rad).apply(flat)
    size = np.array([WIDTH_PX, HEIGHT_PX])
    seen = [project(points - [shift, 0, 0]) for shift in (0.0, BASELINE_M)]
    is_seen = np.all([((px > -0.5) & (px < size - 0.5)).all(axis=1) for px in seen], axis=0)
    rows = np.flatnonzero(is_seen)[:n]
    return reach[rows], bearing[rows], points[rows]


def stereo(points_in_cam, pixel_sigma, rng):
    """Positions (N, 3) that a rectified pair triangulates from noisy pixels, and their covariances at that place."""
    left = FOCAL_PX * points_in_cam[:, :2] / points_in_cam[:, 2:]
    disparity = FOCAL_PX * BASELINE_M / points_in_cam[:, 2]
    right = left - np.column_stack([disparity, np.zeros(len(left))])
    left, right = (px + pixel_sigma * rng.standard_normal(px.shape) for px in (left, right))
    d = left[:, 0] - right[:, 0]
    measured = np.column_stack([left[:, 0], (left[:, 1] + right[:, 1]) / 2, np.full(len(d), FOCAL_PX)])
    measured *= (BASELINE_M / d)[:, None]
    # x = b u / d, y = b (v + v') / 2 d, z = b f / d by u, v, u', v', with d = u - u'.
    by_d = -measured / d[:, None]
    zero, unit = np.zeros(len(d)), BASELINE_M / d
    jacobian = np.stack(
        [
            by_d + np.column_stack([unit, zero, zero]),
            np.column_stack([zero, unit / 2, zero]),
            -by_d,
            np.column_stack([zero, unit / 2, zero]),
        ],
        axis=2,
    )
    return measured, pixel_sigma**2 * jacobian @ np.swapaxes(jacobian, 1, 2)


def plane_samples(truth, n, rng, *, tilts=TILTS, noise=None, wrong=0.0):
    """n samples at each tilt; exact without noise. A share of them may pair a spot with another range and bearing."""
    sigma = noise or Noise(0.0, 0.0, 0.0)
    columns = [spots_in_plane(truth, tilt, n, rng, height_m=sigma.height_m) for tilt in tilts]
    reach, bearing, points = (np.concatenate(column) for column in zip(*columns, strict=True))
    setting = np.repeat(np.arange(len(tilts)), n)
    if noise is None:
        return PlaneSamples(points, reach, bearing, setting, tilts)
    is_wrong = np.zeros(len(reach), dtype=bool)
    for k in range(len(tilts)):
        is_wrong[rng.choice(np.flatnonzero(setting == k), round(wrong * n), replace=False)] = True
    spots, target_m2 = stereo(points, sigma.pixel, rng)
    measured_range = np.round(reach + sigma.range_m * rng.standard_normal(len(reach)), 3)
    measured_bearing = STEPS.bearing_rad(np.round(STEPS.step(bearing)))
    measured_range[is_wrong] = rng.uniform(1.0, 3.5, is_wrong.sum())
    measured_bearing[is_wrong] = rng.uniform(-0.5, 0.5, is_wrong.sum())
    point_noise = PointNoise(target_m2, scanner_covariances(measured_range, measured_bearing, sigma))
    return PlaneSamples(spots, measured_range, measured_bearing, setting, tilts, point_noise)


def scanner_covariances(range_m, bearing_rad, sigma):
    """(N, 3, 3) in the LRF: range along the beam, a uniform step across it, height."""
    c, s = np.cos(bearing_rad), np.sin(bearing_rad)
    zero, one = np.zeros_like(c), np.ones_like(c)
    axes = np.stack([np.stack([c, s, zero], -1), np.stack([-s, c, zero], -1), np.stack([zero, zero, one], -1)], -1)
    spread = np.stack([sigma.range_m * one, range_m * STEPS.step_rad / np.sqrt(12), sigma.height_m * one], axis=-1)
    scaled = axes * spread[:, None, :]
    return scaled @ np.swapaxes(scaled, 1, 2)


def errors_at(estimate, truth, tilt_rad, rng, *, n=200):
    """Median pixel error and median 3D error (m) of the estimate over exact readings at one tilt."""
    reach, bearing, _ = spots_in_plane(truth, tilt_rad, n, rng)
    if len(reach) < n // 2:  # the plane leaves the image at 2 degrees: any of its points are as good
        reach, bearing = rng.uniform(1.0, 3.5, n), rng.uniform(-0.4, 0.4, n)
    expected, found = (s.points_in_world(reach, bearing, tilt_rad) for s in (truth, estimate))
    pixels = np.linalg.norm(project(found) - project(expected), axis=1)
    return float(np.median(pixels)), float(np.median(np.linalg.norm(found - expected, axis=1)))
