"""Time offsets: estimated to a fraction of a frame, whichever camera is the odd one."""

import numpy as np
import pytest

from network_calib.blocks import State
from network_calib.camera_block import PART
from network_calib.observations import Observations
from network_calib.refine import refine
from network_calib.spots import SpotViews
from network_calib.sync import CLOCKS, Clocks, DelayedCameraBlock, estimate_time_offsets, image_velocity
from tests.network_calib.scenes import block_of, joint_problem, setups_of, waved, with_frames_shifted


def offsets_after(observations, scene):
    """Offsets against the median of the cameras, and their sigma, after an ordinary joint solve."""
    views = SpotViews.of(observations)
    refined = refine(setups_of(scene), scene.cameras, views, rejection=4.0)
    found = estimate_time_offsets(refined.problem, refined.state, views, np.flatnonzero(refined.is_inlier))
    return found.offset_frames - np.median(found.offset_frames), found


@pytest.mark.parametrize("camera", [0, 3])
@pytest.mark.parametrize(("missing", "false_detections"), [(0.0, 0.0), (0.3, 0.1)])
def test_a_camera_one_frame_off_is_found_to_a_tenth_of_a_frame(camera, missing, false_detections):
    scene, seen = waved("smart_room", n_frames=1200, missing=missing, false_detections=false_detections)
    offset, found = offsets_after(with_frames_shifted(seen.observations, camera, 1), scene)
    # A frame number too high by one: the exposure was one frame before the others' of that number.
    expected = np.zeros(5)
    expected[camera] = -1.0
    np.testing.assert_allclose(offset, expected, atol=0.1)
    assert found.sigma_frames.max() < 0.1


def test_cameras_in_step_have_no_offset():
    scene, seen = waved("smart_room", n_frames=1200, missing=0.3, false_detections=0.1)
    offset, found = offsets_after(seen.observations, scene)
    sigma = np.maximum(found.sigma_frames, np.median(found.sigma_frames))
    assert (np.abs(offset) < 5 * sigma).all()
    # A walk at 1.25 m/s makes some 6 px a frame: 0.2 px are 0.03 frames, a thousand of them 0.001.
    assert sigma.max() < 0.01


def test_an_offset_of_part_of_a_frame_is_found():
    scene, _ = waved("smart_room", n_frames=1200)
    rng = np.random.default_rng(5)
    # Camera 2 exposes 0.4 frames late: it sees the way of the spot interpolated between the frames.
    index = np.arange(len(scene.trajectory) - 1)
    late = 0.6 * scene.trajectory[:-1] + 0.4 * scene.trajectory[1:]
    rows = []
    for c in range(5):
        spots = late if c == 2 else scene.trajectory[:-1]
        px, is_valid = scene.cameras.img_from_world(np.full(len(index), c), spots)
        seen = index[is_valid & scene.cameras.is_in_image(np.full(len(index), c), px)]
        rows.append((np.full(len(seen), c), seen, px[seen] + 0.2 * rng.standard_normal((len(seen), 2))))
    camera, frame, px = (np.concatenate(column) for column in zip(*rows, strict=True))
    observations = Observations.from_columns(scene.cameras.names, camera=camera, frame=frame, px=px)
    offset, _ = offsets_after(observations, scene)
    np.testing.assert_allclose(offset, [0, 0, 0.4, 0, 0], atol=0.05)


def test_frame_numbers_that_count_in_tens_are_no_obstacle():
    scene, seen = waved("smart_room", n_frames=1200)
    shifted = with_frames_shifted(seen.observations, 3, 1)
    tens = Observations.from_columns(
        shifted.camera_names, camera=shifted.camera, frame=10 * shifted.frame, px=shifted.px
    )
    offset, _ = offsets_after(tens, scene)
    np.testing.assert_allclose(offset, [0, 0, 0, -10, 0], atol=1)


def test_a_camera_whose_detections_are_far_apart_leaves_the_offsets_unknown():
    scene, seen = waved("smart_room", n_frames=1200)
    observations = seen.observations
    rows = np.flatnonzero(observations.camera == 4)
    is_kept = np.ones(len(observations), dtype=bool)
    is_kept[rows] = np.arange(len(rows)) % 8 == 0
    _, found = offsets_after(observations.select(is_kept), scene)
    assert np.isinf(np.delete(found.sigma_frames, found.reference)).all()
    np.testing.assert_array_equal(found.offset_frames, 0)


def test_image_velocity_of_a_parabola_is_exact_for_any_spacing():
    frame = np.array([0, 1, 3, 4, 6, 7])
    px = np.stack([3.0 * frame + 0.1 * frame**2, -2.0 * frame], axis=1)
    velocity = image_velocity(np.zeros(6, dtype=np.int64), frame, px)
    assert np.isnan(velocity[[0, -1]]).all()
    np.testing.assert_allclose(velocity[1:-1], np.stack([3 + 0.2 * frame, -2 + 0 * frame], axis=1)[1:-1])


def test_image_velocity_is_unknown_across_gaps_jumps_and_cameras():
    frame = np.tile(np.arange(10), 2)
    camera = np.repeat([0, 1], 10)
    px = np.column_stack([5.0 * frame, 100.0 * camera]).astype(np.float64)
    px[4] += 80.0  # a false detection
    velocity = image_velocity(camera, frame, px)
    is_known = np.isfinite(velocity).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(~is_known), [0, 3, 4, 5, 9, 10, 19])
    np.testing.assert_allclose(velocity[is_known], np.tile([5.0, 0.0], (13, 1)))
    apart = np.where(np.arange(20) % 10 >= 5, frame + 20, frame)
    velocity = image_velocity(camera, apart, px)
    assert np.isnan(velocity[[4, 5, 14, 15]]).all()


def test_jacobians_of_the_delayed_block_are_its_derivatives():
    problem, state, _ = joint_problem(*waved("smart_room", n_frames=60))
    inner = block_of(problem)
    n, rng = state.n_shared, np.random.default_rng(2)
    clock_columns = np.array([n, n + 1, -1, n + 2, n + 3])
    block = DelayedCameraBlock(inner, 6 * rng.standard_normal((2, len(inner.point))), clock_columns)
    clocks = Clocks(np.array([0.3, -0.5, 0.0, 1.0, 0.2]), 2)
    at = State({PART: state.parts[PART], CLOCKS: clocks}, state.points)
    rows = slice(3, 90)
    residual, by_shared, by_point = block.linearise(at.parts, at.points[:, block.point[rows]], rows)
    np.testing.assert_allclose(residual, block.residual(at.parts, at.points[:, block.point[rows]], rows), atol=1e-9)
    assert by_shared.shape == (15, 2, 87)
    _, inner_by_camera, inner_by_point = inner.linearise(at.parts, at.points[:, block.point[rows]], rows)
    np.testing.assert_array_equal(by_shared[:14], inner_by_camera)
    np.testing.assert_array_equal(by_point, inner_by_point)
    for camera in (0, 1, 3, 4):
        step = np.zeros(at.n_shared)
        step[clock_columns[camera]] = 0.1
        ends = [
            block.residual(
                at.retract(sign * step, np.zeros_like(at.points)).parts, at.points[:, block.point[rows]], rows
            )
            for sign in (1, -1)
        ]
        own = block.group[rows] == camera
        # Linear in the offset: the central difference is exact but for roundoff.
        np.testing.assert_allclose(((ends[0] - ends[1]) / 0.2)[:, own], by_shared[14][:, own], atol=1e-9)
        np.testing.assert_array_equal((ends[0] - ends[1])[:, ~own], 0)
    shuffled = block.take(np.array([5, 2, 80]))
    np.testing.assert_array_equal(shuffled.velocity_px, block.velocity_px[:, [5, 2, 80]])
    np.testing.assert_array_equal(shuffled.point, block.point[[5, 2, 80]])


def test_the_reference_clock_stays():
    clocks = Clocks(np.zeros(4), 2)
    assert clocks.size == 3
    np.testing.assert_array_equal(clocks.retract(np.array([1.0, 2.0, 3.0])).offset_frames, [1, 2, 0, 3])
