import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError
from network_calib.synthetic import room
from nodes.simulated.rendering.spot_path import SpotPath

STRAIGHT = np.array([1.0, 2.0, 0.5]) + np.arange(6.0)[:, None] * np.array([0.02, -0.01, 0.005])


@given(st.floats(-0.2, 0.5))
def test_straight_even_motion_stays_so_between_and_beyond_the_points(time_s):
    path = SpotPath(STRAIGHT, 25.0)
    assert path.at(np.array([time_s]))[0] == pytest.approx(STRAIGHT[0] + 25 * time_s * (STRAIGHT[1] - STRAIGHT[0]))


def test_the_path_goes_through_its_points_and_is_smooth_there():
    points = room("smart_room", rng=np.random.default_rng(2), n_frames=50).trajectory
    path = SpotPath(points, 25.0)
    time_s = np.arange(50) / 25
    np.testing.assert_allclose(path.at(time_s), points, atol=1e-12)
    step_s = 1e-6
    before, after = (path.at(time_s[1:-1] + side * step_s) for side in (-1, 1))
    # A kink would show as a difference of the speeds; smooth curves leave step times acceleration, below 1e-4 m/s.
    speed_change = (after - points[1:-1]) / step_s - (points[1:-1] - before) / step_s
    assert np.abs(speed_change).max() < 1e-4


def test_nothing_flies_across_a_cut():
    points = np.concatenate([STRAIGHT, STRAIGHT + np.array([10.0, 0.0, 0.0])])
    path = SpotPath(points, 25.0)
    # A third of a step on both sides of the cut, each side goes straight on.
    around = path.at(np.array([5 + 1 / 3, 6 - 1 / 3]) / 25)
    velocity = STRAIGHT[1] - STRAIGHT[0]
    np.testing.assert_allclose(around, [points[5] + velocity / 3, points[6] - velocity / 3], atol=1e-12)


def test_nobody_is_there_before_the_path_begins():
    built = room("smart_room", rng=np.random.default_rng(2), n_frames=20)
    path = SpotPath.of(built, n_empty=10)
    assert len(path) == 30
    assert not path.is_shining(9 / 25)
    assert path.is_shining(10 / 25)
    assert np.isnan(path.at(np.array([0.2]))).all()
    np.testing.assert_array_equal(path.at(np.array([10 / 25]))[0], built.trajectory[0])


def test_a_switched_pointer_is_off_where_it_is_said():
    path = SpotPath(STRAIGHT, 25.0).switched(np.array([True, False, True, True, True, True]))
    assert [path.is_shining(k / 25) for k in range(3)] == [True, False, True]


@pytest.mark.parametrize(
    ("points", "rate_hz", "is_on", "named"),
    [
        (np.zeros((1, 3)), 25.0, None, "points_in_world"),
        (np.zeros((4, 2)), 25.0, None, "points_in_world"),
        (STRAIGHT, 0.0, None, "rate_hz"),
        (STRAIGHT, 25.0, np.ones(5, dtype=bool), "is_on"),
    ],
)
def test_a_path_that_cannot_be_is_refused(points, rate_hz, is_on, named):
    with pytest.raises(InputError, match=named):
        SpotPath(points, rate_hz, is_on)
