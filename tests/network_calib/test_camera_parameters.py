"""Cameras as parameters: a step and its inverse, shared and fixed numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from network_calib.camera_parameters import N_POSE, CameraParameters, free_columns
from network_calib.cameras import LensModel
from tests.network_calib.scenes import waved

FIVE = 5


def columns_of(lens=LensModel.K1_K2_P1_P2, *, groups=None, fixed_poses=(), fixed_intrinsics=(), is_aspect_free=False):
    return free_columns(
        (lens,) * FIVE,
        is_pose_fixed=np.isin(np.arange(FIVE), fixed_poses),
        is_intrinsics_fixed=np.isin(np.arange(FIVE), fixed_intrinsics),
        groups=np.arange(FIVE) if groups is None else np.array(groups),
        is_aspect_free=is_aspect_free,
    )


def smart_parameters(columns):
    scene, _ = waved("smart_room", n_frames=50)
    return CameraParameters.from_cameras(scene.cameras, columns)


def random_step(size, seed):
    """Rotations well below half a turn, where the logarithm is unique."""
    return np.random.default_rng(seed).uniform(-0.8, 0.8, size)


def assert_same(found, expected):
    # Rotations pass through exponential and logarithm: a few units in the last place.
    np.testing.assert_allclose(found.rotations, expected.rotations, atol=1e-13)
    np.testing.assert_allclose(found.centres, expected.centres, atol=1e-13)
    np.testing.assert_allclose(found.optics, expected.optics, rtol=1e-14, atol=1e-13)


@given(
    lens=st.sampled_from(LensModel),
    groups=st.lists(st.integers(0, 2), min_size=FIVE, max_size=FIVE),
    fixed_poses=st.sets(st.integers(0, 4)),
    fixed_intrinsics=st.sets(st.integers(0, 4)),
    is_aspect_free=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_step_to_undoes_retract(lens, groups, fixed_poses, fixed_intrinsics, is_aspect_free, seed):
    columns = columns_of(
        lens,
        groups=groups,
        fixed_poses=list(fixed_poses),
        fixed_intrinsics=list(fixed_intrinsics),
        is_aspect_free=is_aspect_free,
    )
    start = smart_parameters(columns)
    step = random_step(start.size, seed)
    moved = start.retract(step)
    np.testing.assert_allclose(start.step_to(moved), step, atol=1e-12)
    assert_same(start.retract(start.step_to(moved)), moved)


@given(seed=st.integers(0, 1000))
def test_retract_of_step_to_reaches_any_other_cameras(seed):
    start = smart_parameters(columns_of(is_aspect_free=True))
    rng = np.random.default_rng(seed)
    other = CameraParameters(
        rotations=Rotation.random(FIVE, rng=rng).as_matrix(),
        centres=rng.uniform(-9, 9, (FIVE, 3)),
        optics=start.optics * rng.uniform(0.5, 2, (FIVE, 8)) + 0.01,
        is_fisheye=start.is_fisheye,
        columns=start.columns,
    )
    found = start.retract(start.step_to(other))
    # Near half a turn the logarithm is good to the root of the last place.
    np.testing.assert_allclose(found.rotations, other.rotations, atol=1e-7)
    np.testing.assert_allclose(found.centres, other.centres, atol=1e-13)
    np.testing.assert_allclose(found.optics, other.optics, rtol=1e-13)


def test_pack_and_unpack_of_cameras_loses_nothing():
    scene, _ = waved("wide_fisheye", n_frames=50)
    columns = free_columns(
        scene.cameras.lenses,
        is_pose_fixed=np.zeros(4, dtype=bool),
        is_intrinsics_fixed=np.zeros(4, dtype=bool),
        groups=np.arange(4),
    )
    back = CameraParameters.from_cameras(scene.cameras, columns).apply_to(scene.cameras)
    np.testing.assert_allclose(back.intrinsics, scene.cameras.intrinsics, rtol=1e-15)
    np.testing.assert_allclose(back.centres_in_world, scene.cameras.centres_in_world, atol=1e-14)
    np.testing.assert_allclose(back.rotations, scene.cameras.rotations, atol=1e-15)


@pytest.mark.parametrize(
    ("lens", "n_free"),
    [
        (LensModel.NONE, 3),
        (LensModel.K1, 4),
        (LensModel.K1_K2, 5),
        (LensModel.K1_K2_P1_P2, 7),
        (LensModel.FISHEYE, 7),
    ],
)
def test_a_lens_model_frees_its_own_terms_and_no_others(lens, n_free):
    columns = columns_of(lens)
    assert columns.max() + 1 == FIVE * (6 + n_free)
    # Every number from 0 on is used once: nothing is lost, nothing is shared.
    np.testing.assert_array_equal(np.sort(columns[columns >= 0]), np.arange(FIVE * (6 + n_free)))
    assert (columns[:, 10 + lens.n_distortion :] == -1).all()


def test_a_group_moves_as_one():
    start = smart_parameters(columns_of(groups=[0, 1, 0, 1, 2]))
    assert start.size == FIVE * 6 + 3 * 7
    moved = start.retract(random_step(start.size, 4))
    moves = moved.optics - start.optics
    np.testing.assert_allclose(moves[0], moves[2], atol=1e-12)
    np.testing.assert_allclose(moves[1], moves[3], atol=1e-12)
    assert np.abs(moves[0] - moves[1]).max() > 0.01


def test_what_is_fixed_stays_bit_for_bit():
    start = smart_parameters(columns_of(fixed_poses=[1], fixed_intrinsics=[2]))
    moved = start.retract(random_step(start.size, 4))
    np.testing.assert_array_equal(moved.rotations[1], start.rotations[1])
    np.testing.assert_array_equal(moved.centres[1], start.centres[1])
    np.testing.assert_array_equal(moved.optics[2], start.optics[2])
    assert (start.columns[1, :N_POSE] == -1).all()
    assert (moved.optics[[0, 1, 3, 4], 0] != start.optics[[0, 1, 3, 4], 0]).all()
