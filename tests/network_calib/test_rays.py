"""From pixels back: rays project to their pixels, points come back, covariances are what errors do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network_calib.camera_parameters import CameraParameters
from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.errors import InputError
from network_calib.rays import PixelLocator, Plane
from network_calib.synthetic_rooms import look_at

TERMS = {
    LensModel.NONE: (0, 0, 0, 0),
    LensModel.K1: (-0.15, 0, 0, 0),
    LensModel.K1_K2: (-0.26, 0.07, 0, 0),
    LensModel.K1_K2_P1_P2: (-0.26, 0.07, 0.002, -0.003),
    LensModel.FISHEYE: (-0.02, 0.004, -0.002, 0.0002),
}
FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
# Errors of a good calibration: 1 mrad, 5 mm, 1 px, 1e-3; the pixel is linear in them to 1e-3 of itself.
SIGMA = np.array([*[1e-3] * 3, *[5e-3] * 3, 1.0, 1e-3, 1.0, 1.0, *[1e-3] * 4])


def cameras_of(lenses, seed=0):
    """Cameras under the ceiling of a room, looking at the floor in its middle."""
    rng = np.random.default_rng(seed)
    n = len(lenses)
    centres = np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-3, 3, n), rng.uniform(2.2, 2.8, n)])
    targets = 0.5 * rng.standard_normal((n, 3))
    intrinsics = np.zeros((n, 8))
    intrinsics[:, :2] = rng.uniform(400, 500, (n, 1)) * [1.0, 1.01]
    intrinsics[:, 2:4] = [322.0, 236.0]
    intrinsics[:, 4:] = [TERMS[lens] for lens in lenses]
    poses = poses_from_centres(look_at(centres, targets), centres)
    return Cameras(tuple(f"C{i}" for i in range(n)), np.tile([640, 480], (n, 1)), tuple(lenses), intrinsics, poses)


def moved(cameras, steps):
    """The cameras moved by steps (C, 14) in the order of PARAMETER_NAMES."""
    columns = np.arange(steps.size).reshape(steps.shape)
    return CameraParameters.from_cameras(cameras, columns).retract(steps.ravel()).apply_to(cameras)


def a_covariance(n_cameras, seed=0):
    """Roots (C, 14, 14) and covariances of correlated errors."""
    rng = np.random.default_rng(seed)
    roots = SIGMA[:, None] * rng.standard_normal((n_cameras, 14, 14)) / np.sqrt(14)
    return roots, roots @ roots.transpose(0, 2, 1)


def views_of(cameras, points):
    """Every camera's pixels of points (N, 3): camera, point and px as `triangulated` takes them."""
    n_cameras, n = len(cameras), len(points)
    camera, point = np.repeat(np.arange(n_cameras), n), np.tile(np.arange(n), n_cameras)
    px, is_front = cameras.img_from_world(camera, points[point])
    in_cam = np.einsum("kij,kj->ki", cameras.rotations[camera], points[point] - cameras.centres_in_world[camera])
    # From 55 degrees off the axis on some of the lenses fold back.
    is_seen = is_front & cameras.is_in_image(camera, px) & (in_cam[:, 2] > 0.57 * np.linalg.norm(in_cam, axis=1))
    px[~is_seen] = np.nan
    return camera, point, px


def assert_ratio_is_unity(errors, predicted, allowed):
    """Sample covariances of errors (D, N, k) against predictions (N, k, k), whitened."""
    measured = np.einsum("dna,dnb->nab", errors, errors) / len(errors)
    white = np.linalg.inv(np.linalg.cholesky(predicted))
    ratio = white @ measured @ white.transpose(0, 2, 1)
    assert np.abs(ratio - np.eye(ratio.shape[1])).max() < allowed


# Laws


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000))
def test_what_lies_on_a_pixels_ray_projects_to_that_pixel(seed):
    rng = np.random.default_rng(seed)
    cameras = cameras_of([*LensModel], seed)
    camera = rng.integers(5, size=300)
    px = rng.uniform(-0.5, [639.5, 479.5], (300, 2))
    rays = PixelLocator(cameras).rays(camera, px)
    assert rays.is_valid.mean() > 0.9
    np.testing.assert_allclose(np.linalg.norm(rays.directions[rays.is_valid], axis=1), 1.0, rtol=1e-14)
    points = rays.origins + rng.uniform(0.1, 50, (300, 1)) * rays.directions
    again, is_front = cameras.img_from_world(camera[rays.is_valid], points[rays.is_valid])
    assert is_front.all()
    # A ray counts as found within 1e-9 of the focal length, 500 px.
    np.testing.assert_allclose(again, px[rays.is_valid], rtol=0, atol=1e-6)
    assert np.isnan(rays.directions[~rays.is_valid]).all()
    assert np.isnan(rays.origins[~rays.is_valid]).all()


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_points_come_back_from_their_pixels(seed):
    rng = np.random.default_rng(seed)
    cameras = cameras_of([*LensModel], seed)
    points = rng.uniform([-1, -1, 0.0], [1, 1, 1.8], (60, 3))
    camera, point, px = views_of(cameras, points)
    located = PixelLocator(cameras, a_covariance(5)[1]).triangulated(camera, point, px, 60, sigma_px=0.5)
    n_views = np.bincount(point, np.isfinite(px[:, 0]), minlength=60)
    np.testing.assert_array_equal(located.is_valid, n_views >= 2)
    # Rays are good to 1e-9 each; two that meet at a degree magnify it by 60, over some 5 m.
    np.testing.assert_allclose(located.points[located.is_valid], points[located.is_valid], rtol=0, atol=1e-6)


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_points_of_a_plane_come_back_from_one_pixel(seed):
    rng = np.random.default_rng(seed)
    cameras = cameras_of([*LensModel], seed)
    plane = Plane(np.array([0.1, -0.2, 2.0]), 0.3)
    points = rng.uniform(-1, 1, (100, 3))
    points += (plane.offset - points @ plane.normal)[:, None] * plane.normal
    camera = rng.integers(5, size=100)
    px, is_front = cameras.img_from_world(camera, points)
    is_seen = is_front & cameras.is_in_image(camera, px)
    located = PixelLocator(cameras).on_plane(camera, px, plane, sigma_px=0.5)
    np.testing.assert_array_equal(located.is_valid, is_seen)
    np.testing.assert_allclose(located.points[is_seen], points[is_seen], rtol=0, atol=1e-7)
    # In the plane and nowhere else: the covariance has no part along the normal, whose variances are of 1e-6 m^2.
    along = np.einsum("i,nij,j->n", plane.normal, located.covariance[is_seen], plane.normal)
    np.testing.assert_allclose(along, 0.0, atol=1e-15)


def test_the_order_of_cameras_and_views_changes_nothing():
    rng = np.random.default_rng(5)
    cameras, covariance = cameras_of([*LensModel], 5), a_covariance(5)[1]
    points = rng.uniform([-1, -1, 0.0], [1, 1, 1.8], (40, 3))
    camera, point, px = views_of(cameras, points)
    px += 0.5 * rng.standard_normal(px.shape)
    one = PixelLocator(cameras, covariance).triangulated(camera, point, px, 40, sigma_px=0.5)
    order = np.array([3, 0, 4, 1, 2])
    other_cameras = Cameras(
        tuple(cameras.names[i] for i in order),
        cameras.size_px[order],
        tuple(cameras.lenses[i] for i in order),
        cameras.intrinsics[order],
        cameras.cam_from_world[order],
    )
    shuffle = rng.permutation(len(px))
    other = PixelLocator(other_cameras, covariance[order]).triangulated(
        np.argsort(order)[camera[shuffle]], point[shuffle], px[shuffle], 40, sigma_px=0.5
    )
    np.testing.assert_array_equal(one.is_valid, other.is_valid)
    # Newton's last step is below 1e-6 of the distance to the optimum, here some millimetres.
    np.testing.assert_allclose(other.points, one.points, rtol=0, atol=1e-7)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-5, atol=1e-12)


# Covariance: of D draws, entries of a white sample covariance err by sqrt(2 / D); the largest of some hundred entries
# by four of them, and curvature adds 1 %. With 1500 draws that is 16 % of a variance, 8 % of a sigma.


def test_monte_carlo_of_points_on_the_floor():
    rng = np.random.default_rng(11)
    cameras = cameras_of([*LensModel], 2)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (20, 2)), np.zeros(20)])
    camera = np.tile(np.arange(5), 4)
    px, _ = cameras.img_from_world(camera, points)
    roots, covariance = a_covariance(5)
    locator = PixelLocator(cameras, covariance)
    predicted = locator.on_plane(camera, px, FLOOR, sigma_px=0.7)
    assert predicted.is_valid.all()
    n_draws = 1500
    errors = np.empty((n_draws, 20, 2))
    for k in range(n_draws):
        truth = moved(cameras, np.einsum("cij,cj->ci", roots, rng.standard_normal((5, 14))))
        seen, _ = truth.img_from_world(camera, points)
        found = locator.rays(camera, seen + 0.7 * rng.standard_normal(seen.shape))
        distance = -found.origins[:, 2] / found.directions[:, 2]
        errors[k] = (found.origins + distance[:, None] * found.directions - points)[:, :2]
    assert_ratio_is_unity(errors, predicted.covariance[:, :2, :2], 4 * np.sqrt(2 / n_draws) + 0.01)


def test_monte_carlo_of_triangulated_points():
    rng = np.random.default_rng(12)
    cameras = cameras_of([LensModel.K1_K2, LensModel.FISHEYE, LensModel.K1_K2_P1_P2], 7)
    points = rng.uniform([-0.6, -0.6, 0.2], [0.6, 0.6, 1.5], (10, 3))
    camera, point, px = views_of(cameras, points)
    roots, covariance = a_covariance(3)
    locator = PixelLocator(cameras, covariance)
    predicted = locator.triangulated(camera, point, px, 10, sigma_px=0.7)
    assert predicted.is_valid.all()
    n_draws, n_batch = 1500, 100
    errors = []
    for _ in range(n_draws // n_batch):
        draws = []
        for _ in range(n_batch):
            truth = moved(cameras, np.einsum("cij,cj->ci", roots, rng.standard_normal((3, 14))))
            seen = truth.img_from_world(camera, points[point])[0]
            seen[np.isnan(px[:, 0])] = np.nan
            draws.append(seen + 0.7 * rng.standard_normal(seen.shape))
        points_of_batch = (10 * np.arange(n_batch)[:, None] + point).ravel()
        found = locator.triangulated(
            np.tile(camera, n_batch), points_of_batch, np.concatenate(draws), 10 * n_batch, sigma_px=0.7
        )
        errors.append(found.points.reshape(n_batch, 10, 3) - points)
    assert_ratio_is_unity(np.concatenate(errors), predicted.covariance, 4 * np.sqrt(2 / n_draws) + 0.01)


def test_an_exact_calibration_leaves_the_noise_of_the_pixels():
    cameras = cameras_of([LensModel.NONE])
    px = np.array([[320.0, 240.0]])
    one = PixelLocator(cameras).on_plane(np.zeros(1, dtype=int), px, FLOOR, sigma_px=1.0)
    two = PixelLocator(cameras).on_plane(np.zeros(1, dtype=int), px, FLOOR, sigma_px=2.0)
    np.testing.assert_allclose(two.covariance, 4 * one.covariance, rtol=1e-12)


# What has no answer


def test_what_is_no_pixel_has_no_ray():
    cameras = cameras_of([LensModel.K1_K2])
    px = np.array(
        [[320, 240], [np.nan, 3], [np.inf, 3], [-0.6, 3], [639.6, 3], [3, 479.6], [-0.5, -0.5], [639.5, 479.5]]
    )
    rays = PixelLocator(cameras).rays(np.zeros(8, dtype=int), px)
    np.testing.assert_array_equal(rays.is_valid, [True, False, False, False, False, False, True, True])
    nothing = PixelLocator(cameras).rays(np.empty(0, dtype=int), np.empty((0, 2)))
    assert nothing.directions.shape == (0, 3)


@pytest.mark.parametrize(("lens", "focal_px"), [(LensModel.K1, 260.0), (LensModel.FISHEYE, 150.0)])
def test_a_pixel_that_the_lens_does_not_reach_has_no_ray(lens, focal_px):
    # K1 = -0.3 folds back at a distorted radius of 0.703, 183 px; an ideal fisheye of 150 px ends, at 90 degrees from
    # the axis, at 236 px. The corners of the image are at 400 px.
    row = np.array([[focal_px, focal_px, 319.5, 239.5, -0.3 if lens is LensModel.K1 else 0.0, 0, 0, 0]])
    cameras = Cameras(("C0",), np.array([[640, 480]]), (lens,), row, cameras_of([lens]).cam_from_world)
    px = np.array([[0.0, 0.0], [319.5, 239.5], [639.0, 239.5], [319.5 + 100, 239.5]])
    locator = PixelLocator(cameras)
    np.testing.assert_array_equal(locator.rays(np.zeros(4, dtype=int), px).is_valid, [False, True, False, True])
    for k in range(4):
        alone = locator.rays(np.zeros(1, dtype=int), px[k : k + 1])
        assert alone.is_valid[0] == (k in (1, 3))


def test_a_pixel_above_the_horizon_meets_no_floor():
    # A level camera 1 m above the floor: below the middle of the image lies the floor.
    poses = poses_from_centres(look_at(np.array([[0, 0, 1.0]]), np.array([[1.0, 0, 1.0]])), np.array([[0, 0, 1.0]]))
    row = np.array([[400.0, 400, 319.5, 239.5, 0, 0, 0, 0]])
    cameras = Cameras(("C0",), np.array([[640, 480]]), (LensModel.NONE,), row, poses)
    px = np.array([[319.5, 439.5], [319.5, 239.5], [319.5, 39.5], [np.nan, 1]])
    located = PixelLocator(cameras).on_plane(np.zeros(4, dtype=int), px, FLOOR, sigma_px=0.5)
    np.testing.assert_array_equal(located.is_valid, [True, False, False, False])
    # 200 px below the middle is half a metre down for each metre forward.
    np.testing.assert_allclose(located.points[0], [2.0, 0.0, 0.0], atol=1e-12)
    assert np.isnan(located.covariance[1:]).all()


def test_points_without_two_crossing_rays_are_not_located():
    cameras = cameras_of([LensModel.NONE] * 3, 4)
    points = np.array([[0.2, 0.1, 0.5], [0.1, 0.3, 0.4], [0.0, 0.0, 0.3]])
    camera, point, px = views_of(cameras, points)
    px[(point == 1) & (camera > 0)] = np.nan
    px[point == 2] = np.nan
    located = PixelLocator(cameras).triangulated(camera, point, px, 3, sigma_px=0.5)
    np.testing.assert_array_equal(located.is_valid, [True, False, False])
    # Twice the same view, and rays that part: their lines meet behind the cameras.
    twice = PixelLocator(cameras).triangulated(
        np.zeros(2, dtype=int), np.zeros(2, dtype=int), px[[0, 0]], 1, sigma_px=1
    )
    assert not twice.is_valid.any()
    centres = np.array([[0, 0, 1.0], [0.5, 0, 1.0]])
    apart = Cameras(
        ("A", "B"),
        cameras.size_px[:2],
        cameras.lenses[:2],
        cameras.intrinsics[:2],
        poses_from_centres(look_at(centres, centres + np.array([0, 5, 0])), centres),
    )
    parting = np.array([[200.0, 240], [440.0, 240]])
    behind = PixelLocator(apart).triangulated(np.arange(2), np.zeros(2, dtype=int), parting, 1, sigma_px=1)
    assert not behind.is_valid.any()
    nothing = PixelLocator(cameras).triangulated(camera[:0], point[:0], px[:0], 0, sigma_px=1)
    assert nothing.points.shape == (0, 3)


@pytest.mark.parametrize(("normal", "offset"), [([0, 0, 0], 1), ([0, 0, np.nan], 1), ([0, 1], 0), ([0, 0, 1], np.inf)])
def test_a_plane_needs_a_normal_and_an_offset(normal, offset):
    with pytest.raises(InputError, match="a plane needs"):
        Plane(np.array(normal, dtype=np.float64), offset)


def test_a_covariance_of_other_cameras_is_refused():
    with pytest.raises(InputError, match=r"\(2, 14, 14\)"):
        PixelLocator(cameras_of([LensModel.NONE]), np.zeros((2, 14, 14)))
