"""Gauge: the directions no image sees, and the frames that a world can be put into."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from network_calib.blocks import State
from network_calib.camera_block import PART, cameras_of
from network_calib.camera_parameters import CameraParameters
from network_calib.errors import DegenerateError
from network_calib.gauge import (
    Similarity,
    camera_gauge,
    fit_similarity,
    inner_gauge,
    into_camera,
    level_to_floor,
    similarity_directions,
)
from tests.network_calib.scenes import block_of, joint_problem, waved


def a_similarity(seed):
    rng = np.random.default_rng(seed)
    return Similarity(rng.uniform(0.2, 5), Rotation.random(rng=rng).as_matrix(), rng.uniform(-5, 5, 3))


@pytest.mark.parametrize("name", ["smart_room", "wide_fisheye"])
def test_no_residual_changes_along_the_directions(name):
    problem, state, _ = joint_problem(*waved(name, n_frames=60), has_prior=False)
    block = block_of(problem)
    parameters = cameras_of(state.parts)
    directions = similarity_directions(parameters)
    rows = slice(0, len(block.point))
    residual, by_camera, by_point = block.linearise(state.parts, state.points[:, block.point], rows)
    for k in range(7):
        # What the same motion does to the spots: translation, turn about the origin, scale.
        unit = np.eye(3)[k % 3]
        points = [np.tile(unit[:, None], state.points.shape[1]), np.cross(unit, state.points.T).T, state.points]
        point_step = points[k // 3]
        moves = np.append(directions[:, k], 0.0)[parameters.columns][block.group]
        analytic = np.einsum("dmn,nd->mn", by_camera, moves) + np.einsum(
            "amn,an->mn", by_point, point_step[:, block.point]
        )
        # Sums of terms of some 1000 px / (m sigma 0.2 px) that cancel to the last places.
        assert np.abs(analytic).max() < 1e-8
        ends = []
        for h in (1e-4, -1e-4):
            moved = state.retract(h * directions[:, k], h * point_step)
            ends.append(block.residual(moved.parts, moved.points[:, block.point], rows))
        # Second order is left: a turn by 1e-4 of spots 5 m off moves them by 1e-8 of that, times 1000 / 0.2 a metre.
        assert np.abs((ends[0] + ends[1]) / 2 - residual).max() < 1e-3
        assert np.abs(ends[0] - ends[1]).max() / 2e-4 < 1e-3


@pytest.mark.parametrize("gauge", [inner_gauge, lambda state: camera_gauge(state, 2, 0, 3)])
def test_a_gauge_holds_exactly_what_is_free(gauge):
    _, state, _ = joint_problem(*waved("smart_room", n_frames=60))
    named = gauge(state)
    assert named.constraints.shape == (7, state.n_shared)
    # Seven constraints, and none of the seven directions satisfies them all.
    held = named.constraints @ named.null
    assert np.linalg.cond(held) < 1e4


@given(seed=st.integers(0, 10_000))
def test_fit_similarity_finds_it(seed):
    motion = a_similarity(seed)
    rng = np.random.default_rng(seed + 1)
    source = rng.standard_normal((6, 3))
    found = fit_similarity(source, motion.apply(source))
    np.testing.assert_allclose(found.scale, motion.scale, rtol=1e-12)
    np.testing.assert_allclose(found.rotation, motion.rotation, atol=1e-11)
    np.testing.assert_allclose(found.translation, motion.translation, atol=1e-10)


@given(seed=st.integers(0, 1000))
def test_fit_similarity_never_mirrors(seed):
    rng = np.random.default_rng(seed)
    source = rng.standard_normal((5, 3))
    found = fit_similarity(source, source * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.scale > 0


def test_fit_similarity_leaves_the_least_squares():
    rng = np.random.default_rng(0)
    source, target = rng.standard_normal((8, 3)), rng.standard_normal((8, 3))
    best = fit_similarity(source, target)
    cost = ((best.apply(source) - target) ** 2).sum()
    for k in range(20):
        small = Rotation.from_rotvec(1e-3 * rng.standard_normal(3)).as_matrix()
        other = Similarity(best.scale * (1 + 1e-3 * (-1) ** k), small @ best.rotation, best.translation + 1e-3)
        assert ((other.apply(source) - target) ** 2).sum() > cost


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (np.eye(3)[:2], "needs 3 known positions or more, got 2"),
        (np.linspace(0, 1, 5)[:, None] * [1.0, 2.0, 3.0], "one line"),
        (np.ones((4, 3)), "one line"),
    ],
)
def test_positions_that_fix_no_frame_are_refused(source, words):
    with pytest.raises(DegenerateError, match=words):
        fit_similarity(source, source)


def test_a_motion_of_cameras_and_points_leaves_the_pixels():
    scene, seen = waved("smart_room", n_frames=60)
    motion = a_similarity(4)
    camera = seen.observations.camera
    before, _ = scene.cameras.img_from_world(camera, scene.trajectory[seen.point])
    moved = motion.apply_to_cameras(scene.cameras)
    after, _ = moved.img_from_world(camera, motion.apply(scene.trajectory)[seen.point])
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_into_camera_puts_it_at_the_origin_looking_along_z():
    scene, _ = waved("smart_room", n_frames=60)
    moved = into_camera(scene.cameras, 3, 2.0).apply_to_cameras(scene.cameras)
    np.testing.assert_allclose(moved.rotations[3], np.eye(3), atol=1e-14)
    np.testing.assert_allclose(moved.centres_in_world[3], 0, atol=1e-13)
    ratio = np.linalg.norm(np.diff(moved.centres_in_world, axis=0), axis=1) / np.linalg.norm(
        np.diff(scene.cameras.centres_in_world, axis=0), axis=1
    )
    np.testing.assert_allclose(ratio, 2.0, rtol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_level_to_floor_restores_the_rooms_own_height(seed):
    scene, _ = waved("smart_room", n_frames=60)
    tilted = Similarity(1.0, a_similarity(seed).rotation, a_similarity(seed).translation)
    floor = np.array([[1.0, 1.0, 0.0], [4.0, 1.5, 0.0], [2.0, 4.0, 0.0], [5.0, 3.0, 0.0]])
    cameras = tilted.apply_to_cameras(scene.cameras)
    level = level_to_floor(tilted.apply(floor), cameras)
    assert level.scale == 1.0
    np.testing.assert_allclose(level.apply(tilted.apply(floor))[:, 2], 0, atol=1e-12)
    centres = level.apply_to_cameras(cameras).centres_in_world
    np.testing.assert_allclose(centres[:, 2], scene.cameras.centres_in_world[:, 2], atol=1e-12)
    np.testing.assert_allclose(centres[0, :2], 0, atol=1e-12)  # the origin is below the first camera
    forward = level.apply_to_cameras(cameras).rotations[0][2]
    assert forward[0] > 0.5  # x is where it looks
    assert abs(forward[1]) < 1e-12
    assert np.linalg.det(level.rotation) == pytest.approx(1.0)


def test_floor_points_on_a_line_are_refused():
    scene, _ = waved("smart_room", n_frames=60)
    with pytest.raises(DegenerateError, match="plane"):
        level_to_floor(np.linspace(0, 1, 4)[:, None] * [1.0, 2.0, 0.0], scene.cameras)
    with pytest.raises(DegenerateError, match="plane"):
        level_to_floor(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), scene.cameras)


def test_a_camera_that_looks_straight_down_still_gets_a_level_frame():
    scene, _ = waved("smart_room", n_frames=60)
    rotations = scene.cameras.rotations.copy()
    rotations[0] = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    cameras = scene.cameras.with_poses(rotations, scene.cameras.centres_in_world)
    floor = np.array([[1.0, 1.0, 0.0], [4.0, 1.5, 0.0], [2.0, 4.0, 0.0]])
    level = level_to_floor(floor, cameras)
    np.testing.assert_allclose(level.rotation @ level.rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(level.rotation[2], [0, 0, 1], atol=1e-12)


def test_gauge_of_a_state_uses_the_state_not_the_start():
    _, state, _ = joint_problem(*waved("smart_room", n_frames=60))
    parameters = cameras_of(state.parts)
    moved = CameraParameters(
        parameters.rotations, parameters.centres + 5.0, parameters.optics, parameters.is_fisheye, parameters.columns
    )
    other = inner_gauge(State({PART: moved}, state.points + 5.0))
    assert np.abs(other.null - inner_gauge(state).null).max() > 1
