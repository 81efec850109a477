"""The clock of a scan in the joint solve: found within its sigma where the spot moves, and told where it does not."""

from dataclasses import replace

import numpy as np
import pytest

from lrf_stereo.calibrate import calibrate_lrfs
from lrf_stereo.joint_data import LrfData
from lrf_stereo.lrf_priors import InstrumentSigma
from lrf_stereo.lrf_result import calibrated_lrfs
from lrf_stereo.refine import lrf_covariance, refine_jointly
from lrf_stereo.scanner import ScanSteps
from lrf_stereo.scanner_part import SCANNER_TANGENT, across
from lrf_stereo.session import LrfSession
from lrf_stereo.sighting_block import expected_displacement, sighting_block, spot_motion
from lrf_stereo.study_data import StudyData
from lrf_stereo.synthetic import SampleNoise, paper_scene
from lrf_stereo.synthetic_motion import Waving, sample_moving
from network_calib.robust_loss import SquaredLoss
from network_calib.spots import located

OFFSET_S, PRIOR_S = 0.03, 0.05
FREE = InstrumentSigma(clock_offset_s=PRIOR_S)
CLOCK = SCANNER_TANGENT.index("clock_offset_s")
# What is estimated: pose, axis, clock.
FREED = [*range(10), CLOCK]
N_RUNS = 30


def a_session(seed, waving, *, noise=None, **scene):
    built = paper_scene(rng=np.random.default_rng((seed, 0)), **scene)
    return StudyData.of(built, sample_moving(built, waving, rng=np.random.default_rng((seed, 1)), noise=noise))


def sample_of(seed):
    """The exact samples of five cameras."""
    built = paper_scene(rng=np.random.default_rng((seed, 0)), n_room_cameras=3)
    return sample_moving(built, Waving(), rng=np.random.default_rng((seed, 1)), noise=SampleNoise(scale=0.0))


def solved(data, instrument=FREE):
    """The joint optimum from the true scanner, whose clock is not known."""
    return refine_jointly(data.network, (data.scene.scanner,), data.spots, data.settings, instrument=instrument)


def joint(data, instrument=FREE):
    """Everything from the raw sightings."""
    return calibrate_lrfs(data.network, data.spots, data.settings, rng=np.random.default_rng(0), instrument=instrument)


def error_of(found, data, offset_s):
    """(11,) errors of what is estimated, in its tangent."""
    truth, scanner = data.scene.scanner, found.scanners[0]
    pose = truth.world_from_lrf_at(scanner.reference_tilt_rad)
    basis = across(scanner.axis_direction_in_world).T
    return np.concatenate(
        [
            (scanner.world_from_lrf.rotation * pose.rotation.inv()).as_rotvec(),
            scanner.world_from_lrf.translation - pose.translation,
            basis @ (scanner.axis_direction_in_world - truth.axis_direction_in_world),
            basis @ (scanner.axis_point_in_world - truth.axis_point_in_world),
            [scanner.clock_offset_s - offset_s],
        ]
    )


def origin_distance2(found, data):
    """Squared error of the LRF origin in the metric of its covariance: chi-square of 3."""
    error = error_of(found, data, 0.0)[3:6]
    return float(error @ np.linalg.solve(lrf_covariance(found).scanners[0, 3:6, 3:6], error))


def clock_sigma(found):
    return float(np.sqrt(lrf_covariance(found).scanners[0, CLOCK, CLOCK]))


def clock_doubts(calibration):
    return [doubt.message for doubt in calibration.doubts if doubt.code == "clock offset"]


# Found within its sigma


@pytest.mark.parametrize(("offset_s", "n_room_cameras"), [(OFFSET_S, 0), (-2 * OFFSET_S, 3)])
def test_offset_and_pose_are_as_good_as_they_say(offset_s, n_room_cameras):
    waving = Waving(clock_offset_s=offset_s)
    errors, distances, sigmas = [], [], []
    for seed in range(N_RUNS):
        data = a_session(seed, waving, n_room_cameras=n_room_cameras)
        found = solved(data)
        covariance = lrf_covariance(found).scanners[0][np.ix_(FREED, FREED)]
        error = error_of(found, data, offset_s)
        errors.append(error[-1])
        distances.append(error @ np.linalg.solve(covariance, error))
        sigmas.append(np.sqrt(covariance[-1, -1]))
    errors, sigmas = np.array(errors), np.array(sigmas)
    # Four deviations: of the RMS over the stated one, of the mean chi-square of 11, of a binomial.
    assert np.sqrt((errors**2).mean() / (sigmas**2).mean()) == pytest.approx(1, abs=4 / np.sqrt(2 * N_RUNS))
    assert np.mean(distances) == pytest.approx(11, abs=4 * np.sqrt(22 / N_RUNS))
    assert np.mean(np.abs(errors) < 1.96 * sigmas) >= 0.95 - 4 * np.sqrt(0.95 * 0.05 / N_RUNS)
    # 66 spots at 0.3 m/s on each axis, two of which count, each known to some 4 mm: 4 mm / 0.3 m/s / root(2 * 66).
    assert np.median(sigmas) == pytest.approx(4e-3 / 0.3 / np.sqrt(132), rel=0.5)


def test_stated_sigma_is_the_bound():
    waving = Waving(clock_offset_s=OFFSET_S)
    for seed in range(5):
        noisy, exact = (a_session(seed, waving, noise=SampleNoise(scale=scale)) for scale in (1.0, 0.0))
        # The same paths, the noise stated and not drawn: the information at the truth. What the noise adds to
        # velocities is a tenth of them, and squares average over 66 spots.
        assert clock_sigma(solved(noisy)) == pytest.approx(clock_sigma(solved(exact)), rel=0.05)


def test_without_noise_only_the_turning_of_the_way_is_missed():
    data = a_session(1, Waving(clock_offset_s=OFFSET_S), noise=SampleNoise(scale=0.0))
    found = solved(data)
    # A difference over +- 33 ms of a way that turns with 3 rad/s is short by (3 * 0.033)^2 / 6 = 0.17 %, and the way of
    # 47 ms at most is itself short of a straight one by (3 * 0.047)^2 / 6 = 0.33 %: 0.15 ms in all. Accelerations of
    # 0.9 m/s^2 over 30 ms are 0.4 mm, to any side, of 66 spots with two axes at 0.3 m/s: 0.12 ms.
    assert found.scanners[0].clock_offset_s == pytest.approx(OFFSET_S, abs=0.15e-3 + 4 * 0.12e-3)
    assert np.linalg.norm(error_of(found, data, OFFSET_S)[3:6]) < 1e-3


def test_from_raw_sightings_with_a_large_offset():
    data = a_session(3, Waving(clock_offset_s=0.06, speed_m_s=0.4))
    found = joint(data)
    assert abs(found.refined.scanners[0].clock_offset_s - 0.06) < 4 * clock_sigma(found.refined)
    assert origin_distance2(found.refined, data) < 20
    assert [doubt.code for doubt in found.doubts] == []


def test_cameras_that_are_solved_too_and_a_world_that_turns():
    data = a_session(2, Waving(clock_offset_s=OFFSET_S), n_room_cameras=3, n_spots_per_tilt=22)
    free = replace(data, network=replace(data.network, is_held=False))
    found = solved(free)
    sigma = clock_sigma(found)
    assert abs(found.scanners[0].clock_offset_s - OFFSET_S) < 4 * sigma
    assert 0 < sigma < 3e-3
    # The frame is the first camera's, so moving the world on the way there changes nothing but roundings: the cost
    # settles to 1e-10 of a thousand, the offset to 1e-3 of its sigma.
    again = solved(free)
    assert again.scanners[0].clock_offset_s == found.scanners[0].clock_offset_s


# What is lost without it


def test_an_offset_that_is_ignored_goes_into_the_pose():
    drift = np.array([0.0, 0.25, 0.1])
    waving = Waving(clock_offset_s=OFFSET_S, drift_m_s=tuple(drift), speed_m_s=0.2)
    held, ignored, freed = [], [], []
    for seed in range(5):
        data = a_session(seed, waving)
        wrong, right = solved(data, InstrumentSigma()), solved(data)
        held.append(error_of(wrong, data, 0.0)[3:6])
        freed.append(origin_distance2(right, data))
        ignored.append(origin_distance2(wrong, data))
        assert wrong.chi2 / wrong.dof > 1.3
    # What all spots have in common is 30 ms of the drift, the other way; the noise of the mean is 2 mm / root 5 on each
    # axis, and the random motion leaves 0.2 m/s * 30 ms / root(5 * 66) = 0.3 mm.
    assert np.mean(held, axis=0) == pytest.approx(-OFFSET_S * drift, abs=4e-3)
    # Chi-square of 3, mean of 5: 3 with a deviation of root(6 / 5).
    assert np.mean(freed) < 3 + 4 * np.sqrt(6 / 5) < np.mean(ignored)


def test_beams_own_times_within_the_sweep_count():
    waving = Waving(speed_m_s=0.3, drift_m_s=(0.0, 0.25, 0.1))
    given, ignored, offsets = [], [], []
    for seed in range(5):
        data = a_session(seed, waving)
        in_sweep_s = ScanSteps().beam_time_s(data.spots.bearing_rad)
        by_scan = replace(data, spots=replace(data.spots, delay_s=data.spots.delay_s - in_sweep_s))
        given.append(np.linalg.norm(error_of(solved(data, InstrumentSigma()), data, 0.0)[3:6]))
        ignored.append(np.linalg.norm(error_of(solved(by_scan, InstrumentSigma()), data, 0.0)[3:6]))
        found = solved(by_scan)
        offsets.append(found.scanners[0].clock_offset_s - in_sweep_s.mean())
        # Bearings within +- 1 rad are 8 ms either side: 3 mm, which a free clock cannot take up.
        assert clock_sigma(found) < 2.5e-3
    # 37 ms of the drift are 10 mm; the sightings leave 3 mm.
    assert np.median(ignored) > 2 * np.median(given)
    # A free clock takes the mean; five of them, each to 1.4 ms and what 8 ms of spread leave of 66.
    assert np.mean(offsets) == pytest.approx(0, abs=4 * np.hypot(1.4e-3, 8e-3 / np.sqrt(66)) / np.sqrt(5))


# Told where the motion does not


def test_a_spot_that_rests_leaves_the_prior_and_says_so():
    found = joint(a_session(4, Waving(clock_offset_s=OFFSET_S, speed_m_s=0.0)))
    assert clock_sigma(found.refined) > 0.7 * PRIOR_S
    (message,) = clock_doubts(found)
    assert message.startswith("LRF 0: the spot moves too slowly or always the same way")


def test_a_spot_that_always_goes_the_same_way_says_so_and_the_pose_carries_it():
    drift = np.array([0.0, 0.3, 0.0])
    found = joint(a_session(4, Waving(clock_offset_s=OFFSET_S, speed_m_s=0.0, drift_m_s=tuple(drift))))
    assert "always the same way" in clock_doubts(found)[0]
    assert clock_sigma(found.refined) > 0.7 * PRIOR_S
    # An offset of 50 ms is a shift of 15 mm along the way: the scanner would stand that much further on.
    spread = found.covariance.scanners[0]
    assert np.sqrt(spread[4, 4]) == pytest.approx(0.3 * np.sqrt(spread[CLOCK, CLOCK]), rel=0.1)
    assert spread[4, CLOCK] / np.sqrt(spread[4, 4] * spread[CLOCK, CLOCK]) > 0.95


def without_stamps(data):
    views = data.network.views
    return replace(
        data,
        network=replace(data.network, views=replace(views, observations=replace(views.observations, stamp_ns=None))),
    )


def test_frames_without_times_say_so_and_the_frame_period_helps():
    data = without_stamps(a_session(4, Waving(clock_offset_s=OFFSET_S)))
    blind = joint(data)
    assert clock_sigma(blind.refined) == pytest.approx(PRIOR_S, rel=1e-9)
    (message,) = clock_doubts(blind)
    assert "0 of 66 sightings have located spots within 0.15 s" in message
    seeing = joint(replace(data, network=replace(data.network, frame_period_s=1 / 30)))
    assert clock_doubts(seeing) == []
    assert abs(seeing.refined.scanners[0].clock_offset_s - OFFSET_S) < 4 * clock_sigma(seeing.refined)


def test_delays_of_unknown_motion_are_told_though_the_clock_is_held():
    data = without_stamps(a_session(4, Waving()))
    (message,) = clock_doubts(joint(data, InstrumentSigma()))
    assert "its beams are up to 17 ms off the frames" in message
    assert clock_doubts(joint(a_session(4, Waving()), InstrumentSigma())) == []


# The block of sightings


def block_of(data, instrument, scanner=None):
    lrf = LrfData.of(data.spots, data.settings, data.network.views, instrument)
    rows = np.flatnonzero((lrf.point >= 0) & located(data.network.points)[lrf.point])
    return rows, lrf, sighting_block(
        data.network, (scanner or data.scene.scanner,), lrf, rows,
        tilt_rad=data.settings.angle_rad, point=lrf.point[rows],
        columns=np.full((len(data.settings.angle_rad), 16), -1), loss=SquaredLoss(),
    )  # fmt: skip


def test_sightings_of_the_cameras_instants_are_whitened_by_their_sigma_alone():
    data = a_session(4, Waving())
    data = replace(data, spots=replace(data.spots, delay_s=np.zeros(66)))
    rows, lrf, block = block_of(data, InstrumentSigma())
    assert not block.velocity.any()
    assert np.array_equal(block.whitening, np.eye(3)[:, :, None] * (1 / lrf.sigma[:, rows]))


def test_uncertain_motion_adds_to_the_sightings_covariance():
    data = without_stamps(a_session(4, Waving()))
    scanner = replace(data.scene.scanner, clock_offset_s=0.02)
    rows, lrf, block = block_of(data, FREE, scanner)
    assert not block.velocity.any()
    # A hand's 0.3 m/s and 1.5 m/s^2 on each axis, over the delay, the offset, and the offset's own sigma.
    span_s = np.hypot(data.spots.delay_s[rows] + 0.02, PRIOR_S)
    moved2 = (0.3 * span_s) ** 2 + (1.5 * span_s**2 / 2) ** 2
    for k, row in enumerate(rows.tolist()):
        point, tilt = data.network.points[data.network.views.frames == data.spots.frame[row]][0], lrf.spots.setting[row]
        slope = np.stack(
            [
                (np.stack(scanner.measure(point + step, data.settings.angle_rad[tilt]))
                 - np.stack(scanner.measure(point - step, data.settings.angle_rad[tilt]))).ravel() / 2e-5
                for step in 1e-5 * np.eye(3)
            ],
            axis=1,
        )  # fmt: skip
        expected = slope @ slope.T * moved2[k] + np.diag(lrf.sigma[:, row] ** 2)
        whitened = block.whitening[:, :, k] @ expected @ block.whitening[:, :, k].T
        assert whitened == pytest.approx(np.eye(3), abs=1e-6)


def test_what_is_known_before_a_solve_brings_the_spot_to_the_beam():
    data = a_session(4, Waving(), noise=SampleNoise(scale=0.0), n_room_cameras=3)
    rows, lrf, _ = block_of(data, FREE)
    shift, spread = expected_displacement(data.network, lrf)
    off = data.network.points[lrf.point[rows]] + shift[rows] - sample_of(4).spots_in_world[rows]
    # Within 17 ms a way with 0.9 m/s^2 on an axis leaves a straight one by 0.13 mm, at most four times that.
    assert np.abs(off).max() < 5e-4
    assert np.abs(shift).max() > 4e-3
    # The clock's prior sigma goes along the way: 50 ms of the velocity.
    velocity = spot_motion(data.network, lrf).velocity_m_s
    along = np.einsum("mi,mij,mj->m", velocity, spread, velocity) / (velocity**2).sum(axis=1) ** 2
    assert np.sqrt(along) == pytest.approx(PRIOR_S, rel=0.2)


def test_each_scanner_is_judged_by_its_own_sightings():
    data = a_session(4, Waving())
    settings = replace(data.settings, scanner=np.array([0, 0, 1]))
    both = LrfData.of(data.spots, settings, data.network.views, (InstrumentSigma(), FREE))
    assert both.sigma_clock_s.tolist() == [0.0] * 44 + [PRIOR_S] * 22
    motion = spot_motion(data.network, both)
    for scanner, rows in ((0, np.arange(44)), (1, np.arange(44, 66))):
        is_own = np.isin(np.arange(66), rows)
        own = LrfData.of(data.spots.select(is_own), data.settings, data.network.views, FREE)
        alone = spot_motion(data.network, own)
        assert np.array_equal(motion.velocity_m_s[rows], alone.velocity_m_s), scanner
        assert np.array_equal(motion.spread_m_s[rows], alone.spread_m_s)
    assert motion.spread_m_s[0] != motion.spread_m_s[-1]


def test_velocity_in_the_lrf_frame_is_that_of_the_world():
    data = a_session(4, Waving(), noise=SampleNoise(scale=0.0, sigma_px=1e-3))
    rows, _, block = block_of(data, FREE)
    tilts = data.settings.angle_rad[data.spots.setting[rows]]
    for k, row in enumerate(rows[:10].tolist()):
        turn = data.scene.scanner.world_from_lrf_at(tilts[k]).rotation
        views = data.network.views
        frames = data.spots.frame[row] + np.array([-1, 1])
        before, after = (data.network.points[views.frames == frame][0] for frame in frames)
        assert turn.apply(block.velocity[:, k]) == pytest.approx((after - before) * 15, abs=1e-3)


def test_result_states_clock_sigma_and_residuals_at_the_beams_time():
    data = a_session(5, Waving(clock_offset_s=0.05))
    session = LrfSession(("L0",), data.spots, data.settings, FREE)
    found = joint(data)
    (lrf,) = calibrated_lrfs(session, data.network, found)
    assert lrf.instrument[4] == found.refined.scanners[0].clock_offset_s
    assert lrf.sigma[CLOCK] == pytest.approx(clock_sigma(found.refined), rel=1e-12)
    assert "clock_offset_s" not in lrf.held
    # Sigmas of 4 mm, and of the same size what the spot absorbs; 50 ms of 0.3 m/s would be 15 mm.
    assert lrf.out_of_plane_rms_m < 6e-3
    on_time = a_session(5, Waving())
    held = replace(session, spots=on_time.spots, instrument=InstrumentSigma())
    (trusted,) = calibrated_lrfs(held, on_time.network, joint(on_time, InstrumentSigma()))
    assert "clock_offset_s" in trusted.held
    assert trusted.sigma[CLOCK] == 0
