"""The camera block: its residual is the projection of `cameras.py`, its Jacobians are its derivatives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.blocks import State
from network_calib.camera_block import PART, CameraBlock, cameras_of
from network_calib.camera_parameters import N_PARAMETERS, CameraParameters
from network_calib.cameras import Cameras, LensModel, cam_from_img, poses_from_centres
from network_calib.synthetic_rooms import look_at

# One free tangent vector for a single camera, aspect included.
ALL_FREE = np.arange(N_PARAMETERS)[None]
# Rotation, centre, focal length, aspect, principal point, distortion: steps of a central difference. The pixel is
# linear in all intrinsics; along angles and positions it curves over lengths of the depth, here > 0.17 m, so that the
# truncation h^2 / (6 z^2) is below 1e-9.
STEPS = np.array([*[1e-5] * 3, *[1e-5] * 3, 1e-2, 1e-5, 1e-2, 1e-2, *[1e-5] * 4])
POINT_STEP = 1e-5


def a_camera(lens, rng):
    """One camera of a lens model with every free term at work, and the largest ray angle it can see."""
    intrinsics = np.array([480.0, 480.0 * rng.uniform(0.95, 1.05), 320 + rng.uniform(-15, 15), 240.0, 0, 0, 0, 0])
    if lens.is_fisheye:
        intrinsics[4:] = np.array([-0.02, 0.004, -0.002, 0.0002]) * rng.uniform(0.5, 1.5, 4)
        max_angle = 1.48
    else:
        terms = np.array([-0.28, 0.09, 0.003, -0.002]) * rng.uniform(0.5, 1.2, 4)
        intrinsics[4 : 4 + lens.n_distortion] = terms[: lens.n_distortion]
        max_angle = 0.8
    centre = rng.uniform(-3, 3, (1, 3))
    pose = poses_from_centres(look_at(centre, centre + rng.standard_normal((1, 3))), centre)
    cameras = Cameras(("C0",), np.array([[640, 480]]), (lens,), intrinsics[None], pose)
    return cameras, max_angle


def seen_by(cameras, angle, rng):
    """World points at the given angles off the axis, 2 m away, in random directions around it."""
    turn = rng.uniform(0, 2 * np.pi, len(angle))
    in_cam = 2 * np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    return np.ascontiguousarray(cameras.cam_from_world.inv()[0].apply(in_cam).T)


def block_and_state(lens, seed, angles_of=None):
    """A block of eight detections from the axis to the rim by one camera, and a state."""
    rng = np.random.default_rng(seed)
    cameras, max_angle = a_camera(lens, rng)
    parts = np.array([1e-9, 1e-6, 4e-4, 1e-3, 0.02, 0.3, 0.7, 1.0]) if angles_of is None else angles_of
    points = seen_by(cameras, max_angle * parts, rng)
    n = points.shape[1]
    block = CameraBlock(
        group=np.zeros(n, dtype=np.int64),
        point=np.arange(n),
        px=rng.uniform(0, 480, (2, n)),
        inverse_sigma=rng.uniform(0.3, 4, n),
        columns=ALL_FREE,
    )
    return block, State({PART: CameraParameters.from_cameras(cameras, ALL_FREE)}, points), cameras


def central_differences(block, state, n_columns, steps):
    """(D, 2, n) and (3, 2, n) by central differences."""
    rows, none = slice(0, len(block.point)), np.zeros_like(state.points)

    def residual(shared_step, point_step):
        moved = state.retract(shared_step, point_step)
        return block.residual(moved.parts, moved.points[:, block.point], rows)

    by_shared = [
        (residual(h * e, none) - residual(-h * e, none)) / (2 * h)
        for h, e in zip(steps, np.eye(n_columns), strict=True)
    ]
    by_point = []
    for k in range(3):
        step = none.copy()
        step[k] = POINT_STEP
        zero = np.zeros(n_columns)
        by_point.append((residual(zero, step) - residual(zero, -step)) / (2 * POINT_STEP))
    return np.stack(by_shared), np.stack(by_point)


def assert_is_derivative(analytic, numeric, steps, residual):
    # Roundoff of a difference: some 8 units in the last place of the largest number in the residual, over 2 h.
    roundoff = 8 * 2.2e-16 * (np.abs(residual).max() + 2000) / (2 * steps)
    np.testing.assert_array_less(np.abs(analytic - numeric), 1e-6 * np.abs(numeric) + roundoff[:, None, None] + 1e-300)


@given(lens=st.sampled_from(LensModel), seed=st.integers(0, 10_000))
def test_jacobians_are_the_derivatives_from_the_axis_to_the_rim(lens, seed):
    block, state, _ = block_and_state(lens, seed)
    residual, by_camera, by_point = block.linearise(state.parts, state.points, slice(0, 8))
    numeric_camera, numeric_point = central_differences(block, state, N_PARAMETERS, STEPS)
    assert_is_derivative(by_camera, numeric_camera, STEPS, residual)
    assert_is_derivative(by_point, numeric_point, np.full(3, POINT_STEP), residual)


@pytest.mark.parametrize("lens", LensModel)
def test_the_derivative_by_a_distortion_term_is_not_zero_at_the_rim(lens):
    block, state, _ = block_and_state(lens, 3)
    _, by_camera, _ = block.linearise(state.parts, state.points, slice(0, 8))
    # At the rim r > 0.8, so that every term moves the pixel by more than f r^9 / 4 > 10 px per unit.
    assert (np.abs(by_camera[10:, :, -1]).max(axis=1) > 10).all()


@given(lens=st.sampled_from(LensModel), seed=st.integers(0, 10_000))
def test_residual_is_the_projection_of_the_camera_model(lens, seed):
    block, state, cameras = block_and_state(lens, seed)
    px, is_valid = cameras.img_from_world(block.group, state.points.T)
    assert is_valid.all()
    residual = block.residual(state.parts, state.points, slice(0, 8))
    # Two ways to the same number of some 1000 px: a few units in the last place, over a sigma of 0.25.
    np.testing.assert_allclose(residual, (px.T - block.px) * block.inverse_sigma, atol=1e-9)
    again, _, _ = block.linearise(state.parts, state.points, slice(0, 8))
    np.testing.assert_allclose(residual, again, atol=1e-9)


def test_residual_of_a_spot_behind_the_camera_is_not_a_number():
    block, state, cameras = block_and_state(LensModel.K1, 0)
    points = 2 * cameras.centres_in_world.T - state.points
    assert np.isnan(block.residual(state.parts, points, slice(0, 8))).all()


def test_fisheye_derivative_has_no_step_where_the_series_takes_over():
    # The series replaces the closed form below r = 1e-3; both sides differ by the first term left out, r^4 ~ 1e-12.
    block, state, _ = block_and_state(LensModel.FISHEYE, 1, np.full(2, 1e-3 / 1.48))
    state.points[:, 1] = state.points[:, 0]
    cameras = cameras_of(state.parts)
    ray = cameras.rotations[0] @ (state.points[:, 0] - cameras.centres[0])
    axis = np.array([0, 0, ray[2]])
    for k, factor in enumerate([1 - 1e-9, 1 + 1e-9]):
        scale = factor * 1e-3 * ray[2] / np.hypot(*ray[:2])
        in_cam = axis + scale * np.array([ray[0], ray[1], 0])
        state.points[:, k] = cameras.rotations[0].T @ in_cam + cameras.centres[0]
    residual, by_camera, by_point = block.linearise(state.parts, state.points, slice(0, 2))
    inverse_sigma = block.inverse_sigma
    px = residual / inverse_sigma + block.px
    # The points are 2e-9 x 2 mm apart: 1e-9 px. The derivatives by the point, some 240 px/m, differ by r^4 and by that.
    assert np.abs(px[:, 0] - px[:, 1]).max() < 1e-8
    np.testing.assert_allclose(by_point[:, :, 0] / inverse_sigma[0], by_point[:, :, 1] / inverse_sigma[1], atol=1e-6)
    np.testing.assert_allclose(by_camera[:, :, 0] / inverse_sigma[0], by_camera[:, :, 1] / inverse_sigma[1], atol=1e-5)


def test_rows_can_be_reordered_and_thinned():
    block, state, _ = block_and_state(LensModel.K1_K2, 5)
    rows = np.array([6, 1, 3])
    taken = block.take(rows)
    np.testing.assert_array_equal(
        taken.residual(state.parts, state.points[:, taken.point], slice(0, 3)),
        block.residual(state.parts, state.points, slice(0, 8))[:, rows],
    )


def test_detected_pixel_of_the_spot_itself_has_no_residual():
    block, state, cameras = block_and_state(LensModel.K1_K2_P1_P2, 7)
    px, _ = cameras.img_from_world(block.group, state.points.T)
    ray_xy, is_valid = cam_from_img(cameras.intrinsics[[0] * 8], cameras.is_fisheye[[0] * 8], px)
    assert is_valid.all()
    there = np.einsum("ij,kj->ki", cameras.rotations[0].T, np.column_stack([ray_xy, np.ones(8)]))
    points = np.ascontiguousarray((there + cameras.centres_in_world[0]).T)
    exact = CameraBlock(block.group, block.point, np.ascontiguousarray(px.T), np.ones(8), ALL_FREE)
    # The inverse is good to 1e-9 of the focal length.
    assert np.abs(exact.residual(state.parts, points, slice(0, 8))).max() < 1e-6
