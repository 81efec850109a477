"""The acquisition on the emulated platform: scanner, tilt unit and IMU speak their real protocols in virtual time."""

from dataclasses import replace

import numpy as np
import pytest

from lrf_stereo.crossing import Crossings
from network_calib.errors import InputError
from nodes.devices.errors import LineLostError
from nodes.devices.tilt_unit import TiltUnit
from nodes.lrf.acquisition import Acquisition, AcquisitionOptions, Phase, _is_short, plane_sigma_m
from nodes.lrf.recorder import NullRecorder
from nodes.lrf_node import LrfDevices, LrfNode
from nodes.simulated.line_faults import LineFaults
from tests.nodes.emulated_platform import emulated

TILTS_DEG = (12.1, 35.0)
OPTIONS = AcquisitionOptions(tuple(np.radians(TILTS_DEG)), n_crossings=4, sigma_m=0.02)


class Notes(NullRecorder):
    def __init__(self):
        self.scans, self.samples, self.events, self.tilts = [], [], [], []

    def scan(self, scan):
        self.scans.append(scan)

    def imu(self, sample):
        self.samples.append(sample)

    def tilt(self, now_s, tilt_rad, steps):
        self.tilts.append((now_s, tilt_rad, steps))

    def event(self, now_s, text):
        del now_s
        self.events.append(text)


def acquire(platform, options=OPTIONS):
    notes = Notes()
    node = LrfNode(platform.devices, options, recorder=notes, clock=platform.clock, sleep=platform.clock.sleep)
    progress = []
    acquired = node.run(progress.append)
    return acquired, notes, progress


def normalised_errors(platform, acquired):
    """(n, 3) errors of range, bearing and height of all crossings over their sigmas; gross ones are other things."""
    rows = []
    for setting in acquired.settings:
        found = setting.crossings
        for k in range(len(found)):
            spot = platform.room.spot_in_world(float(found.time_s[k]))
            if spot is None:
                continue
            tilt_rad = platform.room.tilt_rad(float(found.time_s[k]))
            range_m, bearing, height = platform.room.scene.scanner.measure(spot[None], tilt_rad)
            rows.append(
                (
                    (found.range_m[k] - range_m[0]) / found.sigma_range_m[k],
                    (found.bearing_rad[k] - bearing[0]) / found.sigma_bearing_rad[k],
                    height[0] / found.sigma_out_of_plane_m[k],
                )
            )
    return np.array(rows)


@pytest.fixture(scope="module")
def whole():
    platform = emulated()
    return platform, *acquire(platform)


def test_all_tilts_are_acquired_unattended(whole):
    platform, acquired, notes, progress = whole
    assert len(acquired.settings) == 2
    assert all(len(setting.crossings) >= 4 for setting in acquired.settings)
    phases = ["moving", "resting", "background", "collecting"]
    assert notes.events == [*phases, *phases, "done"]
    assert {step.phase for step in progress} == set(Phase)
    assert [steps for _, _, steps in notes.tilts] == [-235, -681]
    assert acquired.n_reopened == 0
    del platform


def test_most_crossings_are_the_spots_and_their_sigmas_are_true(whole):
    platform, acquired, _, _ = whole
    errors = normalised_errors(platform, acquired)
    is_spot = (np.abs(errors) < 6).all(axis=1)
    # What else is in the plane is left to the solve, which bears 20 % of it; here half must be the spot to start from.
    assert is_spot.mean() > 0.5
    # About ten crossings: the mean square of each kind is 1 within a factor, not by a factor.
    assert np.sqrt((errors[is_spot] ** 2).mean(axis=0)).max() < 2.5


def test_tilt_angles_are_true_within_their_sigma(whole):
    platform, acquired, _, _ = whole
    tilts = acquired.tilts.tilts
    true = [platform.room.tilt_rad((setting.rest_begin_s + setting.rest_end_s) / 2) for setting in acquired.settings]
    difference = np.diff(tilts.angle_rad) - np.diff(true)
    sigma = np.sqrt(np.array([-1, 1]) @ tilts.covariance_rad2 @ np.array([-1, 1]))
    assert acquired.tilts.sources == ("steps", "gravity", "gyroscope")
    assert acquired.tilts.notes == ()
    # The unit resolves 0.0514 deg: two roundings make 0.021 deg.
    assert sigma < np.radians(0.022)
    assert abs(difference[0]) < 4 * sigma


def test_every_scan_and_sample_is_recorded(whole):
    _, acquired, notes, _ = whole
    assert len(notes.scans) == acquired.scan_counts.scans
    assert acquired.scan_counts.missed == acquired.scan_counts.refused == 0
    assert np.diff([scan.sequence for scan in notes.scans]).tolist() == [1] * (len(notes.scans) - 1)
    assert np.diff([sample.sequence for sample in notes.samples]).tolist() == [1] * (len(notes.samples) - 1)


def test_gyroscope_and_gravity_alone_give_the_angles_too():
    platform = emulated(seed=2)
    devices = LrfDevices(platform.devices.scanner, ByHand(platform.devices.tilt), platform.devices.imu)
    notes = Notes()
    acquired = LrfNode(devices, OPTIONS, recorder=notes, clock=platform.clock, sleep=platform.clock.sleep).run()
    assert acquired.tilts.sources == ("gravity", "gyroscope")
    true = [platform.room.tilt_rad((setting.rest_begin_s + setting.rest_end_s) / 2) for setting in acquired.settings]
    error = np.diff(acquired.tilts.tilts.angle_rad)[0] - np.diff(true)[0]
    covariance = acquired.tilts.tilts.covariance_rad2
    sigma = np.sqrt(np.array([-1, 1]) @ covariance @ np.array([-1, 1]))
    assert sigma < np.radians(0.3)
    assert abs(error) < 4 * sigma


class ByHand:
    """A tilt drive that moves but counts nothing."""

    def __init__(self, unit):
        self.unit = unit

    def go_to(self, tilt_rad, *, meanwhile=None):
        self.unit.go_to(tilt_rad, meanwhile=meanwhile)

    def steps(self):
        return None


def test_lost_steps_are_found_out_and_the_imu_believed():
    platform = emulated(seed=3)
    unit = platform.devices.tilt
    assert isinstance(unit, TiltUnit)

    class SlippingUnit(TiltUnit):
        def __init__(self):
            self.options, self._info = unit.options, unit.info

        def go_to(self, tilt_rad, *, meanwhile=None):
            steps = unit.go_to(tilt_rad, meanwhile=meanwhile)
            if tilt_rad > 0.5:
                platform.tilt_device._slipped = 40  # two degrees
            return steps

    devices = LrfDevices(platform.devices.scanner, SlippingUnit(), platform.devices.imu)
    acquired = LrfNode(devices, OPTIONS, clock=platform.clock, sleep=platform.clock.sleep).run()
    assert acquired.tilts.sources == ("gravity", "gyroscope")
    assert "lost steps" in acquired.tilts.notes[0]


def test_unplugged_scanner_is_waited_for_and_the_acquisition_ends_well():
    faults = LineFaults(np.random.default_rng(0), unplugs=[(20.0, 4.0)])
    platform = emulated(faults=faults)
    acquired, notes, _ = acquire(platform)
    assert acquired.n_reopened == 1
    assert acquired.scan_counts.missed >= 35
    assert "the scanner is back" in notes.events
    is_spot = (np.abs(normalised_errors(platform, acquired)) < 6).all(axis=1)
    assert is_spot.mean() > 0.5


def test_a_loss_is_final_where_nothing_opens_the_line_again():
    platform = emulated(faults=LineFaults(np.random.default_rng(0), unplugs=[(20.0, 4.0)]))
    devices = LrfDevices(platform.devices.scanner, platform.devices.tilt, platform.devices.imu)
    with pytest.raises(LineLostError):
        LrfNode(devices, OPTIONS, clock=platform.clock, sleep=platform.clock.sleep).run()


def test_without_tilt_unit_and_imu_nothing_tells_the_angles():
    platform = emulated()
    devices = LrfDevices(platform.devices.scanner, ByHand(platform.devices.tilt), emulated(has_imu=False).devices.imu)
    with pytest.raises(InputError, match="nothing tells the tilt angles"):
        LrfNode(devices, OPTIONS, clock=platform.clock, sleep=platform.clock.sleep).run()


def test_an_operator_may_say_that_it_is_enough_but_not_before_there_is_anything():
    platform = emulated()
    acquisition = Acquisition(OPTIONS, steps=platform.devices.scanner.info.steps)
    with pytest.raises(InputError, match="nothing to finish while moving"):
        acquisition.finish_setting(0.0)


@pytest.mark.parametrize("options", [{"tilts_rad": ()}, {"tilts_rad": (0.1,), "n_crossings": 0}])
def test_bad_options_are_refused(options):
    with pytest.raises(InputError):
        AcquisitionOptions(**options)


def made_crossings(range_m, bearing_rad):
    n = len(range_m)
    ones, none = np.ones(n), np.zeros(n)
    return Crossings(
        time_s=none, begin_s=none, end_s=none, n_scans=np.full(n, 4), range_m=np.array(range_m),
        bearing_rad=np.array(bearing_rad), sigma_range_m=0.003 * ones, sigma_bearing_rad=0.002 * ones,
        sigma_out_of_plane_m=0.004 * ones, bias_bound_m=none, direction=np.ones(n, dtype=np.int64),
        pair=np.arange(n), score=ones,
    )  # fmt: skip


def test_a_run_that_lasts_too_long_takes_its_pair_with_it():
    found = replace(
        made_crossings([1.0] * 8, [0.0] * 8),
        n_scans=np.array([3, 4, 4, 3, 4, 20, 4, 8]),
        pair=np.array([0, 0, 1, 1, 2, 2, 3, 3]),
    )
    assert _is_short(found).tolist() == [True] * 4 + [False] * 2 + [True] * 2
    assert _is_short(made_crossings([], [])).tolist() == []


def test_plane_sigma_against_simulated_fits():
    rng = np.random.default_rng(0)
    range_m, bearing = rng.uniform(1.0, 3.0, 8), rng.uniform(-0.8, 0.8, 8)
    stated = plane_sigma_m(made_crossings(range_m, bearing))
    points = np.column_stack([range_m * np.cos(bearing), range_m * np.sin(bearing)])
    # Heights alone: z = a + b x + c y, fitted to points with 4 mm; nothing else of the pose moves a point out of plane.
    design = np.column_stack([np.ones(8), points])
    fits = np.linalg.lstsq(design, 0.004 * rng.standard_normal((8, 4000)), rcond=None)[0]
    worst = (design @ fits).std(axis=1).max()
    # 4000 draws: 1.1 % of a standard deviation, four of those.
    assert stated == pytest.approx(worst, rel=0.05)


def test_plane_sigma_falls_as_the_root_of_the_number_and_is_infinite_where_nothing_is_held():
    range_m, bearing = [1.0, 2.0, 3.0, 2.0], [0.5, -0.5, 0.2, 0.0]
    one = plane_sigma_m(made_crossings(range_m, bearing))
    four = plane_sigma_m(made_crossings(range_m * 4, bearing * 4))
    assert four == pytest.approx(one / 2)
    assert plane_sigma_m(made_crossings([1.0, 2.0], [0.0, 0.1])) == np.inf
    assert plane_sigma_m(made_crossings([1.0, 2.0, 3.0, 4.0], [0.3] * 4)) == np.inf
