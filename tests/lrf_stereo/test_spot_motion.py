"""Velocities of the spot: exact where there is no noise, worth what their noise leaves, unknown where nothing tells."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lrf_stereo.spot_motion import (
    HAND_ACCELERATION_M_S2,
    HAND_SPEED_M_S,
    MAX_STEP_S,
    SpotMotion,
    frame_times_s,
    motion_of,
)
from network_calib.observations import Observations
from network_calib.spots import SpotViews

# Three spots make a track; tracks are this far apart in time.
APART_S, STEP_S = 10.0, 0.03


def tracks(velocity, *, acceleration=0.0, noise=None, step_s=STEP_S, n_side=3, rng=None):
    """Positions (F, 3), their covariances, times and the middle of each of n tracks of 2 n_side + 1 spots."""
    n = len(velocity)
    since_s = step_s * np.arange(-n_side, n_side + 1)
    way = velocity[:, None] * since_s[:, None] + acceleration * np.ones(3) * since_s[:, None] ** 2 / 2
    points = (np.random.default_rng(0).uniform(-2, 2, (n, 1, 3)) + way).reshape(-1, 3)
    spread = np.zeros((len(points), 3, 3)) if noise is None else np.tile(noise, (len(points), 1, 1))
    if rng is not None and noise is not None:
        points = points + rng.standard_normal(points.shape) @ np.linalg.cholesky(noise).T
    times = (APART_S * np.arange(n)[:, None] + since_s).ravel()
    return points, spread, times, n_side + (2 * n_side + 1) * np.arange(n)


def views_of(frame, camera, stamp_ns):
    n = len(frame)
    table = Observations.from_columns(
        ("C0", "C1", "C2", "C3"), camera=camera, frame=frame, px=np.zeros((n, 2)), stamp_ns=stamp_ns
    )
    return SpotViews.of(table)


def times_of(views, frame_period_s=None):
    """The times, which are known."""
    times = frame_times_s(views, frame_period_s)
    assert times is not None
    return times


# Times


def test_times_are_those_of_the_stamps_whatever_the_cameras_clocks_say():
    frame = np.repeat([3, 4, 6, 7], 3)
    camera = np.tile([0, 1, 2], 4)
    ahead_ns = np.array([0, 7_000_000_000, -(10**15)])
    stamps = np.repeat([0, 40, 120, 160], 3) * 1_000_000 + ahead_ns[camera]
    times = times_of(views_of(frame, camera, stamps))
    np.testing.assert_allclose(times, [0, 0.04, 0.12, 0.16], atol=1e-15)


def test_a_gap_that_no_camera_bridges_is_a_long_one():
    # Cameras 0 and 1 see the first two frames, camera 2 and one of them a frame each after that.
    frame, camera = np.array([0, 0, 1, 1, 2, 2, 3, 3]), np.array([0, 1, 0, 1, 0, 2, 1, 2])
    stamps = np.array([0, 5, 40, 45, 80, 90, 125, 130]) * 1_000_000
    np.testing.assert_allclose(times_of(views_of(frame, camera, stamps)), [0, 0.04, 0.08, 0.12], atol=1e-15)
    is_kept = frame != 1
    times = times_of(views_of(frame[is_kept][:4], camera[is_kept][:4], stamps[is_kept][:4]))
    assert times[1] == pytest.approx(0.08)
    # A clock that goes back tells as little.
    apart = views_of(np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([0, 0, -40, -40]) * 1_000_000)
    assert times_of(apart)[1] > 1e3
    split = views_of(np.array([0, 0, 1, 1]), np.array([0, 1, 2, 3]), np.array([0, 0, 40, 40]) * 1_000_000)
    assert times_of(split)[1] > 1e3


def test_times_without_stamps_need_the_frame_period():
    views = views_of(np.repeat([5, 8, 9], 2), np.tile([0, 1], 3), None)
    assert frame_times_s(views, None) is None
    np.testing.assert_allclose(times_of(views, 0.05), [0, 0.15, 0.2], atol=1e-15)


# Velocities


@given(seed=st.integers(0, 10_000), rate_hz=st.floats(10.0, 200.0))
def test_exact_positions_give_the_exact_velocity_of_a_parabola(seed, rate_hz):
    velocity = np.random.default_rng(seed).uniform(-1, 1, (5, 3))
    n_side = int(np.ceil(0.1 * rate_hz))
    motion = motion_of(*tracks(velocity, acceleration=1.5, step_s=1 / rate_hz, n_side=n_side))
    assert motion.is_known.all()
    # Positions of 3 m to 4e-16, over steps of 5 ms or more.
    np.testing.assert_allclose(motion.velocity_m_s, velocity, atol=1e-12)
    assert np.abs(motion.covariance_m2_s2).max() < 1e-20
    assert motion.acceleration_m_s2 == pytest.approx(1.5, abs=1e-9)


def test_unequal_steps_give_the_slope_at_the_middle():
    times = np.array([0.0, 0.03, 0.07])
    points = np.outer(times, [0.4, 0, 0]) + np.outer(times**2 / 2, [0, 2.0, 0])
    motion = motion_of(points, np.zeros((3, 3, 3)), times, np.array([1]))
    np.testing.assert_allclose(motion.velocity_m_s[0], [0.4, 0.06, 0], atol=1e-14)


@given(seed=st.integers(0, 1000))
def test_the_world_may_turn_and_shift(seed):
    rng = np.random.default_rng(seed)
    root = rng.uniform(-0.01, 0.01, (3, 3))
    points, spread, times, point = tracks(rng.normal(0, 0.3, (6, 3)), noise=root @ root.T + 1e-6 * np.eye(3), rng=rng)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(-5, 5, 3)
    before = motion_of(points, spread, times, point)
    after = motion_of(points @ turn.T + shift, turn @ spread @ turn.T, times, point)
    # The likeliest speed is found to 1e-15 of the largest square, but stands on squares that round to 1e-13 of theirs.
    np.testing.assert_allclose(after.velocity_m_s, before.velocity_m_s @ turn.T, atol=1e-8)
    np.testing.assert_allclose(after.covariance_m2_s2, turn @ before.covariance_m2_s2 @ turn.T, atol=1e-8)


STEREO = np.diag([2e-3, 2e-3, 0.1]) ** 2


def test_velocities_are_as_good_as_their_covariance_says():
    rng, n, speed = np.random.default_rng(3), 2000, 0.3
    velocity = [0.1, -0.2, 0.0] + speed * rng.standard_normal((n, 3))
    motion = motion_of(*tracks(velocity, noise=STEREO, rng=rng))
    # Across the view the noise is small: 2 n squares, each with a relative deviation of root 2; s is half of that.
    assert motion.spread_m_s == pytest.approx(speed, rel=4 * np.sqrt(2 / (2 * n)) / 2)
    error = motion.velocity_m_s - velocity
    distance2 = np.einsum("ni,ni->n", error, np.linalg.solve(motion.covariance_m2_s2, error[:, :, None])[:, :, 0])
    assert distance2.mean() == pytest.approx(3, abs=4 * np.sqrt(6 / n))
    # The measured depth is worth 0.3^2 / (0.3^2 + 2.4^2) = 2 %; taken as it is, it would err by 2.4 m/s.
    assert np.std(error[:, 2]) == pytest.approx(speed, rel=0.1)
    assert np.std(error[:, 0]) == pytest.approx(2e-3 / np.sqrt(2) / STEP_S, rel=0.1)


@pytest.mark.parametrize("drift", [(0.0, 0.0, 0.0), (0.0, 0.3, 0.0)])
def test_spots_that_move_alike_do_not_differ(drift):
    spreads = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        motion = motion_of(*tracks(np.tile(drift, (66, 1)), noise=STEREO, rng=rng))
        spreads.append(motion.spread_m_s[0])
        if motion.spread_m_s[0] == 0:
            assert np.ptp(motion.velocity_m_s, axis=0).max() < 1e-12
    # Noise of 47 mm/s across; the likelihood's s^2 scatters by root(2 / 132) of its square, around zero: half of the
    # runs stop at zero (binomial, four deviations; the mean takes one of 66 away, a sixteenth of a deviation), and s
    # passes 47 mm/s (4 root(2 / 132))^1/2 in none.
    assert np.mean(np.array(spreads) == 0) == pytest.approx(0.5, abs=4 * 0.5 / 10 + 0.03)
    assert max(spreads) < 2e-3 / np.sqrt(2) / STEP_S * (4 * np.sqrt(2 / 132)) ** 0.5


def is_as_usual(motion, k):
    """Nothing known of one velocity but how the others are."""
    mean, spread = motion.velocity_m_s[motion.is_known].mean(axis=0), motion.spread_m_s[k]
    # The mean of 19 is known to a fourth of the spread, and shrinks by a twentieth at most.
    is_mean = np.linalg.norm(motion.velocity_m_s[k] - mean) < 0.1 * spread
    own = motion.covariance_m2_s2[k] - spread**2 * np.eye(3)
    return not motion.is_known[k] and is_mean and np.linalg.eigvalsh(own)[0] >= 0 and np.trace(own) < 0.2 * spread**2


@pytest.mark.parametrize(
    "case", ["none before", "none after", "itself not located", "too long ago", "no time between", "a jump"]
)
def test_what_has_no_honest_neighbours_is_unknown(case):
    velocity = 0.3 * np.random.default_rng(1).standard_normal((20, 3))
    points, spread, times, point = tracks(velocity, noise=1e-6 * np.eye(3), rng=np.random.default_rng(2))
    before, after = slice(0, 3), slice(4, 7)
    if case == "none before":
        points[before] = np.nan
    elif case == "none after":
        points[after] = np.nan
    elif case == "itself not located":
        points[3] = np.nan
    elif case == "too long ago":
        times[before] = times[3] - 1.01 * MAX_STEP_S
    elif case == "no time between":
        times[after] = times[3]
    else:
        points[after, 0] += 0.5
    motion = motion_of(points, spread, times, point)
    assert is_as_usual(motion, 0)
    assert motion.is_known[1:].all()


def test_a_lost_neighbour_is_replaced_by_the_next():
    velocity = np.array([[0.3, -0.2, 0.1]])
    points, spread, times, point = tracks(velocity, n_side=3)
    points[2] = np.nan
    motion = motion_of(points, spread, times, point)
    np.testing.assert_allclose(motion.velocity_m_s, velocity, atol=1e-13)


def test_spots_that_are_not_asked_for_or_not_there():
    points, spread, times, point = tracks(np.full((2, 3), 0.2))
    motion = motion_of(points, spread, times, np.array([-1, point[1], 0, len(points) - 1]))
    assert motion.is_known.tolist() == [False, True, False, False]


def test_without_times_a_hand_is_assumed():
    points, spread, _, point = tracks(np.full((2, 3), 0.2))
    motion = motion_of(points, spread, None, point)
    assert not motion.velocity_m_s.any()
    assert motion.spread_m_s.tolist() == [HAND_SPEED_M_S] * 2
    assert motion.acceleration_m_s2.tolist() == [HAND_ACCELERATION_M_S2] * 2
    # Half a second later, along any axis: speed, and half the acceleration, times the time and its square.
    variance = (HAND_SPEED_M_S * 0.5) ** 2 + (HAND_ACCELERATION_M_S2 * 0.125) ** 2
    np.testing.assert_allclose(
        motion.displacement_covariance_m2(np.full(2, 0.5)), [variance * np.eye(3)] * 2, rtol=1e-12
    )


def test_still_spots_go_nowhere():
    motion = SpotMotion.still(2)
    assert motion.is_still
    assert not motion.displacement_m(np.ones(2)).any()
    assert not motion.displacement_covariance_m2(np.ones(2)).any()
