"""Laws of the camera models: OpenCV agrees, undistortion inverts distortion, and what has no answer is refused."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from network_calib.cameras import (
    N_INTRINSICS,
    Cameras,
    LensModel,
    cam_from_img,
    distort,
    img_from_cam,
    poses_from_centres,
)

# Rays up to 45 degrees from the axis; with the terms below every lens is one-to-one there: the radial slope of Brown's
# model is at least 1 - 3 * 0.25 = 0.25, less 14 * 0.004 for the tangential terms, and that of the fisheye at least
# 1 - 3 * 0.05 * (pi / 4)^2 - (5 + 7 + 9) * 0.01 > 0.6.
TERM_LIMITS = {
    LensModel.NONE: (),
    LensModel.K1: (0.25,),
    LensModel.K1_K2: (0.25, 0.0),
    LensModel.K1_K2_P1_P2: (0.25, 0.0, 0.004, 0.004),
    LensModel.FISHEYE: (0.05, 0.01, 0.01, 0.01),
}


@st.composite
def lens_and_rays(draw):
    lens = draw(st.sampled_from(list(LensModel)))
    row = np.zeros(N_INTRINSICS)
    row[:4] = draw(st.floats(200, 3000)), draw(st.floats(200, 3000)), draw(st.floats(0, 2000)), draw(st.floats(0, 2000))
    for k, limit in enumerate(TERM_LIMITS[lens]):
        row[4 + k] = draw(st.floats(-limit, limit))
    if lens in (LensModel.K1_K2, LensModel.K1_K2_P1_P2):
        row[5] = draw(st.floats(0.0, 0.08))
    polar = draw(arrays(float, (5, 2), elements=st.floats(0, 1)))
    radius, angle = polar[:, 0], 2 * np.pi * polar[:, 1]
    return lens, row, np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def project(lens, row, ray_xy, depth=1.0):
    in_cam = depth * np.column_stack([ray_xy, np.ones(len(ray_xy))])
    return img_from_cam(row, np.asarray(lens.is_fisheye), in_cam)


@given(lens_and_rays(), st.floats(0.01, 1000))
def test_unproject_inverts_project_at_any_depth(case, depth):
    lens, row, ray_xy = case
    px, is_seen = project(lens, row, ray_xy, depth)
    back, is_valid = cam_from_img(row, np.asarray(lens.is_fisheye), px)
    assert is_seen.all()
    assert is_valid.all()
    # A pixel of 4000 carries 5e-13 px of rounding, 2.5e-15 of a focal length of 200; the slope of at least 0.19 and
    # Newton's stop at 1e-13 make that 6e-13.
    np.testing.assert_allclose(back, ray_xy, rtol=0, atol=1e-12)


def test_undistortion_converges_quadratically_with_tangential_terms():
    row = np.array([500.0, 500, 320, 240, -0.2, 0.05, 0.05, 0.05])
    ray_xy = np.array([[0.5, -0.4], [-0.3, 0.6], [0.4, 0.4]])
    px, _ = project(LensModel.K1_K2_P1_P2, row, ray_xy)
    # Newton squares an error of 0.1 each step: 1e-2, 1e-4, 1e-8, 1e-16, and one to spare. A wrong term in the Jacobian
    # leaves a constant factor per step instead.
    back, is_valid = cam_from_img(row, np.asarray(False), px, max_iterations=5)
    assert is_valid.all()
    np.testing.assert_allclose(back, ray_xy, rtol=0, atol=1e-12)


@given(lens_and_rays())
def test_project_inverts_unproject(case):
    lens, row, ray_xy = case
    px, _ = project(lens, row, ray_xy)
    back, _ = cam_from_img(row, np.asarray(lens.is_fisheye), px)
    again, _ = project(lens, row, back)
    # Newton's stop at 1e-13 of a focal length of 3000 px.
    np.testing.assert_allclose(again, px, rtol=0, atol=1e-9)


@given(lens_and_rays(), st.integers(0, 2**32 - 1))
def test_opencv_projects_to_the_same_pixels(case, seed):
    lens, row, ray_xy = case
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=rng), rng.standard_normal(3)
    in_cam = np.column_stack([ray_xy, np.ones(len(ray_xy))]) * rng.uniform(0.5, 20, (len(ray_xy), 1))
    in_world = turn.inv().apply(in_cam - shift)
    camera = Cameras(
        ("C0",),
        np.array([[640, 480]]),
        (lens,),
        row[None],
        poses_from_centres(turn.as_matrix()[None], -turn.inv().apply(shift)[None]),
    )
    px, is_valid = camera.img_from_world(np.zeros(len(in_world), dtype=np.int64), in_world)
    matrix = np.array([[row[0], 0, row[2]], [0, row[1], row[3]], [0, 0, 1.0]])
    project_points = cv2.fisheye.projectPoints if lens.is_fisheye else cv2.projectPoints
    expected, _ = project_points(in_world.reshape(-1, 1, 3), turn.as_rotvec(), shift, matrix, row[4:])
    assert is_valid.all()
    # World coordinates of 30 m are rounded to 4e-15 m; at 0.5 m depth and a focal length of 3000 px that is 2e-11 px.
    np.testing.assert_allclose(px, expected.reshape(-1, 2), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("k1", "k2"), [(-0.3, 0.0), (-0.5, 0.1), (0.2, -0.1)])
def test_radial_fold_bounds_what_has_a_ray(k1, k2):
    # The fold is the first root s = r^2 of 1 + 3 k1 s + 5 k2 s^2.
    roots = np.roots([5 * k2, 3 * k1, 1]) if k2 else np.array([-1 / (3 * k1)])
    fold = np.sqrt(min(s.real for s in roots if s.real > 0 and abs(s.imag) < 1e-12))
    row = np.array([500.0, 500, 320, 240, k1, k2, 0, 0])
    edge = fold * (1 + k1 * fold**2 + k2 * fold**4)
    inside_px, outside_px = (row[2:4] + 500 * part * edge * np.array([0.6, 0.8]) for part in (0.999, 1.001))
    ray_xy, is_valid = cam_from_img(row, np.asarray(False), np.stack([inside_px, outside_px]))
    assert is_valid.tolist() == [True, False]
    assert np.linalg.norm(ray_xy[0]) < fold
    assert np.isnan(ray_xy[1]).all()


def test_ray_beyond_the_fold_is_never_returned_for_its_pixel():
    row = np.array([500.0, 500, 320, 240, -0.3, 0, 0, 0])  # folds at r = 1 / sqrt(0.9) = 1.054
    px, _ = project(LensModel.K1, row, np.array([[1.4, 0.0]]))
    ray_xy, is_valid = cam_from_img(row, np.asarray(False), px)
    assert is_valid.all()
    assert ray_xy[0, 0] < 1.054


def test_fisheye_that_folds_and_grows_again_refuses_the_second_branch():
    # theta (1 - 0.5 theta^2 + 0.11 theta^4) rises to 0.612 at 1.077 rad, falls, and is at 0.684 again at 90 degrees.
    row = np.array([500.0, 500, 320, 240, -0.5, 0.11, 0, 0])
    ray_xy, is_valid = cam_from_img(
        row, np.asarray(True), np.array([[320 + 500 * 0.60, 240.0], [320 + 500 * 0.65, 240]])
    )
    assert is_valid.tolist() == [True, False]
    assert np.arctan(ray_xy[0, 0]) < 1.077


def test_fisheye_has_no_ray_from_ninety_degrees_on():
    row = np.array([500.0, 500, 320, 240, 0, 0, 0, 0])  # theta_d = theta
    px = np.array([[320 + 500 * np.radians(89.9), 240.0], [320 + 500 * np.radians(90.1), 240.0]])
    _, is_valid = cam_from_img(row, np.asarray(True), px)
    assert is_valid.tolist() == [True, False]


@pytest.mark.parametrize("lens", list(LensModel))
def test_points_behind_or_beside_the_camera_are_invalid(lens):
    row = np.array([500.0, 500, 320, 240, 0, 0, 0, 0])
    in_cam = np.array([[0.1, 0.1, 1.0], [0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 0.0], [np.nan, 0, 1]])
    px, is_valid = img_from_cam(row, np.asarray(lens.is_fisheye), in_cam)
    assert is_valid.tolist() == [True, False, False, False, False]
    assert np.isnan(px[1:]).all()


@pytest.mark.parametrize("is_fisheye", [False, True])
@pytest.mark.parametrize("bad_px", [np.nan, np.inf, 1e200])
def test_absurd_pixels_have_no_ray_and_leave_their_neighbours_alone(is_fisheye, bad_px):
    row = np.array([500.0, 500, 320, 240, -0.1, 0.01, 0, 0])
    ray_xy, is_valid = cam_from_img(row, np.asarray(is_fisheye), np.array([[bad_px, 240.0], [330.0, 240.0]]))
    assert is_valid.tolist() == [False, True]
    assert np.isnan(ray_xy[0]).all()
    assert ray_xy[1, 0] == pytest.approx(0.02, rel=1e-3)  # 10 px of 500; the distortion adds 4e-5 of it


def test_absurd_points_are_invalid_and_their_pixels_nan():
    row = np.array([500.0, 500, 320, 240, -0.1, 0.01, 0, 0])
    px, is_valid = img_from_cam(row, np.asarray(False), np.array([[1e200, 0.0, 1.0], [np.inf, 0.0, 1.0]]))
    assert not is_valid.any()
    assert np.isnan(px).all()


def test_mixed_lenses_in_one_call_equal_one_call_for_each():
    rng = np.random.default_rng(1)
    rows = np.zeros((6, N_INTRINSICS))
    rows[:, :4] = 500, 500, 320, 240
    rows[:, 4:6] = rng.uniform(-0.1, 0.1, (6, 2))
    is_fisheye = np.array([True, False, True, False, False, True])
    px = rng.uniform(0, 480, (6, 2))
    together, _ = cam_from_img(rows, is_fisheye, px)
    alone = np.array([cam_from_img(rows[k], is_fisheye[k], px[k])[0] for k in range(6)])
    # Newton may take one step more in company; both stop below 1e-13, with a slope above 0.5.
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-12)
    assert np.isfinite(together).all()


def test_fisheye_is_smooth_through_the_axis():
    row = np.array([0.1, -0.02, 0.003, 0.001])
    near = distort(row, np.asarray(True), np.array([[0.0, 0.0], [1e-13, 0.0], [1e-11, 0.0]]))
    # theta_d = r + O(r^3).
    np.testing.assert_allclose(near[:, 0], [0, 1e-13, 1e-11], rtol=1e-12)


@given(arrays(float, (3, 3), elements=st.floats(-50, 50)), st.integers(0, 2**32 - 1))
def test_poses_from_centres_give_these_centres_and_rotations_back(centres, seed):
    rotations = Rotation.random(3, rng=np.random.default_rng(seed)).as_matrix()
    lenses = (LensModel.NONE,) * 3
    cameras = Cameras(
        ("a", "b", "c"), np.full((3, 2), 100), lenses, np.zeros((3, 8)), poses_from_centres(rotations, centres)
    )
    # Coordinates of 50 m pass through two products with a rotation: some 10 roundings of 7e-15 m each.
    np.testing.assert_allclose(cameras.centres_in_world, centres, rtol=0, atol=1e-12)
    np.testing.assert_allclose(cameras.rotations, rotations, rtol=0, atol=1e-14)
    moved = cameras.with_poses(rotations[::-1], centres[::-1])
    np.testing.assert_allclose(moved.centres_in_world, centres[::-1], rtol=0, atol=1e-12)
    # A point at the centre is the origin of the camera.
    np.testing.assert_allclose(
        np.concatenate(
            [pose.apply(centre[None]) for pose, centre in zip(cameras.cam_from_world, centres, strict=True)]
        ),
        0,
        atol=1e-12,
    )


def test_image_reaches_from_half_a_pixel_before_the_first_to_half_a_pixel_past_the_last():
    cameras = Cameras(
        ("a",),
        np.array([[640, 480]]),
        (LensModel.NONE,),
        np.zeros((1, 8)),
        poses_from_centres(np.eye(3)[None], np.zeros((1, 3))),
    )
    px = np.array([[-0.5, -0.5], [639.5, 479.5], [-0.6, 10], [639.6, 10], [10, 479.6], [np.nan, 10]])
    is_in = cameras.is_in_image(np.zeros(len(px), dtype=np.int64), px)
    assert is_in.tolist() == [True, True, False, False, False, False]
