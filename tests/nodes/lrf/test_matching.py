"""Crossings joined to the cameras' frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lrf_stereo.crossing import Crossings
from lrf_stereo.tilt import Tilts
from network_calib.errors import InputError
from nodes.devices.mti import ImuCounts
from nodes.devices.scip import ScanCounts
from nodes.lrf.acquisition import SettingData
from nodes.lrf.matching import lrf_spots, tilt_settings
from nodes.lrf.tilt_of_session import SessionTilts
from nodes.lrf_node import Acquired

PERIOD_S = 0.04


def crossings_at(time_s) -> Crossings:
    time_s = np.asarray(time_s, dtype=np.float64)
    n = len(time_s)
    ones, none = np.ones(n), np.zeros(n)
    return Crossings(
        time_s=time_s, begin_s=time_s, end_s=time_s, n_scans=np.full(n, 4), range_m=1 + time_s, bearing_rad=0.1 * ones,
        sigma_range_m=0.003 * ones, sigma_bearing_rad=0.002 * ones, sigma_out_of_plane_m=0.004 * ones,
        bias_bound_m=none, direction=np.ones(n, dtype=np.int64), pair=np.arange(n), score=ones,
    )  # fmt: skip


def acquired(*times) -> Acquired:
    settings = tuple(SettingData(crossings_at(time_s), 0.0, 100.0) for time_s in times)
    n = len(settings)
    tilts = SessionTilts(Tilts(np.arange(n) / 10, 1e-6 * np.eye(n)), ("steps",))
    return Acquired(settings, tilts, ScanCounts(), ImuCounts(), 0)


def frames(n=100):
    return 7 + np.arange(n), 2.0 + PERIOD_S * np.arange(n, dtype=np.float64)


@given(places=st.dictionaries(st.integers(0, 99), st.floats(-0.49, 0.49), min_size=1, max_size=20))
def test_each_crossing_gets_the_nearest_frame_and_what_is_left_as_delay(places):
    times = [2.0 + PERIOD_S * (frame + off) for frame, off in places.items()]
    numbers, stamps_s = frames()
    spots = lrf_spots(acquired(times), numbers, stamps_s)
    back = stamps_s[spots.frame - 7] + spots.delay_s
    np.testing.assert_allclose(np.sort(back), np.sort(times), atol=1e-12)
    assert np.abs(spots.delay_s).max() <= PERIOD_S / 2 + 1e-12
    np.testing.assert_allclose(spots.range_m, 1 + back)  # every row keeps its own numbers


def test_settings_are_numbered_over_all_lrfs():
    numbers, stamps_s = frames()
    spots = lrf_spots(acquired([2.5, 3.0], [4.0]), numbers, stamps_s, first_setting=3)
    assert spots.setting.tolist() == [3, 3, 4]
    both = tilt_settings([acquired([2.5], [3.0]), acquired([2.5], [3.0], [4.0])])
    assert both.scanner.tolist() == [0, 0, 1, 1, 1]
    np.testing.assert_array_equal(both.covariance_rad2, 1e-6 * np.eye(5))


def test_crossings_in_a_gap_of_the_cameras_are_left_out():
    numbers, stamps_s = frames()
    is_there = (stamps_s < 3.0) | (stamps_s > 4.0)
    spots = lrf_spots(acquired([2.5, 3.5, 4.5]), numbers[is_there], stamps_s[is_there])
    assert len(spots) == 2


def test_two_crossings_in_one_frame_count_once():
    numbers, stamps_s = frames()
    assert len(lrf_spots(acquired([2.5, 2.505]), numbers, stamps_s)) == 1


def test_clocks_that_do_not_agree_are_said():
    numbers, stamps_s = frames()
    with pytest.raises(InputError, match="no crossing lies near a frame") as error:
        lrf_spots(acquired([2.5]), numbers, stamps_s + 1000.0)
    assert "Synchronise" in error.value.advice
    with pytest.raises(InputError, match="two or more that grow"):
        lrf_spots(acquired([2.5]), numbers, stamps_s[::-1])
