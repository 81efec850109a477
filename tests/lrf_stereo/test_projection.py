"""Equation 14: pixels equal OpenCV's, validity is what a person would say, covariances are what errors do."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.camera_array import TILE_PIXELS
from lrf_stereo.noise import LrfNoise
from lrf_stereo.projection import CalibrationCovariance, LrfProjector, project_lrf
from lrf_stereo.scanner import ScanSteps, TiltingScanner
from lrf_stereo.scanner_part import SCANNER_TANGENT, ScannerPart
from network_calib.camera_parameters import N_PARAMETERS, CameraParameters
from network_calib.cameras import Cameras, LensModel, cam_from_img, poses_from_centres
from network_calib.errors import InputError
from network_calib.result import PARAMETER_NAMES
from network_calib.synthetic_rooms import look_at

N_SCANNER = len(SCANNER_TANGENT)
# Lenses with every term at work; none folds back inside its image.
TERMS = {
    LensModel.NONE: (0, 0, 0, 0),
    LensModel.K1: (-0.2, 0, 0, 0),
    LensModel.K1_K2: (-0.26, 0.07, 0, 0),
    LensModel.K1_K2_P1_P2: (-0.26, 0.07, 0.002, -0.003),
    LensModel.FISHEYE: (-0.02, 0.004, -0.002, 0.0002),
}


def a_scanner():
    """A scanner in a room, with every parameter away from its neutral value."""
    pose = RigidTransform.from_components([0.2, -0.1, 2.1], Rotation.from_rotvec([0.05, -0.1, 0.2]))
    scanner = TiltingScanner.from_paper(pose, 0.04, 0.06, mount_roll_rad=0.02, mount_yaw_rad=-0.015)
    return TiltingScanner(
        scanner.world_from_lrf,
        scanner.axis_direction_in_world,
        scanner.axis_point_in_world,
        reference_tilt_rad=0.1,
        tilt_gain=1.02,
        range_bias_m=0.012,
        range_scale=1.01,
        bearing_zero_rad=0.01,
    )


def cameras_of(lenses, seed=0):
    """Cameras around the volume in front of the scanner, looking into it."""
    rng = np.random.default_rng(seed)
    n = len(lenses)
    centres = np.column_stack([rng.uniform(-1, 5, n), rng.uniform(-2.5, 2.5, n), rng.uniform(1.5, 2.8, n)])
    targets = np.array([2.2, 0.0, 1.0]) + 0.3 * rng.standard_normal((n, 3))
    intrinsics = np.zeros((n, 8))
    intrinsics[:, :2] = rng.uniform(300, 500, (n, 1)) * [1.0, 1.01]
    intrinsics[:, 2:4] = [322.0, 236.0]
    intrinsics[:, 4:] = [TERMS[lens] for lens in lenses]
    poses = poses_from_centres(look_at(centres, targets), centres)
    return Cameras(tuple(f"C{i}" for i in range(n)), np.tile([640, 480], (n, 1)), tuple(lenses), intrinsics, poses)


def by_opencv(cameras, camera, points):
    pose, row = cameras.cam_from_world.as_matrix()[camera], cameras.intrinsics[camera]
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    matrix = np.array([[row[0], 0, row[2]], [0, row[1], row[3]], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if cameras.lenses[camera].is_fisheye else cv2.projectPoints
    return project(points.reshape(-1, 1, 3), turn, pose[:3, 3], matrix, row[4:])[0].reshape(-1, 2)


def a_scan(seed, n=200):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.8, 3.5, n), rng.uniform(-1.0, 1.0, n), rng.uniform(0.0, 0.9)


def retracted(scanner, step):
    """The scanner moved by a step in the order of SCANNER_TANGENT."""
    part = ScannerPart.from_scanners((scanner,), np.arange(N_SCANNER)[None])
    return part.retract(step).apply_to((scanner,))[0]


def moved(cameras, steps):
    """The cameras moved by steps (C, 14) in the order of PARAMETER_NAMES."""
    columns = np.arange(steps.size).reshape(steps.shape)
    return CameraParameters.from_cameras(cameras, columns).retract(steps.ravel()).apply_to(cameras)


def covariance_of(projection):
    """The covariance of a projection that has one."""
    assert projection.covariance_px2 is not None
    return projection.covariance_px2


# Pixels


@given(seed=st.integers(0, 10_000))
def test_pixels_are_opencvs_in_cameras_of_every_kind(seed):
    scanner, cameras = a_scanner(), cameras_of([*LensModel, *LensModel], seed)
    range_m, bearing, tilt = a_scan(seed)
    projection = project_lrf(scanner, cameras, range_m, bearing, tilt)
    points = scanner.points_in_world(range_m, bearing, tilt)
    for i in range(len(cameras)):
        valid = projection.is_valid[i]
        # Both sum some 20 products of at most 1000 px, each to 1e-16 of itself.
        np.testing.assert_allclose(projection.px[i][valid], by_opencv(cameras, i, points)[valid], rtol=0, atol=1e-9)
    assert projection.is_valid.any()


@pytest.mark.parametrize(
    "shapes", [((), (), ()), ((5,), (5,), ()), ((3, 4), (3, 4), (3, 1)), ((2, 3), (3,), (2, 3)), ((0,), (0,), ())]
)
def test_measurements_of_any_shape_give_what_one_at_a_time_gives(shapes):
    rng = np.random.default_rng(4)
    scanner, cameras = a_scanner(), cameras_of([LensModel.K1_K2, LensModel.FISHEYE, LensModel.NONE])
    range_m, bearing, tilt = rng.uniform(1, 3, shapes[0]), rng.uniform(-1, 1, shapes[1]), rng.uniform(0, 0.8, shapes[2])
    covariance = CalibrationCovariance(scanner=1e-6 * np.eye(N_SCANNER))
    projection = project_lrf(scanner, cameras, range_m, bearing, tilt, noise=LrfNoise(), covariance=covariance)
    shape = np.broadcast_shapes(*shapes)
    assert projection.px.shape == (3, *shape, 2)
    assert projection.is_valid.shape == projection.depth_m.shape == (3, *shape)
    assert covariance_of(projection).shape == (3, *shape, 2, 2)
    all_range, all_bearing, all_tilt = np.broadcast_arrays(range_m, bearing, tilt)
    for index in np.ndindex(shape):
        one = project_lrf(
            scanner,
            cameras,
            all_range[index],
            all_bearing[index],
            all_tilt[index],
            noise=LrfNoise(),
            covariance=covariance,
        )
        at = (slice(None), *index)
        # Other orders of summation: a few units in the last place of some 1000 px, some 10 m, some 100 px^2.
        np.testing.assert_allclose(projection.px[at], one.px, rtol=0, atol=1e-9)
        np.testing.assert_allclose(projection.depth_m[at], one.depth_m, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(projection.is_valid[at], one.is_valid)
        np.testing.assert_allclose(covariance_of(projection)[at], covariance_of(one), rtol=1e-9, atol=1e-12)


def test_scans_larger_than_a_tile_and_cameras_of_mixed_kinds_are_the_camera_models_own():
    scanner = a_scanner()
    cameras = cameras_of([LensModel.K1_K2, LensModel.FISHEYE, LensModel.K1_K2, LensModel.FISHEYE, LensModel.NONE])
    range_m, bearing, _ = a_scan(8, 2 * TILE_PIXELS + 77)
    tilt = np.random.default_rng(9).uniform(0, 0.9, len(range_m))
    projection = project_lrf(scanner, cameras, range_m, bearing, tilt)
    points = scanner.points_in_world(range_m, bearing, tilt)
    for i in range(len(cameras)):
        px, is_front = cameras.img_from_world(np.full(len(points), i), points)
        # Of so many points some lie at a depth of 1e-5 m, known to 1e-15 m, and the fifth power of x/z grows with that.
        np.testing.assert_allclose(projection.px[i], px, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(np.isfinite(projection.px[i]).all(axis=1), is_front)
        in_cam = cameras.cam_from_world[i].apply(points)
        np.testing.assert_allclose(projection.depth_m[i], in_cam[:, 2], rtol=0, atol=1e-12)


def test_the_projector_gives_the_same_scan_after_scan():
    scanner, cameras = a_scanner(), cameras_of([*LensModel])
    covariance = CalibrationCovariance(np.tile(1e-6 * np.eye(N_PARAMETERS), (5, 1, 1)))
    projector = LrfProjector(scanner, cameras, covariance=covariance)
    first = projector.project(*a_scan(1), noise=LrfNoise())
    kept = covariance_of(first).copy()
    projector.project(*a_scan(2, 300), noise=LrfNoise())
    # What is kept while the tilt stays must not outlive a change of the noise.
    other = projector.project(*a_scan(1), noise=LrfNoise(tilt_rad=0.01))
    whole = project_lrf(scanner, cameras, *a_scan(1), noise=LrfNoise(tilt_rad=0.01), covariance=covariance)
    np.testing.assert_array_equal(other.covariance_px2, whole.covariance_px2)
    again = projector.project(*a_scan(1), noise=LrfNoise())
    np.testing.assert_array_equal(covariance_of(first), kept)
    np.testing.assert_array_equal(covariance_of(again), kept)
    np.testing.assert_array_equal(again.px, first.px)


# Validity


@pytest.mark.parametrize("lens", LensModel)
def test_valid_means_that_the_pixel_shows_the_point(lens):
    scanner, cameras = a_scanner(), cameras_of([lens] * 6, seed=3)
    range_m, bearing, tilt = a_scan(5, 1500)
    projection = project_lrf(scanner, cameras, range_m, 3 * bearing, tilt)
    points = scanner.points_in_world(range_m, 3 * bearing, tilt)
    for i in range(6):
        in_cam = cameras.cam_from_world[i].apply(points)
        px, is_front = cameras.img_from_world(np.full(len(points), i), points)
        ray_xy, has_ray = cam_from_img(cameras.intrinsics[i], cameras.is_fisheye[i], px)
        with np.errstate(invalid="ignore"):
            true_xy = in_cam[:, :2] / in_cam[:, 2:]
            is_same = has_ray & (np.abs(ray_xy - true_xy).max(axis=1) < 1e-6 * (1 + np.abs(true_xy).max(axis=1)))
            expected = is_front & is_same & cameras.is_in_image(np.full(len(px), i), px)
        np.testing.assert_array_equal(projection.is_valid[i], expected)
        assert 0 < expected.sum() < len(expected)


@pytest.mark.parametrize(
    ("lens", "terms", "tangent"),
    [
        # r (1 - 0.3 r^2) turns at r = 1.054; at r = 1.4 it is back at 0.577, 173 px from the centre.
        (LensModel.K1, (-0.3, 0, 0, 0), 1.4),
        # theta (1 - 0.25 theta^2) turns at theta = 1.155 (66 deg); at 75 deg it is back at 0.748, 224 px.
        (LensModel.FISHEYE, (-0.25, 0, 0, 0), np.tan(np.radians(75))),
        # 1 + 3 k1 s + 5 k2 s^2 dips below zero only between s = 0.69 and s = 0.97: r = 0.9 lies in the dip, and
        # r = 1.1 beyond it, where the image grows again and shows a second picture of the rim.
        (LensModel.K1_K2, (-0.82, 0.3, 0, 0), 0.9),
        (LensModel.K1_K2, (-0.82, 0.3, 0, 0), 1.1),
    ],
)
def test_points_beyond_the_fold_of_a_lens_are_inside_the_image_and_not_valid(lens, terms, tangent):
    scanner = TiltingScanner.from_paper(RigidTransform.identity(), 0.0, 0.0)
    row = np.array([[300.0, 300.0, 319.5, 239.5, *terms]])
    # The camera stands in the scanner's origin and looks along its x; a bearing is the angle off the axis.
    pose = poses_from_centres(look_at(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]])), np.zeros((1, 3)))
    cameras = Cameras(("C0",), np.array([[640, 480]]), (lens,), row, pose)
    projection = project_lrf(scanner, cameras, 2.0, [0.1, np.arctan(tangent)], 0.0)
    assert cameras.is_in_image(np.zeros(2, dtype=int), projection.px[0]).all()
    np.testing.assert_array_equal(projection.is_valid[0], [True, False])


def test_what_is_behind_the_camera_or_has_no_range_is_not_a_number():
    scanner = TiltingScanner.from_paper(RigidTransform.identity(), 0.0, 0.0)
    pose = poses_from_centres(look_at(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]])), np.zeros((1, 3)))
    row = np.array([[300.0, 300.0, 319.5, 239.5, 0, 0, 0, 0]])
    cameras = Cameras(("C0",), np.array([[640, 480]]), (LensModel.NONE,), row, pose)
    projection = project_lrf(scanner, cameras, [2.0, 2.0, np.nan], [0.1, 3.0, 0.1], 0.0, noise=LrfNoise())
    np.testing.assert_array_equal(projection.is_valid[0], [True, False, False])
    assert np.isfinite(projection.px[0, 0]).all()
    assert np.isnan(projection.px[0, 1:]).all()
    assert projection.depth_m[0, 1] == pytest.approx(2 * np.cos(3.0), abs=1e-12)
    assert np.isnan(covariance_of(projection)[0, 1:]).all()


# Covariance


def slopes_by_differences(scanner, cameras, scan, step):
    """(C, N, 2) central difference of the pixels by a step of (scanner (15,), cameras (14,), scan (3,))."""

    def px(sign):
        of_scanner, of_camera, of_scan = (sign * part for part in step)
        measured = [a + d for a, d in zip(scan, of_scan, strict=True)]
        shifted = moved(cameras, np.tile(of_camera, (len(cameras), 1)))
        return project_lrf(retracted(scanner, of_scanner), shifted, *measured).px

    return (px(1.0) - px(-1.0)) / 2


def assert_is_outer_product(covariance, slope, is_valid):
    outer = slope[..., :, None] * slope[..., None, :]
    scale = np.linalg.norm(slope[is_valid], axis=-1)[:, None, None] ** 2
    # Central differences with steps of 1e-5 of the depth: truncation below 1e-9 of the slope; roundoff 1e-13 * 1000 px
    # over 1e-5. Slopes below 1 px per unit step are compared absolutely.
    assert (np.abs(covariance - outer)[is_valid] < 1e-5 * scale + 1e-5).all()


@pytest.mark.parametrize("parameter", range(N_SCANNER), ids=SCANNER_TANGENT)
def test_covariance_of_one_scanner_parameter_is_the_square_of_its_derivative(parameter):
    scanner, cameras, scan = a_scanner(), cameras_of([*LensModel]), a_scan(7)
    unit = np.zeros((N_SCANNER, N_SCANNER))
    unit[parameter, parameter] = 1.0
    projection = project_lrf(scanner, cameras, *scan, covariance=CalibrationCovariance(scanner=unit))
    h = 1e-5
    slope = (
        slopes_by_differences(scanner, cameras, scan, (h * np.eye(N_SCANNER)[parameter], np.zeros(14), np.zeros(3))) / h
    )
    # Points of equation 14 stand still: no clock moves them.
    assert (np.abs(slope[projection.is_valid]).max() > 1) == (SCANNER_TANGENT[parameter] != "clock_offset_s")
    assert_is_outer_product(covariance_of(projection), slope, projection.is_valid)


@pytest.mark.parametrize("parameter", range(N_PARAMETERS), ids=PARAMETER_NAMES)
def test_covariance_of_one_camera_parameter_is_the_square_of_its_derivative(parameter):
    scanner, cameras, scan = a_scanner(), cameras_of([*LensModel]), a_scan(7)
    unit = np.zeros((5, N_PARAMETERS, N_PARAMETERS))
    unit[:, parameter, parameter] = 1.0
    projection = project_lrf(scanner, cameras, *scan, covariance=CalibrationCovariance(cameras=unit))
    h = 1e-5 if PARAMETER_NAMES[parameter][-3:] != "_px" else 1e-2
    step = np.zeros(N_SCANNER), h * np.eye(14)[parameter], np.zeros(3)
    slope = slopes_by_differences(scanner, cameras, scan, step) / h
    assert np.abs(slope[projection.is_valid]).max() > 0.1
    assert_is_outer_product(covariance_of(projection), slope, projection.is_valid)


@pytest.mark.parametrize("measured", ["range", "bearing", "tilt"])
def test_covariance_of_one_measurement_is_the_square_of_its_derivative(measured):
    scanner, cameras, scan = a_scanner(), cameras_of([*LensModel]), a_scan(7)
    on = {name: float(name == measured) for name in ("range", "bearing", "tilt")}
    noise = LrfNoise(on["range"], 0.0, on["bearing"], on["tilt"])
    projection = project_lrf(scanner, cameras, *scan, noise=noise)
    step = 1e-5 * np.eye(3)[["range", "bearing", "tilt"].index(measured)]
    slope = slopes_by_differences(scanner, cameras, scan, (np.zeros(N_SCANNER), np.zeros(14), step)) / 1e-5
    assert np.abs(slope[projection.is_valid]).max() > 1
    assert_is_outer_product(covariance_of(projection), slope, projection.is_valid)


def test_range_noise_grows_with_the_measured_range():
    scanner, cameras, scan = a_scanner(), cameras_of([LensModel.NONE]), a_scan(7)
    unit = covariance_of(project_lrf(scanner, cameras, *scan, noise=LrfNoise(1.0, 0.0, 0.0)))
    real = covariance_of(project_lrf(scanner, cameras, *scan, noise=LrfNoise(2.25e-3, 0.73e-3, 0.0)))
    variance = (2.25e-3 + 0.73e-3 * scan[0]) ** 2
    np.testing.assert_allclose(real, unit * variance[:, None, None], rtol=1e-9)


def test_monte_carlo_of_a_calibration_whose_cameras_and_scanner_err_together():
    rng = np.random.default_rng(11)
    scanner, cameras = a_scanner(), cameras_of([LensModel.K1_K2, LensModel.FISHEYE], seed=2)
    scan = a_scan(12, 30)
    # Errors of 1 mrad, 1 mm, 0.5 px, 1e-3: the pixel is linear in them to some 1e-3 of itself.
    of_camera = np.array([*[1e-3] * 6, 0.5, 1e-3, 0.5, 0.5, *[1e-3] * 4])
    of_scanner = np.full(N_SCANNER, 1e-3)
    # Four causes move all 43 parameters, so that cameras and scanner err together strongly.
    sigma = np.concatenate([of_camera, of_camera, of_scanner])
    root = sigma[:, None] * rng.standard_normal((43, 4)) / 2
    joint = root @ root.T
    covariance = CalibrationCovariance(
        np.stack([joint[:14, :14], joint[14:28, 14:28]]),
        joint[28:, 28:],
        np.stack([joint[:14, 28:], joint[14:28, 28:]]),
    )
    noise = LrfNoise(tilt_rad=1e-3)
    predicted = project_lrf(scanner, cameras, *scan, noise=noise, covariance=covariance)
    n_draws = 3000
    draws = []
    for _ in range(n_draws):
        step = root @ rng.standard_normal(4)
        measured = (
            scan[0] + noise.range_m(scan[0]) * rng.standard_normal(30),
            scan[1] + noise.bearing_rad * rng.standard_normal(30),
            scan[2] + noise.tilt_rad * rng.standard_normal(),
        )
        draws.append(project_lrf(retracted(scanner, step[28:]), moved(cameras, step[:28].reshape(2, 14)), *measured).px)
    errors = np.stack(draws)[:, predicted.is_valid] - predicted.px[predicted.is_valid]
    measured = np.einsum("dka,dkb->kab", errors, errors) / n_draws
    expected = covariance_of(predicted)[predicted.is_valid]
    whitened = np.linalg.inv(np.linalg.cholesky(expected))
    ratio = whitened @ measured @ whitened.transpose(0, 2, 1)
    # Entries of a sample covariance of white draws err by sqrt(2 / 3000) = 0.026 at most; five of them, and 1 % of
    # curvature.
    assert np.abs(ratio - np.eye(2)).max() < 0.14
    # Negative control: without the cross part the same prediction is wrong by more.
    alone = project_lrf(
        scanner, cameras, *scan, noise=noise, covariance=CalibrationCovariance(covariance.cameras, covariance.scanner)
    )
    other = whitened @ covariance_of(alone)[predicted.is_valid] @ whitened.transpose(0, 2, 1)
    assert np.abs(other - np.eye(2)).max() > 0.3


def test_covariance_is_the_same_for_one_tilt_and_for_many_equal_ones():
    scanner, cameras, (range_m, bearing, tilt) = a_scanner(), cameras_of([*LensModel]), a_scan(3)
    rng = np.random.default_rng(1)
    root, of_scanner = 1e-3 * rng.standard_normal((5, 14, 15)), 1e-3 * rng.standard_normal((N_SCANNER, 15))
    covariance = CalibrationCovariance(root @ root.transpose(0, 2, 1), of_scanner @ of_scanner.T, root @ of_scanner.T)
    once = project_lrf(scanner, cameras, range_m, bearing, tilt, noise=LrfNoise(), covariance=covariance)
    many = project_lrf(
        scanner, cameras, range_m, bearing, np.full(len(range_m), tilt), noise=LrfNoise(), covariance=covariance
    )
    # Sums in another order, of numbers up to 100 px^2.
    np.testing.assert_allclose(covariance_of(many), covariance_of(once), rtol=1e-9, atol=1e-10)


def test_no_covariance_where_nothing_is_uncertain_was_said():
    scanner, cameras = a_scanner(), cameras_of([LensModel.NONE])
    assert project_lrf(scanner, cameras, *a_scan(1)).covariance_px2 is None
    exact = project_lrf(scanner, cameras, *a_scan(1), covariance=CalibrationCovariance())
    assert (covariance_of(exact)[exact.is_valid] == 0).all()


@pytest.mark.parametrize(
    ("covariance", "reason"),
    [
        (CalibrationCovariance(cameras=np.zeros((2, 14, 14))), "cameras"),
        (CalibrationCovariance(scanner=np.zeros((10, 10))), "scanner"),
        (CalibrationCovariance(scanner=np.zeros((15, 15)), camera_scanner=np.zeros((1, 14, 15))), "needs"),
    ],
)
def test_covariances_that_do_not_fit_are_refused(covariance, reason):
    with pytest.raises(InputError, match=reason):
        project_lrf(a_scanner(), cameras_of([LensModel.NONE]), *a_scan(1), covariance=covariance)


def test_a_whole_scan_by_hand():
    # Scanner and camera in one place, dx = dz = 0, the camera level and looking along the scanner's forward axis.
    scanner = TiltingScanner.from_paper(RigidTransform.identity(), 0.0, 0.0)
    pose = poses_from_centres(look_at(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]])), np.zeros((1, 3)))
    row = np.array([[300.0, 300.0, 319.5, 239.5, 0, 0, 0, 0]])
    cameras = Cameras(("C0",), np.array([[640, 480]]), (LensModel.NONE,), row, pose)
    bearings = ScanSteps().bearings_rad
    projection = project_lrf(scanner, cameras, 2.0, bearings, 0.2)
    # Equation 3 in camera axes (right, down, forward): a beam points along (-sin b, cos b sin a, cos b cos a).
    expected = np.stack(
        [319.5 - 300 * np.tan(bearings) / np.cos(0.2), np.full(len(bearings), 239.5 + 300 * np.tan(0.2))], axis=1
    )
    valid = projection.is_valid[0]
    assert valid.sum() > 200
    np.testing.assert_allclose(projection.px[0][valid], expected[valid], rtol=0, atol=1e-9)
