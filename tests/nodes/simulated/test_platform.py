"""The shared physics of the emulated instruments."""

import math

import numpy as np
import pytest

from lrf_stereo.scan_spot import Background, find_spots, ranges_m
from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import paper_scene
from lrf_stereo.tilt import gravity_tilts, gyro_turns
from nodes.simulated.platform import SimulatedPlatform, Waving
from nodes.simulated.tilt_unit_device import AxisModel, TiltUnitDevice

STEP_RAD = math.radians(185.1428 / 3600)


@pytest.fixture
def unit():
    device = TiltUnitDevice(tilt=AxisModel(-1200, 604), is_echoing=False)
    device.connect(0.0)
    return device


@pytest.fixture
def platform(unit):
    scene = paper_scene(rng=np.random.default_rng(0), n_spots_per_tilt=1)
    return SimulatedPlatform(scene, unit, seed=3)


def tilt_to(unit, degrees, now_s):
    unit.receive(f"TP{-round(math.radians(degrees) / STEP_RAD)} ".encode(), now_s)


def test_the_unit_turns_scanner_and_imu_alike(unit, platform):
    tilt_to(unit, 23.2, 1.0)
    stamp_s = np.arange(0.0, 10.0, 0.01)
    rate, force = (np.array(part) for part in zip(*(platform.motion(t) for t in stamp_s), strict=True))
    setting = np.where(stamp_s < 0.9, 0, np.where(stamp_s > 4.0, 1, -1))
    turns = gyro_turns(stamp_s, rate[:, 1], setting)
    true = platform.tilt_rad(9.0)
    assert true == pytest.approx(math.radians(23.2), abs=STEP_RAD / 2)
    # The trapezoid's speed is piecewise linear: sums of 10 ms are exact but for the intervals with a corner.
    assert turns.turn_rad[0] == pytest.approx(true, abs=4 * 0.5 * 2000 * STEP_RAD * 0.01**2)
    assert gravity_tilts(force, stamp_s, setting).angle_rad == pytest.approx([0.0, true], abs=1e-9)


def test_the_person_stays_away_while_the_unit_moves_and_the_background_is_learnt(unit, platform):
    tilt_to(unit, 23.2, 0.0)
    assert platform.spot_in_world(19.0) is not None
    tilt_to(unit, 12.1, 20.0)
    assert all(platform.spot_in_world(t) is None for t in (20.1, 20.5, 21.0, 24.0))
    assert platform.spot_in_world(30.0) is not None
    assert np.isnan(platform.detections_px(21.0)).all()


def test_the_spot_crosses_the_plane_up_and_down_at_places_that_the_pair_sees(unit, platform):
    tilt_to(unit, 12.1, 0.0)
    time_s = np.arange(8.0, 48.0, 0.02)
    spots = np.array([platform.spot_in_world(t) for t in time_s])
    range_m, _, height = platform.scene.scanner.measure(spots, platform.tilt_rad(20.0))
    crossings = np.flatnonzero(np.diff(np.sign(height)) != 0)
    # Two crossings in each period of 8 s, one each way, slow enough to be hit by several scans of 0.1 s.
    assert len(crossings) == 10
    assert np.sign(np.diff(height)[crossings]).sum() == 0
    assert np.abs(np.diff(height) / 0.02).max() < 0.1 * 1.2
    assert ((range_m > 0.9) & (range_m < 3.7)).all()
    seen = np.array([platform.detections_px(t, sigma_px=0.0) for t in time_s[crossings]])
    assert np.isfinite(seen[:, :2]).all()


def test_scans_show_the_spot_where_it_is(unit, platform):
    tilt_to(unit, 12.1, 0.0)
    steps = ScanSteps()
    empty = np.array([platform.scan_at(t) for t in np.arange(1.0, 4.0, 0.1)])
    background = Background.learn(ranges_m(empty, steps=steps))
    # A quarter of the period after the person came, who came 5 s after the move of 235 steps ended.
    crossing_s = 2 * math.sqrt(235 / 2000) + 5.0 + 2.0
    scan = ranges_m(platform.scan_at(crossing_s - 0.0375)[None], steps=steps)
    spots = find_spots(scan, background, steps=steps)
    range_m, bearing, _ = platform.scene.scanner.measure(
        platform.spot_in_world(crossing_s)[None], platform.tilt_rad(crossing_s)
    )
    off_m = np.hypot(spots.range_m - range_m, range_m * (spots.bearing_rad - bearing))
    # The ball's surface and one beam's noise, a step of the bearing, 10 mm of motion.
    assert off_m.min() < 0.03


def test_everything_depends_on_seed_and_time_alone(unit, platform):
    tilt_to(unit, 12.1, 0.0)
    late = platform.scan_at(9.0)
    early = platform.scan_at(8.0)
    again = SimulatedPlatform(platform.scene, unit, seed=3)
    np.testing.assert_array_equal(again.scan_at(8.0), early)
    np.testing.assert_array_equal(again.scan_at(9.0), late)
    other = SimulatedPlatform(platform.scene, unit, seed=4)
    assert (other.scan_at(8.0) != early).any()


def test_a_faster_hand_is_an_option(unit):
    scene = paper_scene(rng=np.random.default_rng(0), n_spots_per_tilt=1)
    fast = SimulatedPlatform(scene, unit, seed=3, waving=Waving(period_s=2.0, away_s=1.0))
    tilt_to(unit, 12.1, 0.0)
    assert fast.spot_in_world(2.0) is not None
