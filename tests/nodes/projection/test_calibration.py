"""A calibration that answers: pixels as OpenCV and COLMAP have them, honest sigmas, and every question backwards."""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lrf_stereo.noise import LrfNoise
from lrf_stereo.scanner import ScanSteps
from network_calib.cameras import LensModel
from network_calib.errors import InputError
from network_calib.formats.calibration_json import save
from nodes import projection
from nodes.projection import Calibration, CovarianceOf, ErrorCode, ProjectionError
from tests.nodes.projection.known_calibration import (
    LRF,
    a_scanner,
    cameras_of,
    moved_cameras,
    moved_scanner,
    result_of,
)

# The types ask for arrays; lists and what is refused are given too.
Beams: Any = projection.Beams
LrfPoints: Any = projection.LrfPoints
WorldPoints: Any = projection.WorldPoints
TILT_RAD = 0.5
# 1 mrad, 2 mm, 0.5 px, 1e-3: the pixel is linear in such errors to 1e-3 of itself.
CAMERA_SIGMA = np.array([*[1e-3] * 3, *[2e-3] * 3, 0.5, 1e-3, 0.5, 0.5, *[1e-3] * 4])
LRF_SIGMA = np.array([*[1e-3] * 3, *[2e-3] * 3, *[1e-3] * 9])


def a_calibration(lenses=(*LensModel,), seed=0, **covariances):
    return Calibration.of(result_of(cameras_of(lenses, seed), a_scanner(), **covariances), "c1")


def a_scan(n=300, seed=1, tilt_rad: Any = TILT_RAD):
    rng = np.random.default_rng(seed)
    return Beams(LRF, rng.uniform(1.0, 4.0, n), rng.uniform(-1.0, 1.0, n), tilt_rad)


def ends_of(beams):
    return a_scanner().points_in_world(beams.range_m, beams.bearing_rad, beams.tilt_rad)


def covariance_of(projected) -> Any:
    """The covariance of an answer that has one."""
    assert projected.covariance_px2 is not None
    return projected.covariance_px2


def sigma_of(projected) -> Any:
    """The sigma of an answer that has one."""
    assert projected.sigma_px is not None
    return projected.sigma_px


def by_opencv(cameras, camera, points):
    pose, row = cameras.cam_from_world.as_matrix()[camera], cameras.intrinsics[camera]
    matrix = np.array([[row[0], 0, row[2]], [0, row[1], row[3]], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if cameras.lenses[camera].is_fisheye else cv2.projectPoints
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    return project(points.reshape(-1, 1, 3), turn, pose[:3, 3], matrix, row[4:])[0].reshape(-1, 2)


def by_colmap(cameras, camera, points):
    model = "OPENCV_FISHEYE" if cameras.lenses[camera].is_fisheye else "OPENCV"
    row = cameras.intrinsics[camera].copy()
    row[2:4] += 0.5  # COLMAP counts from the corner of the first pixel, we from its middle
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=row)
    return np.asarray(theirs.img_from_cam(cameras.cam_from_world[camera].apply(points))) - 0.5


# Pixels


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_pixels_are_those_of_opencv_and_of_colmap(seed):
    cameras, calibration, beams = cameras_of([*LensModel], seed), a_calibration(seed=seed), a_scan(seed=seed)
    projected, points = calibration.project(beams), ends_of(beams)
    assert (projected.calibration_id, projected.cameras, projected.tilt_rad) == ("c1", cameras.names, TILT_RAD)
    assert projected.covariance_px2 is None
    assert projected.sigma_px is None
    assert projected.is_valid.any()
    for i in range(len(cameras)):
        valid = projected.is_valid[i]
        # Some 20 products of at most 1000 px, each to 1e-16 of itself.
        np.testing.assert_allclose(projected.px[i][valid], by_opencv(cameras, i, points)[valid], rtol=0, atol=1e-9)
        if valid.any():
            np.testing.assert_allclose(projected.px[i][valid], by_colmap(cameras, i, points[valid]), rtol=0, atol=1e-9)
        depth = cameras.cam_from_world[i].apply(points)[:, 2]
        np.testing.assert_allclose(projected.depth_m[i], depth, rtol=0, atol=1e-12)


def test_beams_their_points_and_their_ends_in_the_world_are_one():
    calibration, beams = a_calibration(), a_scan()
    flat = np.column_stack([beams.range_m * np.cos(beams.bearing_rad), beams.range_m * np.sin(beams.bearing_rad)])
    one = calibration.project(beams)
    for other in (LrfPoints(LRF, np.column_stack([flat, np.zeros(300)]), TILT_RAD), WorldPoints(ends_of(beams))):
        projected = calibration.project(other)
        np.testing.assert_allclose(projected.px, one.px, rtol=1e-12, atol=1e-9)
        np.testing.assert_array_equal(projected.is_valid, one.is_valid)
    assert projected.tilt_rad is None


def test_each_beam_may_have_a_tilt_of_its_own():
    calibration, beams = a_calibration(), a_scan(n=20, tilt_rad=np.linspace(0.2, 0.6, 20))
    together = calibration.project(beams, covariance=CovarianceOf())
    for k in range(20):
        alone = calibration.project(
            Beams(LRF, beams.range_m[k : k + 1], beams.bearing_rad[k : k + 1], beams.tilt_rad[k]),
            covariance=CovarianceOf(),
        )
        np.testing.assert_allclose(together.px[:, k], alone.px[:, 0], rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(sigma_of(together)[:, k], sigma_of(alone)[:, 0], rtol=1e-9)


@pytest.mark.parametrize("names", [("C3",), ("C4", "C0"), ("C2", "C4", "C1", "C0", "C3"), ()])
def test_some_cameras_in_any_order_are_rows_of_all(names):
    covariance = np.tile(1e-6 * np.eye(14), (5, 1, 1))
    calibration, beams = a_calibration(camera_covariance=covariance), a_scan()
    for points in (beams, WorldPoints(ends_of(beams))):
        all_of_them = calibration.project(points, covariance=CovarianceOf())
        some = calibration.project(points, names, covariance=CovarianceOf())
        rows = [calibration.camera_names.index(name) for name in names]
        assert some.cameras == names
        # Matrix products of other sizes sum in another order.
        np.testing.assert_allclose(some.px, all_of_them.px[rows], rtol=1e-12, atol=1e-9)
        np.testing.assert_array_equal(some.is_valid, all_of_them.is_valid[rows])
        np.testing.assert_allclose(sigma_of(some), sigma_of(all_of_them)[rows], rtol=1e-9)


def test_cameras_seeing_a_scan_are_all_that_do():
    calibration, beams = a_calibration(), a_scan()
    seen = np.asarray(calibration.project(beams).is_valid.any(axis=1))
    truly = {name for name, is_seen in zip(calibration.camera_names, seen.tolist(), strict=True) if is_seen}
    assert truly
    assert truly <= set(calibration.cameras_seeing(beams))
    assert truly <= set(calibration.cameras_seeing(WorldPoints(ends_of(beams))))
    assert calibration.cameras_seeing(WorldPoints([[0, 0, 500.0]])) == ()
    assert calibration.cameras_seeing(beams, max_distance_m=0.01) == ()


# Covariance


def test_monte_carlo_of_calibration_and_sensor():
    rng = np.random.default_rng(3)
    lenses = [LensModel.K1_K2, LensModel.FISHEYE, LensModel.K1_K2_P1_P2]
    cameras, scanner, beams = cameras_of(lenses, 2), a_scanner(), a_scan(n=40)
    camera_roots = CAMERA_SIGMA[:, None] * rng.standard_normal((3, 14, 14)) / np.sqrt(14)
    lrf_root = LRF_SIGMA[:, None] * rng.standard_normal((15, 15)) / np.sqrt(15)
    calibration = Calibration.of(
        result_of(cameras, scanner, camera_roots @ camera_roots.transpose(0, 2, 1), lrf_root @ lrf_root.T), "c"
    )
    noise = LrfNoise(tilt_rad=2e-3)
    predicted = calibration.project(beams, covariance=CovarianceOf(noise=noise))
    n_draws, draws = 1500, []
    for _ in range(n_draws):
        steps = np.einsum("cij,cj->ci", camera_roots, rng.standard_normal((3, 14)))
        other = result_of(moved_cameras(cameras, steps), moved_scanner(scanner, lrf_root @ rng.standard_normal(15)))
        measured = Beams(
            LRF,
            beams.range_m + noise.range_m(beams.range_m) * rng.standard_normal(40),
            beams.bearing_rad + noise.bearing_rad * rng.standard_normal(40),
            TILT_RAD + noise.tilt_rad * rng.standard_normal(),
        )
        draws.append(Calibration.of(other, "d").project(measured).px)
    valid = predicted.is_valid
    errors = np.stack(draws)[:, valid] - predicted.px[valid]
    measured = np.einsum("dka,dkb->kab", errors, errors) / n_draws
    white = np.linalg.inv(np.linalg.cholesky(covariance_of(predicted)[valid]))
    ratio = white @ measured @ white.transpose(0, 2, 1)
    # Variances of 1500 draws err by sqrt(2 / 1500) = 3.7 %; four of them, and 1 % of curvature: 8 % of a sigma.
    assert np.abs(ratio - np.eye(2)).max() < 0.16
    assert valid.sum() > 40
    largest = np.sqrt(np.linalg.eigvalsh(covariance_of(predicted)[valid])[:, 1])
    np.testing.assert_allclose(sigma_of(predicted)[valid], largest, rtol=1e-12)


def test_what_is_uncertain_adds_up():
    covariance = np.tile(1e-6 * np.eye(14), (5, 1, 1))
    calibration = a_calibration(camera_covariance=covariance, lrf_covariance=1e-6 * np.eye(15))
    beams = a_scan()
    both = calibration.project(beams, covariance=CovarianceOf())
    of_noise = calibration.project(beams, covariance=CovarianceOf(calibration=False))
    of_calibration = calibration.project(beams, covariance=CovarianceOf(noise=None))
    valid = both.is_valid
    np.testing.assert_allclose(
        covariance_of(both)[valid], (covariance_of(of_noise) + covariance_of(of_calibration))[valid], rtol=1e-9
    )
    assert np.isnan(covariance_of(both)[~valid]).all()
    world = WorldPoints(ends_of(beams))
    exact, loose = (
        calibration.project(world, covariance=CovarianceOf(calibration=False, point_sigma_m=s)) for s in (0.01, 0.02)
    )
    np.testing.assert_allclose(sigma_of(loose)[valid], 2 * sigma_of(exact)[valid], rtol=1e-12)


# The way back


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_points_come_back_from_their_pixels(seed):
    rng = np.random.default_rng(seed)
    calibration = a_calibration(seed=seed, camera_covariance=np.tile(1e-6 * np.eye(14), (5, 1, 1)))
    points = np.column_stack([rng.uniform(-1, 1, (30, 2)), np.zeros(30)])
    projected = calibration.project(WorldPoints(points))
    pixels = {
        name: np.where(projected.is_valid[i][:, None], projected.px[i], np.nan)
        for i, name in enumerate(projected.cameras)
    }
    for i, (name, px) in enumerate(pixels.items()):
        rays, located = calibration.rays(name, px), calibration.floor_points(name, px)
        valid = projected.is_valid[i]
        np.testing.assert_array_equal(rays.is_valid, valid)
        np.testing.assert_array_equal(located.is_valid, valid)
        # Rays are good to 1e-9; the floor is met at ten degrees or more, within 6 m.
        np.testing.assert_allclose(located.xyz_in_world[valid], points[valid], rtol=0, atol=1e-6)
        on_ray = rays.origin_in_world + rng.uniform(0.5, 9, (30, 1)) * rays.direction_in_world
        again = calibration.project(WorldPoints(on_ray), [name]).px[0]
        np.testing.assert_allclose(again[valid], px[valid], rtol=0, atol=1e-6)
    for order in (list(pixels), list(pixels)[::-1]):
        located = calibration.triangulate({name: pixels[name] for name in order})
        np.testing.assert_array_equal(located.is_valid, projected.is_valid.sum(axis=0) >= 2)
        np.testing.assert_allclose(located.xyz_in_world, np.where(located.is_valid[:, None], points, np.nan), atol=1e-6)
        assert (np.linalg.eigvalsh(located.covariance_m2[located.is_valid]) > 0).all()


def test_beams_come_back_from_their_ends():
    calibration, steps = a_calibration(), ScanSteps()
    beams = Beams(LRF, np.random.default_rng(2).uniform(0.5, 5.0, steps.n_measured), steps.bearings_rad, TILT_RAD)
    found = calibration.bearings(LRF, ends_of(beams), TILT_RAD)
    np.testing.assert_allclose(found.bearing_rad, beams.bearing_rad, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.range_m, beams.range_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.out_of_plane_m, 0.0, atol=1e-12)
    np.testing.assert_array_equal(found.step, np.arange(steps.first_step, steps.last_step + 1))
    assert found.is_seen.all()


def test_beams_come_back_from_their_pixels():
    calibration, beams = a_calibration(), a_scan()
    projected = calibration.project(beams)
    for i, name in enumerate(projected.cameras):
        valid = projected.is_valid[i]
        found = calibration.bearings_of_pixels(LRF, name, projected.px[i], TILT_RAD)
        # A ray may run flat along the scan plane, which magnifies its 1e-9.
        np.testing.assert_allclose(found.bearing_rad[valid], beams.bearing_rad[valid], rtol=0, atol=1e-6)
        np.testing.assert_allclose(found.range_m[valid], beams.range_m[valid], rtol=0, atol=1e-5)
        assert found.is_seen[valid].all()


def test_what_no_beam_meets_is_not_seen():
    calibration, scanner = a_calibration(), a_scanner()
    normal = scanner.world_from_lrf_at(TILT_RAD).rotation.as_matrix()[:, 2]
    near = ends_of(Beams(LRF, [2.0], [0.2], TILT_RAD))[0]
    points = [near, near + 0.01 * normal, near + 0.03 * normal, [np.nan, 0, 0]]
    points += list(ends_of(Beams(LRF, [2.0, 9.0, 0.015], [np.pi, 0.2, 0.2], TILT_RAD)))
    found = calibration.bearings(LRF, points, TILT_RAD)
    np.testing.assert_array_equal(found.is_seen, [True, True, False, False, False, False, False])
    np.testing.assert_array_equal(found.step >= 0, [True, True, True, False, False, True, True])
    np.testing.assert_allclose(found.out_of_plane_m[:3], [0.0, 0.01, 0.03], atol=1e-12)
    assert calibration.bearings(LRF, points, TILT_RAD, tolerance_m=0.05).is_seen[2]


# What has no answer


def test_numbers_that_are_none_are_invalid_and_touch_nothing_else():
    calibration, beams = a_calibration(), a_scan(n=6)
    whole = calibration.project(beams, covariance=CovarianceOf())
    broken = np.array([np.nan, np.inf, -np.inf])
    ranges, bearings, tilts = beams.range_m.copy(), beams.bearing_rad.copy(), np.full(6, TILT_RAD)
    ranges[1], bearings[2], tilts[3] = broken
    for bad in (
        Beams(LRF, ranges, beams.bearing_rad, TILT_RAD),
        Beams(LRF, beams.range_m, bearings, TILT_RAD),
        Beams(LRF, beams.range_m, beams.bearing_rad, tilts),
    ):
        got = calibration.project(bad, covariance=CovarianceOf())
        k = {id(ranges): 1}.get(id(bad.range_m), 2 if bad.bearing_rad is bearings else 3)
        assert not got.is_valid[:, k].any()
        kept = np.arange(6) != k
        np.testing.assert_array_equal(got.is_valid[:, kept], whole.is_valid[:, kept])
        np.testing.assert_allclose(got.px[:, kept], whole.px[:, kept], rtol=1e-12, atol=1e-9)
    world = calibration.project(WorldPoints([[np.nan, 0, 0], [0, np.inf, 0], [1e308, 1e308, 1e308], [0, 0, 0]]))
    assert not world.is_valid[:, :3].any()
    assert world.is_valid[:, 3].any()


def test_nothing_asked_is_nothing_answered():
    calibration = a_calibration()
    assert calibration.project(Beams(LRF, [], [], 0.1), covariance=CovarianceOf()).px.shape == (5, 0, 2)
    assert calibration.project(LrfPoints(LRF, [], 0.1)).px.shape == (5, 0, 2)
    assert sigma_of(calibration.project(WorldPoints([]), covariance=CovarianceOf())).shape == (5, 0)
    assert calibration.rays("C0", []).direction_in_world.shape == (0, 3)
    assert calibration.floor_points("C0", []).covariance_m2.shape == (0, 3, 3)
    assert calibration.triangulate({"C0": [], "C1": []}).xyz_in_world.shape == (0, 3)
    assert calibration.bearings(LRF, [], 0.1).step.shape == (0,)


def test_only_the_front_of_a_fisheye_sees_and_its_image_ends_at_the_edge():
    calibration = a_calibration([LensModel.FISHEYE])
    pose, row = calibration.result.cameras[0].cam_from_world, calibration.result.cameras[0].intrinsics
    angle = np.radians([0.0, 30.0, 89.0, 91.0, 120.0, 180.0])
    in_cam = np.column_stack([np.sin(angle), np.zeros(6), np.cos(angle)])
    projected = calibration.project(WorldPoints(pose.inv().apply(3.0 * in_cam)))
    np.testing.assert_array_equal(projected.is_valid[0], [True, True, False, False, False, False])
    assert np.isnan(projected.px[0, 3:]).all()
    # At the last pixel's outer edge, and a thousandth of a pixel further.
    edge = calibration.rays("C0", [[639.5, row[3]]])
    direction = pose.rotation.apply(edge.direction_in_world)[0]
    off_axis = np.arctan2(direction[0], direction[2]) + np.array([-1, 1]) * 1e-3 / row[0]
    beside = np.column_stack([np.sin(off_axis), np.zeros(2), np.cos(off_axis)])
    at_edge = calibration.project(WorldPoints(pose.inv().apply(2.0 * beside)))
    np.testing.assert_array_equal(at_edge.is_valid[0], [True, False])


def test_where_tangential_terms_fold_the_image_no_pixel_shows_two_points():
    cameras = cameras_of([LensModel.K1_K2_P1_P2])
    row = np.array([[500.0, 500, 319.5, 239.5, -0.421, 0.011, 0.004, 0.001]])
    calibration = Calibration.of(result_of(replace(cameras, intrinsics=row), a_scanner()), "bent")
    # The radius folds back at 43 degrees off the axis; to one side the image does so from 41.6 degrees on.
    off_axis, around = np.meshgrid(np.radians(np.linspace(35, 46, 200)), np.linspace(-np.pi, np.pi, 200))
    in_cam = np.stack([np.sin(off_axis) * np.cos(around), np.sin(off_axis) * np.sin(around), np.cos(off_axis)], axis=-1)
    directions = cameras.cam_from_world.rotation.inv().apply(in_cam.reshape(-1, 3))
    points = cameras.centres_in_world[0] + directions
    projected = calibration.project(WorldPoints(points))
    valid = projected.is_valid[0]
    rays = calibration.rays("C0", projected.px[0, valid])
    assert rays.is_valid.mean() > 0.99
    apart = np.linalg.norm(rays.direction_in_world - directions[valid], axis=1)[rays.is_valid]
    # At the fold the pixel hardly moves with the ray: 1e-9 of the focal length is sqrt(1e-9) of a ray.
    assert apart.max() < 1e-4


@pytest.mark.parametrize(
    ("ask", "code", "words"),
    [
        (lambda c: c.project(a_scan(), ["C9"]), ErrorCode.UNKNOWN_CAMERA, "'C9'"),
        (lambda c: c.rays("C9", [[1, 1]]), ErrorCode.UNKNOWN_CAMERA, "C0, C1"),
        (lambda c: c.triangulate({"C0": [[1, 1]], "x": [[1, 1]]}), ErrorCode.UNKNOWN_CAMERA, "'x'"),
        (lambda c: c.project(replace(a_scan(), lrf="L9")), ErrorCode.UNKNOWN_LRF, "It has: L0"),
        (lambda c: c.bearings("L9", [[0, 0, 0]], 0.1), ErrorCode.UNKNOWN_LRF, "'L9'"),
        (lambda c: c.project(replace(a_scan(), tilt_rad=None)), ErrorCode.NO_TILT, "no tilt of L0"),
        (lambda c: c.cameras_seeing(replace(a_scan(), tilt_rad=None)), ErrorCode.NO_TILT, "no tilt of L0"),
        (lambda c: c.bearings(LRF, [[0, 0, 0]], np.nan), ErrorCode.NO_TILT, "nan"),
        (lambda _: Beams(LRF, [1.0], [0.0], np.inf), ErrorCode.NO_TILT, "inf"),
        (lambda _: Beams(LRF, [1.0, 2.0], [0.0], 0.1), ErrorCode.BAD_REQUEST, "2 ranges, but 1 bearings"),
        (lambda _: Beams(LRF, [[1.0]], [[0.0]], 0.1), ErrorCode.BAD_REQUEST, r"\(1, 1\)"),
        (lambda _: Beams(LRF, ["far"], [0.0], 0.1), ErrorCode.BAD_REQUEST, "range_m"),
        (lambda _: Beams(LRF, [1.0], [0.0], [0.1, 0.2]), ErrorCode.BAD_REQUEST, r"tilt_rad has the shape \(2,\)"),
        (lambda _: LrfPoints(LRF, [[1, 0, 0.5]], 0.1), ErrorCode.BAD_REQUEST, "0.5 m off the scan plane"),
        (lambda _: WorldPoints([[1, 2]]), ErrorCode.BAD_REQUEST, r"expected \(N, 3\)"),
        (lambda _: CovarianceOf(point_sigma_m=-1), ErrorCode.BAD_REQUEST, "point_sigma_m"),
        (
            lambda c: c.project(a_scan(), covariance=CovarianceOf(calibration=False, noise=None)),
            ErrorCode.BAD_REQUEST,
            "nothing that is uncertain",
        ),
        (lambda c: c.floor_points("C0", [[1, 1]], sigma_px=0), ErrorCode.BAD_REQUEST, "sigma_px is 0"),
        (lambda c: c.floor_points("C0", [[1, 1]], plane=([0, 0, 0], 1)), ErrorCode.BAD_REQUEST, "plane"),
        (lambda c: c.floor_points("C0", [[1, 1]], plane=([0, 0, 1], None)), ErrorCode.BAD_REQUEST, "plane"),
        (lambda c: c.triangulate({"C0": [[1, 1]]}), ErrorCode.BAD_REQUEST, "two cameras"),
        (lambda c: c.triangulate({"C0": [[1, 1]], "C1": []}), ErrorCode.BAD_REQUEST, "'C0': 1, 'C1': 0"),
    ],
)
def test_what_cannot_be_answered_is_refused_with_a_code(ask, code, words):
    with pytest.raises(ProjectionError, match=words) as refused:
        ask(a_calibration())
    assert refused.value.code == code


# Loading


def test_a_loaded_calibration_is_named_by_its_content(tmp_path):
    path = tmp_path / "calibration.json"
    save(a_calibration().result, path)
    calibration = Calibration.load(path)
    assert calibration.id == hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    assert (calibration.camera_names, calibration.lrf_names) == (("C0", "C1", "C2", "C3", "C4"), (LRF,))
    told = Calibration.from_json(path.read_bytes(), calibration_id="told")
    assert told.id == "told"
    one, other = calibration.project(a_scan()), told.project(a_scan())
    np.testing.assert_array_equal(one.px, other.px)
    # Rotations are saved as quaternions, good to 1e-15.
    np.testing.assert_allclose(one.px, a_calibration().project(a_scan()).px, rtol=1e-9)


def test_a_file_that_is_no_calibration_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"cannot read .*none\.json"):
        Calibration.load(tmp_path / "none.json")
    for text, words in ((b"{", "not valid JSON"), (b"\xff\xfe", "UTF-8"), (b"{}", "faults")):
        (tmp_path / "bad.json").write_bytes(text)
        with pytest.raises(InputError, match=words):
            Calibration.load(tmp_path / "bad.json")


def test_threads_that_ask_at_once_get_what_each_asked():
    calibration = a_calibration(camera_covariance=np.tile(1e-6 * np.eye(14), (5, 1, 1)))
    scans = [a_scan(n=200, seed=k, tilt_rad=0.3 + 0.01 * k) for k in range(8)]
    expected = [calibration.project(scan, covariance=CovarianceOf()) for scan in scans]
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda k: calibration.project(scans[k % 8], covariance=CovarianceOf()), range(160)))
    for k, answer in enumerate(answers):
        np.testing.assert_array_equal(answer.px, expected[k % 8].px)
        np.testing.assert_array_equal(covariance_of(answer), expected[k % 8].covariance_px2)
