"""Trapezoids and play."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.simulated.tilt_motion import MAX_MOVES, Move, TiltMotion

moves = st.builds(
    Move,
    begin_s=st.floats(-5, 5),
    begin=st.floats(-900, 600),
    end=st.floats(-900, 600),
    speed=st.floats(10, 3000),
    acceleration=st.floats(100, 10000),
)


@given(move=moves)
def test_a_move_keeps_its_ends_its_speed_and_its_acceleration(move):
    time_s = np.linspace(move.begin_s - 0.1, move.end_s + 0.1, 4001)
    position, interval = move.position(time_s), time_s[1] - time_s[0]
    assert position[0] == move.begin
    assert position[-1] == pytest.approx(move.end, abs=1e-9)
    speed = np.diff(position) / interval
    # Rounding of positions of some hundred steps, divided by the interval once and twice.
    assert np.abs(speed).max() <= move.speed + 1e-12 / interval
    assert np.abs(np.diff(speed)).max() / interval <= move.acceleration + 1e-11 / interval**2
    assert (np.sign(move.end - move.begin) * np.diff(position) >= -1e-11).all()


@pytest.mark.parametrize(("end", "duration_s"), [(100.0, 2 * np.sqrt(100 / 2000)), (1000.0, 1.0 + 0.5), (-1000.0, 1.5)])
def test_duration_by_hand(end, duration_s):
    # Up to 500 steps the speed of 1000 steps/s is not reached at 2000 steps/s2; beyond, distance/speed + speed/acc.
    assert Move(0.0, 0.0, end, 1000.0, 2000.0).duration_s == pytest.approx(duration_s)


def test_the_load_follows_by_half_the_play_on_the_side_it_came_from():
    motion = TiltMotion(play=4.0)
    motion.go(Move(0.0, 0.0, 100.0, 1000.0, 2000.0))
    assert motion.load(10.0) == 98.0
    motion.go(Move(10.0, 100.0, 99.0, 1000.0, 2000.0))
    assert motion.load(20.0) == 98.0  # within the play nothing moves
    motion.go(Move(20.0, 99.0, 0.0, 1000.0, 2000.0))
    np.testing.assert_array_equal(motion.load([-1.0, 5.0, 15.0, 30.0]), [0.0, 98.0, 98.0, 2.0])
    assert motion.motor(30.0) == 0.0


def test_memory_is_bounded_and_the_present_right():
    motion = TiltMotion()
    for k in range(3 * MAX_MOVES):
        motion.go(Move(float(k), float(k % 2), float((k + 1) % 2), 100.0, 1000.0))
    assert motion.load(1e6) == (3 * MAX_MOVES) % 2
    assert len(motion._moves) == MAX_MOVES
