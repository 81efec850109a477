"""A device's clock from arrivals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.clock_fit import Bounds, ClockFit, fit_clock
from nodes.devices.clock_posterior import ClockPrior

DRIFT = 1300e-6


def even(rng, n):
    return rng.uniform(0, 0.1, n)


def falling(rng, n):
    return np.minimum(rng.exponential(0.02, n), 0.1)


def errors(delays, *, duration_s, n_runs=300):
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
    # Not Gaussian; a fourth moment of 9 bounds what is seen, so an RMS of 300 runs is known to sqrt((9 - 1) / 300) / 2
    # = 8 %. Two and a half of those.
    assert np.sqrt((error**2).mean() / (sigma**2).mean()) == pytest.approx(1.0, abs=0.2)
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


def told(rng, *, duration_s, n_bounds, latency_s=0.1021, delays=even):
    """Arrivals cut to 1 ms, and answers of the second before them, bounded to a few ms; true gain drawn."""
    gain = 1 + rng.normal(0, 2e-3)
    host = rng.uniform(0, 1e-3) + np.arange(0.0, duration_s, 0.1)
    asked = np.sort(rng.uniform(-1.5, -0.5, n_bounds))
    cut = np.floor(np.concatenate([asked, host]) * gain * 1e3) / 1e3
    before, after = rng.uniform(0, 4e-3, (2, n_bounds))
    heard = asked + delays(rng, n_bounds)
    bounds = np.column_stack([cut[:n_bounds], asked - before, asked + after, heard])
    return np.column_stack([cut[n_bounds:], host + latency_s + delays(rng, len(host))]), bounds, host[-1]


@pytest.mark.parametrize("delays", [even, falling])
@pytest.mark.parametrize("duration_s", [1.0, 10.0, 60.0])
def test_answers_bound_the_line_and_its_sigma_is_true(delays, duration_s):
    rng, error, sigma = np.random.default_rng(6), [], []
    for _ in range(200):
        arrivals, bounds, true = told(rng, duration_s=duration_s, n_bounds=8, delays=delays)
        line = fit_clock(arrivals, bounds=bounds, prior=ClockPrior(1.0, 2e-3, 0.1, 0.03, 1e-3))
        error.append(line.host_s(arrivals[-1, 0] + 5e-4) - true)
        sigma.append(np.hypot(line.sigma_s(arrivals[-1, 0]), 1e-3 / np.sqrt(12)))
    # The bounds hold 2.5 ms (uniform: 0.8 ms RMS); the drift of 2000 ppm may add that much in the second since.
    assert np.sqrt(np.mean(np.square(error))) < (4e-3 if duration_s > 1.0 else 3e-3)
    # As above: an RMS of 200 runs is known to 10 %; two of those.
    assert np.sqrt(np.mean(np.square(error)) / np.mean(np.square(sigma))) == pytest.approx(1.0, abs=0.2)


def test_latency_is_learnt_from_answers_and_kept_when_they_are_forgotten():
    rng, fit = np.random.default_rng(2), ClockFit(latency_s=0.1, latency_sigma_s=0.03, window_s=20.0, resolution_s=1e-3)
    arrivals, bounds, _ = told(rng, duration_s=60.0, n_bounds=8, delays=lambda rng, n: rng.exponential(1e-3, n))
    for row in bounds:
        fit.bound(Bounds(*row))
    for device_s, arrival_s in arrivals:
        fit.add(device_s, arrival_s)
    line = fit.line()
    assert line.latency_sigma_s < 1.5e-3
    # Four sigma, of which the bounds' own width is the most.
    assert line.latency_s == pytest.approx(0.1021, abs=4 * line.latency_sigma_s)
    assert line.host_s(arrivals[-1, 0]) == pytest.approx(arrivals[-1, 1] - 0.1021, abs=8e-3)


def test_bounds_that_contradict_one_another_are_left_out():
    rng = np.random.default_rng(1)
    arrivals, bounds, true = told(rng, duration_s=10.0, n_bounds=8, delays=falling)
    bounds[3, 1:] += 0.5
    line = fit_clock(arrivals, bounds=bounds, prior=ClockPrior(1.0, 2e-3, 0.1021, 1e-3, 1e-3))
    # As of arrivals alone: a sigma of 1 ms from the latency, and 1 ms from a hundred delays of 20 ms.
    assert line.host_s(arrivals[-1, 0]) == pytest.approx(true, abs=6e-3)


def test_answers_alone_tell_the_time():
    _, bounds, _ = told(np.random.default_rng(3), duration_s=10.0, n_bounds=8)
    line = fit_clock(np.empty((0, 2)), bounds=bounds)
    middle = len(bounds) // 2
    assert bounds[middle, 1] - 1e-3 <= line.host_s(bounds[middle, 0]) <= bounds[middle, 2]


def test_answers_a_minute_apart_leave_a_sliver_of_drifts_that_is_found():
    rng, gain = np.random.default_rng(5), 1 + 1300e-6
    asked = np.concatenate([rng.uniform(0, 1, 8), rng.uniform(60, 61, 8)])
    bounds = np.column_stack([asked * gain, asked - 1e-3, asked + 1e-3, asked + even(rng, 16)])
    arrived = np.arange(0.0, 61.0, 0.1)
    arrivals = np.column_stack([arrived * gain, arrived + 0.1 + even(rng, len(arrived))])
    line = fit_clock(arrivals, bounds=bounds, prior=ClockPrior(1.0, 2e-3, 0.1, 0.015))
    # Bounds of 1 ms at either end hold whatever is between.
    assert line.host_s(30 * gain) == pytest.approx(30, abs=1e-3)
    assert line.sigma_s(30 * gain) < 1e-3
