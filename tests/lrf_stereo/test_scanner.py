"""Equation 3 against hand-computed cases; laws of the general model; the device's steps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.scanner import ScanSteps, TiltingScanner, eq3_points
from network_calib.errors import InputError
from network_calib.gauge import Similarity

SEEDS = st.integers(0, 2**32 - 1)


def random_motion(rng):
    return RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))


def random_scanner(seed):
    """Any pose, any axis within a metre, every nuisance away from its default."""
    rng = np.random.default_rng(seed)
    return TiltingScanner(
        random_motion(rng),
        rng.normal(size=3) + np.array([3.0, 0, 0]),  # never short
        rng.uniform(-1, 1, 3),
        reference_tilt_rad=rng.uniform(-1, 1),
        tilt_gain=rng.uniform(0.9, 1.1),
        range_bias_m=rng.uniform(-0.05, 0.05),
        range_scale=rng.uniform(0.95, 1.05),
        bearing_zero_rad=rng.uniform(-0.1, 0.1),
    )


def readings(rng, n=20):
    return rng.uniform(0.3, 5.0, n), rng.uniform(-2.0, 2.0, n), rng.uniform(-0.9, 0.9, n)


def test_steps_of_the_urg_are_those_of_its_data_sheet():
    steps = ScanSteps()
    assert steps.n_measured == 682
    # -340 and 341 steps of 360 / 1024 degrees.
    assert np.rad2deg(steps.bearing_rad([44, 384, 725])) == pytest.approx([-119.53125, 0, 119.8828125], abs=1e-12)
    assert steps.bearings_rad[[0, -1]] == pytest.approx(steps.bearing_rad([44, 725]))
    # 0.1 s / 1024 = 97.66 us; the front step comes 37.5 ms and the last 70.8 ms after step 0.
    assert steps.time_s([1, 384, 725]) == pytest.approx([97.65625e-6, 37.5e-3, 70.80078125e-3], abs=1e-12)
    last = np.deg2rad(119.8828125)
    assert steps.beam_time_s([0.0, last, -last]) == pytest.approx([37.5e-3, 70.80078125e-3, 4.19921875e-3], abs=1e-12)


@given(st.floats(-2 * np.pi, 2 * np.pi), st.floats(0.01, 0.2))
def test_a_bearing_and_the_same_one_a_turn_on_are_taken_at_one_time_of_the_sweep(bearing, turn_s):
    times = ScanSteps(turn_s=turn_s).beam_time_s([bearing, bearing + 2 * np.pi])
    assert (times >= 0).all()
    assert (times <= turn_s).all()
    # Equal but for a whole turn, where rounding may put one at the begin and the other at the end.
    off = abs(times[0] - times[1])
    assert min(off, turn_s - off) < 1e-12


@given(st.integers(0, 1023), st.integers(1, 4096))
def test_step_inverts_bearing(step, steps_per_turn):
    steps = ScanSteps(steps_per_turn=steps_per_turn)
    assert steps.step(steps.bearing_rad(step)) == pytest.approx(step, abs=1e-9)


def test_error_codes_and_readings_out_of_reach_are_not_ranges():
    values = [0, 1, 7, 19, 20, 1000, 5600, 5601, -3]
    assert ScanSteps().is_range(values).tolist() == [False, False, False, False, True, True, True, False, False]
    assert ScanSteps(range_min_m=0.0).is_range([0, 19, 20]).tolist() == [False, False, True]
    assert ScanSteps(range_min_m=0.06).is_range([20, 59, 60]).tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("reading", "point"),
    [
        # Ahead, level: (rho + dx, 0, dz).
        ((2.0, 0.0, 0.0), (2.04, 0.0, 0.06)),
        # Left, level: y is left.
        ((2.0, np.pi / 2, 0.0), (0.04, 2.0, 0.06)),
        # Ahead, a quarter turn down: x becomes -z, z becomes x.
        ((2.0, 0.0, np.pi / 2), (0.06, 0.0, -2.04)),
        # Ahead, 30 degrees: x = 0.866 * 2.04 + 0.5 * 0.06, z = -0.5 * 2.04 + 0.866 * 0.06.
        ((2.0, 0.0, np.pi / 6), (2.04 * 0.75**0.5 + 0.03, 0.0, -1.02 + 0.06 * 0.75**0.5)),
        # Left and tilted: the beam lies along the axis and does not move, the mirror does.
        ((2.0, np.pi / 2, np.pi / 2), (0.06, 2.0, -0.04)),
    ],
)
def test_equation_3_by_hand(reading, point):
    expected = np.array(point)
    assert eq3_points(*reading, dx_m=0.04, dz_m=0.06) == pytest.approx(expected, abs=1e-12)
    scanner = TiltingScanner.from_paper(RigidTransform.identity(), 0.04, 0.06)
    assert scanner.points_in_world(*reading) == pytest.approx(expected, abs=1e-12)


@given(SEEDS)
def test_the_general_model_contains_equation_3(seed):
    rng = np.random.default_rng(seed)
    world_from_axis, dx, dz = random_motion(rng), rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1)
    scanner = TiltingScanner.from_paper(world_from_axis, dx, dz, reference_tilt_rad=rng.uniform(-1, 1))
    reading = readings(rng)
    expected = world_from_axis.apply(eq3_points(*reading, dx_m=dx, dz_m=dz))
    # Some ten operations on numbers below 10: 1e-14, with a factor of 100 in hand; the same below.
    assert scanner.points_in_world(*reading) == pytest.approx(expected, abs=1e-12)


def test_range_bearing_and_gain_are_measured_over_true():
    scanner = TiltingScanner(
        RigidTransform.identity(), np.array([0.0, 2.0, 0.0]), np.zeros(3), tilt_gain=2.0, range_bias_m=0.1,
        range_scale=1.1, bearing_zero_rad=0.2,
    )  # fmt: skip
    # True: (2.3 - 0.1) / 1.1 = 2 m, 0.2 - 0.2 = 0 rad, 2 * 15 = 30 degrees down.
    assert scanner.points_in_world(2.3, 0.2, np.pi / 12) == pytest.approx(np.array([3**0.5, 0, -1]), abs=1e-12)


@given(SEEDS)
def test_measure_inverts_points_and_points_invert_measure(seed):
    scanner, rng = random_scanner(seed), np.random.default_rng(seed)
    reach, bearing, tilt = readings(rng)
    points = scanner.points_in_world(reach, bearing, tilt)
    back = scanner.measure(points, tilt)
    assert np.stack(back) == pytest.approx(np.stack([reach, bearing, np.zeros(20)]), abs=1e-11)
    # A point off the plane: its foot, plus its height along the plane's normal, is the point.
    points = points + rng.normal(size=points.shape)
    reach, bearing, height = scanner.measure(points, tilt)
    normal = scanner.world_from_lrf_at(tilt).rotation.as_matrix()[:, :, 2]
    foot = scanner.points_in_world(reach, bearing, tilt)
    assert foot + height[:, None] * normal == pytest.approx(points, abs=1e-11)


@given(SEEDS)
def test_poses_and_points_agree_and_the_axis_stays(seed):
    scanner, rng = random_scanner(seed), np.random.default_rng(seed)
    reach, bearing, tilt = readings(rng)
    poses = scanner.world_from_lrf_at(tilt)
    by_pose = poses.apply(scanner.points_in_lrf(reach, bearing))
    assert by_pose == pytest.approx(scanner.points_in_world(reach, bearing, tilt), abs=1e-11)
    reference = scanner.world_from_lrf_at(scanner.reference_tilt_rad)
    assert reference.as_matrix() == pytest.approx(scanner.world_from_lrf.as_matrix(), abs=1e-12)
    on_axis = scanner.axis_point_in_world + rng.normal() * scanner.axis_direction_in_world
    in_lrf = poses.inv().apply(on_axis)
    assert in_lrf == pytest.approx(np.tile(scanner.world_from_lrf.inv().apply(on_axis), (20, 1)), abs=1e-11)


def test_a_growing_tilt_looks_down_and_turns_right_handed():
    scanner = TiltingScanner.from_paper(RigidTransform.identity(), 0.0, 0.0)
    points = scanner.points_in_world(1.0, 0.0, np.deg2rad([0, 10, 40]))
    assert (np.diff(points[:, 2]) < 0).all()
    assert np.cross(points[0], points[1]) @ scanner.axis_direction_in_world > 0


@given(SEEDS)
def test_axis_point_is_normalised_to_the_foot_point(seed):
    scanner, rng = random_scanner(seed), np.random.default_rng(seed)
    direction, point = scanner.axis_direction_in_world, scanner.axis_point_in_world
    assert np.linalg.norm(direction) == pytest.approx(1, abs=1e-15)
    assert abs(point @ direction) < 1e-15 * 10
    shifted = TiltingScanner(scanner.world_from_lrf, 7 * direction, point + rng.normal() * direction)
    assert shifted.axis_point_in_world == pytest.approx(point, abs=1e-14)


@given(SEEDS)
def test_paper_form_round_trip(seed):
    rng = np.random.default_rng(seed)
    form = {"dx_m": rng.uniform(-0.1, 0.1), "dz_m": rng.uniform(-0.1, 0.1)}
    # Yaw below 90 degrees is what makes roll, pitch and yaw unique.
    mount = {"mount_roll_rad": rng.uniform(-3, 3), "mount_yaw_rad": rng.uniform(-1.5, 1.5)}
    world_from_axis = random_motion(rng)
    scanner = TiltingScanner.from_paper(world_from_axis, **form, **mount, reference_tilt_rad=rng.uniform(-1, 1))
    back = scanner.as_paper()
    # cos(1.5) = 0.07 divides the rounding of the angles.
    assert back.world_from_axis.as_matrix() == pytest.approx(world_from_axis.as_matrix(), abs=1e-11)
    assert [back.dx_m, back.dz_m] == pytest.approx(list(form.values()), abs=1e-12)
    assert [back.mount_roll_rad, back.mount_yaw_rad] == pytest.approx(list(mount.values()), abs=1e-11)
    assert back.d_m * np.sin(back.phi_rad) == pytest.approx(back.dx_m, abs=1e-15)
    assert back.d_m * np.cos(back.phi_rad) == pytest.approx(back.dz_m, abs=1e-15)


@given(SEEDS)
def test_any_scanner_has_a_paper_form_that_rebuilds_it(seed):
    scanner = random_scanner(seed)
    form = scanner.as_paper()
    rebuilt = TiltingScanner.from_paper(
        form.world_from_axis, form.dx_m, form.dz_m, mount_roll_rad=form.mount_roll_rad,
        mount_yaw_rad=form.mount_yaw_rad, reference_tilt_rad=scanner.reference_tilt_rad,
    )  # fmt: skip
    assert rebuilt.world_from_lrf.as_matrix() == pytest.approx(scanner.world_from_lrf.as_matrix(), abs=1e-11)
    assert rebuilt.axis_direction_in_world == pytest.approx(scanner.axis_direction_in_world, abs=1e-11)
    assert rebuilt.axis_point_in_world == pytest.approx(scanner.axis_point_in_world, abs=1e-11)


@given(SEEDS)
def test_a_rigid_motion_of_the_world_moves_the_points_and_nothing_else(seed):
    scanner, rng = random_scanner(seed), np.random.default_rng(seed)
    reading, motion = readings(rng), random_motion(rng)
    moved = scanner.moved_by(motion)
    assert moved.points_in_world(*reading) == pytest.approx(motion.apply(scanner.points_in_world(*reading)), abs=1e-11)
    before, after = scanner.as_paper(), moved.as_paper()
    for name in ("dx_m", "dz_m", "mount_roll_rad", "mount_yaw_rad"):
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-10)


@given(SEEDS, st.floats(0.01, 100))
def test_a_similarity_scales_the_points_and_leaves_the_readings(seed, scale):
    scanner, rng = random_scanner(seed), np.random.default_rng(seed)
    reach, bearing, tilt = readings(rng)
    motion = Similarity(scale, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    moved, points = scanner.moved_by(motion), scanner.points_in_world(reach, bearing, tilt)
    assert moved.points_in_world(reach, bearing, tilt) == pytest.approx(motion.apply(points), abs=1e-11 * (1 + scale))
    measured_range, measured_bearing, _ = moved.measure(motion.apply(points), tilt)
    # Coordinates of size 1 + 10 scale lose 1e-15 of that, which is 1 / scale metres of range.
    assert measured_range == pytest.approx(reach, abs=1e-12 * (10 + 1 / scale))
    assert measured_bearing == pytest.approx(bearing, abs=1e-11 * (10 + 1 / scale))


@given(SEEDS, st.floats(-0.5, 0.5))
def test_a_bearing_zero_is_the_same_as_a_turn_of_the_lrf_about_its_own_axis(seed, angle):
    # So the two cannot be told apart: a joint solve must hold one of them.
    rng = np.random.default_rng(seed)
    reading, pose = readings(rng), random_motion(rng)
    direction, point = rng.normal(size=3), rng.normal(size=3)
    turned = pose * RigidTransform.from_rotation(Rotation.from_rotvec([0, 0, angle]))
    a = TiltingScanner(pose, direction, point).points_in_world(*reading)
    b = TiltingScanner(turned, direction, point, bearing_zero_rad=angle).points_in_world(*reading)
    assert b == pytest.approx(a, abs=1e-11)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"axis_direction_in_world": np.zeros(3)}, "needs a direction and a point"),
        ({"axis_point_in_world": np.array([0, np.nan, 0])}, "needs a direction and a point"),
        ({"range_scale": 0.0}, "must be positive"),
        ({"tilt_gain": -1.0}, "must be positive"),
    ],
)
def test_impossible_scanners_are_refused(change, reason):
    sound = {
        "world_from_lrf": RigidTransform.identity(), "axis_direction_in_world": np.array([0, 1.0, 0]),
        "axis_point_in_world": np.zeros(3),
    }  # fmt: skip
    assert TiltingScanner(**sound).tilt_gain == 1
    with pytest.raises(InputError, match=reason):
        TiltingScanner(**{**sound, **change})


def test_an_axis_along_the_view_has_no_paper_form():
    scanner = TiltingScanner(RigidTransform.identity(), np.array([1.0, 0, 0]), np.zeros(3))
    with pytest.raises(InputError, match="along the LRF's forward axis"):
        scanner.as_paper()
