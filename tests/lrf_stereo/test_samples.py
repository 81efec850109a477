"""Sightings as they are handed in: optional columns, and what is refused."""

import numpy as np
import pytest

from lrf_stereo.samples import MAX_DELAY_S, LrfSpots
from network_calib.errors import InputError


def spots(**columns):
    one = np.ones(3)
    given = {"frame": np.arange(3), "setting": np.zeros(3, dtype=int), "range_m": one, "bearing_rad": 0 * one}
    given |= {"out_of_plane_m": 0 * one, "sigma_range_m": one, "sigma_bearing_rad": one, "sigma_out_of_plane_m": one}
    return LrfSpots(**(given | columns))


def test_bounds_and_delays_are_zero_unless_given():
    default = spots()
    assert default.bias_bound_m.tolist() == default.delay_s.tolist() == [0, 0, 0]
    kept = spots(delay_s=np.array([0.01, -0.02, 0.03])).select(np.array([True, False, True]))
    assert kept.delay_s.tolist() == [0.01, 0.03]
    assert kept.bias_bound_m.tolist() == [0, 0]


@pytest.mark.parametrize(
    "delay_s", [np.zeros(2), np.array([0.0, np.nan, 0.0]), np.array([0.0, -1.001 * MAX_DELAY_S, 0.0])]
)
def test_delays_that_are_none_are_refused(delay_s):
    with pytest.raises(InputError, match="delays of LRF sightings must be seconds within"):
        spots(delay_s=delay_s)
