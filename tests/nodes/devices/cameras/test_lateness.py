import pytest

from nodes.devices.cameras.lateness import Lateness


def test_late_is_more_than_two_periods_after_the_frame_before():
    lateness = Lateness(10.0)
    arrivals_s = [5.0, 5.1, 5.29, 5.5, 5.6, 6.6, 6.7]
    assert [lateness.is_late(arrival_s) for arrival_s in arrivals_s] == [False, False, False, True, False, True, False]


@pytest.mark.parametrize("rate_hz", [5.0, 25.0, 120.0])
def test_an_unknown_period_is_learned(rate_hz):
    lateness = Lateness(None)
    arrivals_s = [k / rate_hz for k in range(50)]
    assert not any(map(lateness.is_late, arrivals_s))
    assert lateness.is_late(arrivals_s[-1] + 2.5 / rate_hz)


def test_a_camera_that_halves_its_unknown_rate_for_good_is_not_late_for_ever():
    lateness = Lateness(None)
    for k in range(50):
        lateness.is_late(k / 30.0)
    judged = [lateness.is_late(50 / 30.0 + k / 12.0) for k in range(100)]
    assert judged[1]
    assert not any(judged[50:])
