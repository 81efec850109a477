"""A device's clock from arrivals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.clock_fit import ClockFit, fit_clock

DRIFT = 1300e-6


def even(rng, n):
    return rng.uniform(0, 0.1, n)


def falling(rng, n):
    return np.minimum(rng.exponential(0.02, n), 0.1)


def errors(delays, *, duration_s, n_runs=150):
    """(n_runs, 2) error and stated sigma of the newest message's time, s."""
    rng, out = np.random.default_rng(4), []
    device = np.arange(0.0, duration_s, 0.1)
    true = 5 + device / (1 + DRIFT)
    for _ in range(n_runs):
        line = fit_clock(np.column_stack([device, true + delays(rng, len(device))]))
        out.append((line.host_s(device[-1]) - true[-1], line.sigma_s(device[-1])))
    return np.array(out).T


@pytest.mark.parametrize("delays", [even, falling])
@pytest.mark.parametrize("duration_s", [10.0, 60.0])
def test_stated_sigma_is_true(delays, duration_s):
    error, sigma = errors(delays, duration_s=duration_s)
    # Not Gaussian; a fourth moment of 9 bounds what is seen, so a standard deviation of 150 runs is known to
    # sqrt((9 - 1) / 150) / 2 = 12 %. Three of those, and 10 % for the grid and the cut tail.
    assert np.std(error / sigma) == pytest.approx(1.0, abs=0.46)
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error)) + 0.1 * sigma.mean()


def test_the_error_falls_as_the_number_of_messages_and_not_as_its_root():
    short, _ = errors(even, duration_s=10.0)
    long, _ = errors(even, duration_s=80.0)
    # As 1/n it is 8 times smaller, as its root 2.8 times.
    assert short.std() / long.std() > 4.0


def test_delays_of_which_some_are_short_give_a_millisecond_after_ten_seconds():
    error, _ = errors(falling, duration_s=10.0)
    assert np.sqrt((error**2).mean()) < 1e-3


def test_the_mean_of_arrivals_is_far_worse():
    error, _ = errors(falling, duration_s=10.0)
    assert np.sqrt((error**2).mean()) < 0.02 / 10  # the mean delay is 20 ms: what stamping by arrival would be wrong by


def test_fixed_latency_is_taken_off():
    device = np.arange(0.0, 10.0, 0.1)
    fits = [ClockFit(latency_s=latency_s) for latency_s in (0.0, 0.05)]
    for t in device:
        for fit in fits:
            fit.add(t, 5 + t)
    assert fits[0].line().host_s(9.0) - fits[1].line().host_s(9.0) == pytest.approx(0.05)


def test_a_drift_that_changes_is_followed():
    fit, rng, host = ClockFit(window_s=30.0), np.random.default_rng(1), 0.0
    for k in range(2000):
        host += 0.1 / (1 + (1300e-6 if k < 1000 else 0.0))
        fit.add(0.1 * k, host + rng.exponential(0.01))
    assert fit.line().gain == pytest.approx(1.0, abs=5 * np.sqrt(fit.line().covariance[1, 1]) + 1e-6)
    assert fit.line().host_s(0.1 * 1999) == pytest.approx(host, abs=1e-3)


def test_first_messages_give_what_they_can():
    fit = ClockFit()
    with pytest.raises(ValueError, match="no arrivals"):
        fit.line()
    fit.add(10.0, 20.0)
    assert fit.line().host_s(10.0) == 20.0
    fit.add(10.1, 20.15)
    assert fit.line().sigma_s(10.1) > 1e-3


@given(
    shift=st.floats(-1e6, 1e6),
    delays=st.lists(st.floats(0, 1), min_size=3, max_size=60),
    at=st.floats(0, 1),
)
def test_the_line_moves_with_the_clocks(shift, delays, at):
    device = np.arange(len(delays), dtype=np.float64)
    arrivals = np.column_stack([device, device + np.array(delays)])
    one, two = fit_clock(arrivals), fit_clock(arrivals + shift)
    where = at * device[-1]
    # Times of a million seconds are rounded to 1e-10 s, which the fit may weigh up by its inverse scale.
    assert two.host_s(where + shift) - shift == pytest.approx(one.host_s(where), abs=1e-6)
