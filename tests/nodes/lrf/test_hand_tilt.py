"""When an LRF that is tilted by hand has been turned and stands still: drawn gyroscopes, and whole acquisitions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lrf_stereo.tilt import PAPER_AXIS, ImuNoise
from nodes.devices.mti import ImuSample
from nodes.lrf.hand_tilt import HandTilt, HandTiltOptions

RATE_HZ = 100.0
DENSITY = ImuNoise().gyro_rad_s_sqrt_hz
LATE_S = 1000.0  # this machine's clock against the device's


def fed(hand, rate_rad_s, *, begin_s=0.0, tilt_rad=0.0, bias=(0.01, -0.017, 0.006), seed=0):
    """Feed turns (n,) about the tilt axis at RATE_HZ; the end."""
    rng = np.random.default_rng(seed)
    for k, rate in enumerate(rate_rad_s):
        noise = DENSITY * np.sqrt(RATE_HZ) * rng.standard_normal(3)
        up = 9.81 * np.array([-np.sin(tilt_rad), 0.0, np.cos(tilt_rad)])
        device_s = begin_s + k / RATE_HZ
        hand.add(ImuSample(k, device_s, LATE_S + device_s, rate * PAPER_AXIS + np.array(bias) + noise, up))
    return begin_s + len(rate_rad_s) / RATE_HZ


def turn(angle_rad, duration_s):
    """Rates of a turn of least jerk."""
    part = (np.arange(duration_s * RATE_HZ) + 0.5) / (duration_s * RATE_HZ)
    return angle_rad / duration_s * 30 * part**2 * (1 - part) ** 2


def still(duration_s):
    return np.zeros(round(duration_s * RATE_HZ))


@pytest.fixture
def hand():
    return HandTilt(axis_in_imu=PAPER_AXIS)


@given(angle_deg=st.floats(4, 60), speed_deg_s=st.floats(4, 40), seed=st.integers(0, 1000))
def test_turn_and_rest_are_found_with_their_times(angle_deg, speed_deg_s, seed):
    duration_s = angle_deg / speed_deg_s
    hand = HandTilt(axis_in_imu=PAPER_AXIS)
    angle_rad = np.radians(angle_deg)
    begin_s = fed(hand, still(3.0), seed=seed)
    hand.begin()
    end_s = fed(hand, turn(angle_rad, duration_s), begin_s=begin_s, seed=seed + 1)
    fed(hand, still(2.5), begin_s=end_s, seed=seed + 2)
    assert hand.has_arrived(angle_rad, is_first=False)
    # At 4 deg/s the first 1 % of the way is too slow to show; noise and bias over 15 s and more make 0.4 degrees.
    assert hand.turned_rad == pytest.approx(angle_rad, abs=np.radians(0.6) + 0.02 * angle_rad)
    assert hand.left_s is not None
    assert hand.still_since_s is not None
    assert hand.left_s < LATE_S + begin_s + 0.3 * duration_s
    # Before the end only by what is too slow to show, and after it by a piece or two.
    assert end_s - 0.3 * duration_s - 0.2 < hand.still_since_s - LATE_S < end_s + 0.3


def test_a_turn_is_not_over_while_it_goes_on_and_not_before_it_was_still_for_long_enough(hand):
    begin_s = fed(hand, still(3.0))
    hand.begin()
    end_s = fed(hand, turn(0.4, 3.0), begin_s=begin_s)
    assert not hand.has_arrived(0.4, is_first=False)
    end_s = fed(hand, still(1.0), begin_s=end_s)
    assert not hand.has_arrived(0.4, is_first=False)
    fed(hand, still(1.0), begin_s=end_s)
    assert hand.has_arrived(0.4, is_first=False)


def test_rest_alone_is_no_new_tilt_but_may_be_the_first(hand):
    fed(hand, still(4.0), tilt_rad=np.radians(12.5))
    assert not hand.has_arrived(np.radians(12.1), is_first=False)
    assert hand.has_arrived(np.radians(12.1), is_first=True)
    assert not hand.has_arrived(np.radians(23.2), is_first=True)
    assert hand.tilt_rad == pytest.approx(np.radians(12.5), abs=1e-9)


def test_ten_minutes_of_rest_neither_turns_nor_ends(hand):
    fed(hand, still(600.0), bias=(0.03, 0.0, 0.0))
    assert hand.still_since_s is not None
    # Pieces beyond six sigma would count: there is none in 6000, and one would be of a tenth of a degree.
    assert hand.turned_rad < np.radians(0.1)


def test_a_bump_shows_and_a_push_that_springs_back_does_not(hand):
    begin_s = fed(hand, still(3.0))
    hand.begin()
    begin_s = fed(hand, np.concatenate([turn(0.02, 0.4), turn(-0.02, 0.4), still(3.0)]), begin_s=begin_s)
    assert not hand.is_bumped
    fed(hand, np.concatenate([turn(0.02, 0.4), still(3.0)]), begin_s=begin_s)
    assert hand.is_bumped
    assert hand.still_since_s is not None


def test_a_large_bias_is_learnt_in_time_and_no_deadlock(hand):
    begin_s = fed(hand, still(3.0), bias=(0.0, 0.2, 0.0))
    assert hand.still_since_s is None  # 11 deg/s may be a turn
    fed(hand, still(6.0), begin_s=begin_s, bias=(0.0, 0.2, 0.0))
    assert hand.still_since_s is not None


def test_a_gap_in_the_samples_begins_anew(hand):
    begin_s = fed(hand, still(3.0))
    fed(hand, still(1.0), begin_s=begin_s + 5.0)
    assert hand.still_since_s is None


def test_threshold_is_that_of_the_noise():
    # 0.05 deg/s/sqrt(Hz) over 0.1 s leave 0.158 deg/s; six of them.
    assert np.degrees(HandTiltOptions().still_rad_s) == pytest.approx(6 * 0.05 / np.sqrt(0.1))
