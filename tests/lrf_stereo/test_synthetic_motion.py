"""The waved spot is what it says: where the beam meets it at the beam's time, on the clocks as they are stated."""

import numpy as np
import pytest

from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import SampleNoise, paper_scene
from lrf_stereo.synthetic_motion import Waving, sample_moving
from network_calib.spots import SpotViews, locate, located

WAVING = Waving(clock_offset_s=0.013, turn_rate_rad_s=2.0)
EXACT = SampleNoise(scale=0.0)


@pytest.fixture(scope="module")
def scene():
    return paper_scene(rng=np.random.default_rng(1), n_room_cameras=3)


@pytest.fixture(scope="module")
def samples(scene):
    return sample_moving(scene, WAVING, rng=np.random.default_rng(2), noise=EXACT)


def track_of(scene, samples, k):
    """Times and exact positions of the frames around a sighting, counted from the true time of its beam."""
    views = SpotViews.of(samples.observations)
    points, _ = locate(scene.cameras, views, np.full(len(views.camera), 0.1))
    near = np.flatnonzero((np.abs(views.frames - samples.spots.frame[k]) <= 3) & located(points))
    beam_s = samples.spots.frame[k] / WAVING.frame_rate_hz + samples.spots.delay_s[k] + WAVING.clock_offset_s
    return views.frames[near] / WAVING.frame_rate_hz - beam_s, points[near]


def test_the_spot_is_in_the_plane_when_the_beam_meets_it(scene, samples):
    for k in (0, 30, 65):
        since_s, points = track_of(scene, samples, k)
        assert len(since_s) >= 6
        # Along ellipses at 2 rad/s, within 0.15 s: a polynomial of order 4 misses (2 * 0.15)^5 / 120 of 0.3 m.
        found = np.array([np.polyfit(since_s, axis, 4)[-1] for axis in points.T])
        np.testing.assert_allclose(found, samples.spots_in_world[k], atol=3e-5)
        range_m, bearing, height_m = scene.scanner.measure(found[None], scene.tilts_rad[scene.spot_tilt[k]])
        assert samples.spots.range_m[k] == pytest.approx(range_m[0], abs=3e-5)
        assert samples.spots.bearing_rad[k] == pytest.approx(bearing[0], abs=3e-5)
        assert height_m[0] == pytest.approx(0, abs=3e-5)


def test_the_frame_is_the_nearest_by_the_stated_clock(samples):
    assert np.abs(samples.spots.delay_s).max() <= 0.5 / WAVING.frame_rate_hz + 1e-9
    # Beams and frames have nothing to do with each other: delays are uniform, with a sd of 9.6 ms.
    assert np.std(samples.spots.delay_s) == pytest.approx(1 / 30 / np.sqrt(12), rel=4 * np.sqrt(0.2 / 66))


def test_stamps_are_those_of_the_frames(samples):
    seen = samples.observations
    np.testing.assert_allclose(seen.stamp_ns, seen.frame * (1e9 / 30), atol=0.5)


def test_the_beam_that_tells_the_time_is_rounded_to_a_step(scene):
    steps = ScanSteps()
    exact, rounded = (
        sample_moving(scene, WAVING, rng=np.random.default_rng(2), noise=SampleNoise(scale=scale))
        for scale in (0.0, 1.0)
    )
    # Half a step of 97.66 us.
    difference = rounded.spots.delay_s - exact.spots.delay_s
    assert 1e-5 < np.abs(difference).max() <= 0.5 * steps.turn_s / steps.steps_per_turn + 1e-12


def test_same_seed_same_samples(scene):
    one, other = (sample_moving(scene, WAVING, rng=np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(one.observations.px, other.observations.px)
    assert np.array_equal(one.spots.delay_s, other.spots.delay_s)


def test_speed_and_drift(scene):
    resting = Waving(speed_m_s=0.0, drift_m_s=(0.0, 0.2, 0.0), clock_offset_s=0.0)
    samples = sample_moving(scene, resting, rng=np.random.default_rng(2), noise=EXACT)
    since_s, points = track_of(scene, samples, 10)
    # At the middle the velocity is the drift; within 0.1 s a turn at 3 rad/s leaves 0.955 of it at least.
    velocity = np.diff(points, axis=0) / np.diff(since_s)[:, None]
    assert np.abs(velocity[:, [0, 2]]).max() < 1e-6
    assert (velocity[:, 1] <= 0.2 + 1e-6).all()
    assert (velocity[:, 1] > 0.19).all()
