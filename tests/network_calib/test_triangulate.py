"""Triangulation: exact on exact rays, honest about spots that cannot be placed, finds the one wrong view."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from network_calib.synthetic_rooms import look_at
from network_calib.triangulate import largest_parallax_rad, residuals, triangulate, triangulate_robust


def ring(n_cameras=5, n_points=60, *, seed=0):
    """Cameras on a circle of 4 m around spots in a box, every spot seen by all: (camera, point, ray, R, c, spots)."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, n_cameras, endpoint=False) + 0.1
    centres = np.column_stack([4 * np.cos(angle), 4 * np.sin(angle), rng.uniform(1.5, 2.5, n_cameras)])
    rotations = look_at(centres, np.array([0.0, 0.0, 1.0]))
    spots = rng.uniform([-1.5, -1.5, 0.2], [1.5, 1.5, 2.0], (n_points, 3))
    camera, point = np.tile(np.arange(n_cameras), n_points), np.repeat(np.arange(n_points), n_cameras)
    in_cam = np.einsum("kij,kj->ki", rotations[camera], spots[point] - centres[camera])
    return camera, point, in_cam[:, :2] / in_cam[:, 2:], rotations, centres, spots


def test_exact_rays_give_exact_spots():
    camera, point, ray, rotations, centres, spots = ring()
    points, is_valid = triangulate(camera, point, ray, rotations, centres, len(spots))
    assert is_valid.all()
    # Rounding of 1e-16 at a distance of 5 m, magnified by a few: far below 1e-12 m.
    np.testing.assert_allclose(points, spots, atol=1e-12)


def test_noisy_rays_reach_the_least_squares_optimum():
    camera, point, ray, rotations, centres, spots = ring()
    noisy = ray + 0.002 * np.random.default_rng(1).standard_normal(ray.shape)
    points, _ = triangulate(camera, point, noisy, rotations, centres, len(spots))

    def cost(moved):
        return np.bincount(point, weights=residuals(camera, point, noisy, rotations, centres, moved) ** 2)

    # At an optimum a step of 0.1 mm either way along any axis costs more: the cost's curvature there is about
    # 5 / (4 m)^2, so the slope left by stopping at a relative decrease of 1e-6 is a tenth of what the step adds.
    for axis in np.eye(3):
        assert (cost(points + 1e-4 * axis) > cost(points)).all()
        assert (cost(points - 1e-4 * axis) > cost(points)).all()


@settings(max_examples=25, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-50, 50)] * 3),
    log_scale=st.floats(-5, 5),
)
def test_a_similarity_moves_the_spots_with_the_cameras(turn, shift, log_scale):
    camera, point, ray, rotations, centres, spots = ring(3, 10)
    noisy = ray + 0.002 * np.random.default_rng(2).standard_normal(ray.shape)
    here, _ = triangulate(camera, point, noisy, rotations, centres, len(spots))
    rotation, scale = Rotation.from_rotvec(turn).as_matrix(), np.exp(log_scale)
    there, is_valid = triangulate(
        camera, point, noisy, rotations @ rotation.T, scale * centres @ rotation.T + shift, len(spots)
    )
    assert is_valid.all()
    # Gauss-Newton stops at a relative decrease of 1e-6; between the two frames the stop may fall one step apart, which
    # near the optimum is a thousandth of the noise's 1 cm.
    np.testing.assert_allclose(there, scale * here @ rotation.T + shift, atol=1e-5 * scale + 1e-9)


def test_spots_that_no_two_rays_place_are_invalid():
    rotations, centres = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [1, 0, 0]])
    # Parallel rays; rays that meet behind; one ray alone; and, last, a good spot at (0.5, 0, 2).
    camera, point = np.array([0, 1, 0, 1, 0, 0, 1]), np.array([0, 0, 1, 1, 2, 3, 3])
    x = np.array([0.1, 0.1, -0.25, 0.25, 0.0, 0.25, -0.25])
    ray = np.column_stack([x, np.zeros(7)])
    points, is_valid = triangulate(camera, point, ray, rotations, centres, 4)
    assert is_valid.tolist() == [False, False, False, True]
    assert np.isnan(points[:3]).all()
    np.testing.assert_allclose(points[3], [0.5, 0, 2], atol=1e-12)


def test_rows_without_weight_are_left_out():
    camera, point, ray, rotations, centres, spots = ring()
    wrong = camera == 2
    ray = ray + 0.3 * wrong[:, None]
    points, is_valid = triangulate(camera, point, ray, rotations, centres, len(spots), weights=(~wrong).astype(float))
    assert is_valid.all()
    np.testing.assert_allclose(points, spots, atol=1e-12)
    _, only_one = triangulate(
        camera, point, ray, rotations, centres, len(spots), weights=(camera == 0).astype(np.float64)
    )
    assert not only_one.any()


@pytest.mark.parametrize("n_cameras", [4, 6, 12])
def test_the_one_wrong_view_of_each_spot_is_found(n_cameras):
    camera, point, ray, rotations, centres, spots = ring(n_cameras)
    rng = np.random.default_rng(3)
    is_wrong = camera == rng.integers(0, n_cameras, len(spots))[point]
    # A sixteenth of the field of view or more away, in every direction.
    angle = rng.uniform(0, 2 * np.pi, len(ray))
    away = rng.uniform(0.06, 0.3, len(ray))[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    ray = ray + is_wrong[:, None] * away + 0.0003 * rng.standard_normal(ray.shape)
    points, is_valid, is_inlier = triangulate_robust(
        camera, point, ray, rotations, centres, len(spots), tolerance=np.full(len(ray), 0.004)
    )
    assert is_valid.all()
    np.testing.assert_array_equal(is_inlier, ~is_wrong)
    # Noise of 0.0003 at up to 6 m is 2 mm for a ray; three or more rays from all sides leave less than 5 sigma of it.
    assert np.linalg.norm(points - spots, axis=1).max() < 0.01


def test_spots_whose_two_views_disagree_are_refused():
    # Side by side along x, so that views which differ in y never meet.
    rotations, centres = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [1, 0, 0]])
    spots = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (50, 3))
    camera, point = np.tile([0, 1], 50), np.repeat(np.arange(50), 2)
    offset = spots[point] - centres[camera]
    # Half of 0.02 falls on each view, 2.5 tolerances.
    ray = offset[:, :2] / offset[:, 2:] + np.where((camera == 1)[:, None], [0.0, 0.02], 0.0)
    points, is_valid, is_inlier = triangulate_robust(
        camera, point, ray, rotations, centres, 50, tolerance=np.full(100, 0.004)
    )
    assert not is_valid.any()
    assert not is_inlier.any()
    assert np.isnan(points).all()


def test_three_wrong_views_of_seven_are_found():
    camera, point, ray, rotations, centres, spots = ring(7, 40)
    is_wrong = (camera + point) % 7 < 3
    scattered = np.random.default_rng(4).uniform(-0.4, 0.4, ray.shape)
    _, is_valid, is_inlier = triangulate_robust(
        camera,
        point,
        np.where(is_wrong[:, None], scattered, ray),
        rotations,
        centres,
        len(spots),
        tolerance=np.full(len(ray), 0.004),
    )
    # Leaving out one view at a time can leave out a good one first, and three removals are all there are: a spot in ten
    # may be given up, but none may be placed with a scattered ray, which meets its spot with a chance of (1 / 100)^2.
    assert is_valid.mean() >= 0.9
    assert not (is_inlier & is_wrong).any()


def test_residuals_are_infinite_behind_the_camera():
    rotations, centres = np.eye(3)[None], np.zeros((1, 3))
    points = np.array([[0.0, 0, 2], [0, 0, -2], [np.nan, 0, 1]])
    distance = residuals(np.zeros(3, dtype=int), np.arange(3), np.full((3, 2), 0.3), rotations, centres, points)
    np.testing.assert_allclose(distance, [0.3 * np.sqrt(2), np.inf, np.inf])


def test_parallax_is_the_largest_angle_between_rays():
    # Rays at 0, 45 and 90 degrees in one camera turned three ways; a single ray has none.
    rotations = np.stack([Rotation.from_rotvec([0, a, 0]).as_matrix() for a in (0, np.pi / 4, np.pi / 2)])
    camera, point = np.array([0, 1, 2, 0, 1, 0]), np.array([0, 0, 0, 1, 1, 2])
    angle = largest_parallax_rad(camera, point, np.zeros((6, 2)), rotations, 3)
    np.testing.assert_allclose(angle, [np.pi / 2, np.pi / 4, 0.0], atol=1e-7)
