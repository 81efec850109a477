"""Cameras and an LRF in one result, against the truth of a simulated room of five cameras."""

from dataclasses import replace

import numpy as np
import pytest

from lrf_stereo.joint_problem import LrfData
from lrf_stereo.lrf_priors import InstrumentSigma
from lrf_stereo.lrf_result import paper_numbers, paper_sigma
from lrf_stereo.network import add_lrfs, calibrate_with_lrfs
from lrf_stereo.range_scale import in_scale_of_ranges, scale_by_ranges, start_of_joint_solve
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.scanner_part import N_SCANNER, ScannerPart
from lrf_stereo.session import LrfSession
from lrf_stereo.study_data import StudyData
from lrf_stereo.synthetic import SampleNoise, paper_scene, sample
from network_calib.calibrate import calibrate
from network_calib.errors import DegenerateError, InputError
from network_calib.room_setup import CameraSetup, Knowledge, KnownDistance, Options
from network_calib.spots import SpotViews

ONCE = Options(n_repeats=1)
# A vector of three parameters beyond this Mahalanobis distance is chance once in 10^5 (chi-square of 3, 26 = 5.1^2).
MAX_SIGMA = 5.1


@pytest.fixture(scope="module")
def scene():
    """Five cameras, three tilts; the spots of the scan planes alone span the room."""
    return paper_scene(rng=np.random.default_rng(4), n_spots_per_tilt=60, n_room_cameras=3, mount_deg=(1.0, -0.5))


@pytest.fixture(scope="module")
def samples(scene):
    return sample(scene, rng=np.random.default_rng(5), noise=SampleNoise(wrong_pairs=0.1))


@pytest.fixture(scope="module")
def session(samples):
    return LrfSession(("L0",), samples.spots, samples.settings)


@pytest.fixture(scope="module")
def setups(scene):
    cameras = scene.cameras
    return [
        CameraSetup(name, (int(size[0]), int(size[1])), lens, Knowledge.FIXED, row)
        for name, size, lens, row in zip(
            cameras.names, cameras.size_px, cameras.lenses, cameras.intrinsics, strict=True
        )
    ]


@pytest.fixture(scope="module")
def baseline():
    return KnownDistance("C0", "C1", 0.09, is_stereo_pair=True)


@pytest.fixture(scope="module")
def calibrated(samples, setups, session, baseline):
    return calibrate_with_lrfs(samples.observations, setups, session, anchor=baseline, options=ONCE)


@pytest.fixture(scope="module")
def by_ranges(samples, setups, session):
    return calibrate_with_lrfs(samples.observations, setups, session, options=ONCE)


@pytest.fixture(scope="module")
def cameras_alone(samples, setups, baseline):
    return calibrate(samples.observations, setups, anchor=baseline, options=ONCE)


def scanner_of(lrf):
    return TiltingScanner(
        lrf.world_from_lrf, lrf.axis_direction_in_world, lrf.axis_point_in_world, lrf.reference_tilt_rad
    )


def pose_errors_in_sigma(lrf, scene):
    """Turn and shift at the reference tilt, as Mahalanobis distances; the angles count from the first setting."""
    true = scene.scanner.world_from_lrf_at(scene.tilts_rad[0] + lrf.reference_tilt_rad - lrf.tilt_rad[0])
    turn = (lrf.world_from_lrf.rotation * true.rotation.inv()).as_rotvec()
    shift = lrf.world_from_lrf.translation - true.translation
    return [
        float(np.sqrt(error @ np.linalg.solve(lrf.covariance[at, at], error)))
        for error, at in ((turn, slice(0, 3)), (shift, slice(3, 6)))
    ]


@pytest.mark.parametrize("name", ["calibrated", "by_ranges"])
def test_lrf_is_as_near_to_the_truth_as_its_sigma_says(name, scene, request):
    (lrf,) = request.getfixturevalue(name).lrfs
    assert max(pose_errors_in_sigma(lrf, scene)) < MAX_SIGMA
    found = np.array([lrf.dx_m, lrf.dz_m, lrf.mount_roll_rad, lrf.mount_yaw_rad])
    assert (np.abs(found - paper_numbers(scene.scanner)) < MAX_SIGMA * lrf.paper_sigma).all()
    # The mirror's offset from 120 good sightings: some millimetres (1.5 to 2.6 with 66), so neither absurd nor zero.
    assert (lrf.paper_sigma[:2] > 1e-4).all()
    assert (lrf.paper_sigma[:2] < 5e-3).all()


@pytest.mark.parametrize("name", ["calibrated", "by_ranges"])
def test_cameras_are_in_the_frame_of_the_first_and_within_their_sigma(name, scene, request):
    calibration = request.getfixturevalue(name)
    # C0 is the frame by definition: what remains is rounding of a few products.
    np.testing.assert_allclose(calibration.cameras[0].cam_from_world.as_matrix(), np.eye(4), atol=1e-12)
    for camera, centre in zip(calibration.cameras[1:], scene.cameras.centres_in_world[1:], strict=True):
        error = camera.centre_in_world - centre
        # C1 is on a sphere of 90 mm about C0: 1 mm across bends away by 1^2 / (2 * 90) mm, beyond any covariance.
        bent = (6e-6) ** 2 * np.eye(3)
        assert error @ np.linalg.solve(camera.covariance[3:6, 3:6] + bent, error) < MAX_SIGMA**2


def test_wrong_pairs_are_left_out(calibrated, samples):
    (lrf,) = calibrated.lrfs
    assert lrf.n_sightings == len(samples.spots)
    # A wrong pair lies 0.1 to 0.8 m off, beyond 20 sigma of the range; at 4 sigma one honest one in 10^4 goes.
    assert abs(lrf.n_inliers - samples.is_true.sum()) <= 1


def test_scale_source_names_what_told_metres(calibrated, by_ranges, cameras_alone):
    assert calibrated.world.scale_source.startswith("baseline C0-C1 = 0.09 m, and the ranges of L0")
    assert by_ranges.world.scale_source.startswith("the ranges of L0")
    assert by_ranges.world.unit == calibrated.world.unit == "m"
    assert cameras_alone.lrfs == ()


def test_spot_sigma_is_that_of_the_joint_solve(calibrated, cameras_alone):
    # The same gauge and the same exact baseline: every spot has a range beside its pixels, which can only tell more.
    joint, alone = calibrated.quality, cameras_alone.quality
    assert joint.spot_sigma_median < 0.9 * alone.spot_sigma_median
    assert joint.spot_sigma_p95 < alone.spot_sigma_p95
    # Hold-out and repeats are those of the cameras alone.
    assert joint.holdout == alone.holdout


def test_ranges_outweigh_a_vague_baseline(samples, setups, session, scene):
    # Given 3 % too long, and known to be that vague: the ranges (0.1 %) outweigh it.
    vague = KnownDistance("C0", "C1", 0.0927, sigma_m=0.003, is_stereo_pair=True)
    calibration = calibrate_with_lrfs(samples.observations, setups, session, anchor=vague, options=ONCE)
    # Errors of 0.09 m that a 3 % too long baseline would leave in these distances of some 5 m, against a hundredth.
    found = np.linalg.norm(np.array([camera.centre_in_world for camera in calibration.cameras[2:4]]), axis=1)
    true = np.linalg.norm(scene.cameras.centres_in_world[2:4], axis=1)
    np.testing.assert_allclose(found, true, rtol=0.01)


def test_held_cameras_stay_and_get_the_lrf(cameras_alone, samples, session, scene):
    calibration = add_lrfs(cameras_alone, samples.observations, session)
    for before, after in zip(cameras_alone.cameras, calibration.cameras, strict=True):
        assert before is after
    (lrf,) = calibration.lrfs
    assert "cameras" in lrf.held
    # 3 cm of the cameras' own scale error come on top of sigma: 5 sigma of that.
    true = scene.scanner.world_from_lrf_at(scene.tilts_rad[0] + lrf.reference_tilt_rad - lrf.tilt_rad[0])
    assert np.linalg.norm(lrf.world_from_lrf.translation - true.translation) < 0.03
    again = add_lrfs(calibration, samples.observations, session)
    assert [each.name for each in again.lrfs] == ["L0"]


def test_cameras_without_metres_are_refused(cameras_alone, samples, session):
    unscaled = replace(cameras_alone, world=replace(cameras_alone.world, unit="unit"))
    with pytest.raises(InputError, match="no metric scale"):
        add_lrfs(unscaled, samples.observations, session)


def test_freed_instrument_is_not_held_and_has_a_sigma(samples, setups, session, baseline):
    freed = replace(session, instrument=InstrumentSigma(range_bias_m=0.02))
    (lrf,) = calibrate_with_lrfs(samples.observations, setups, freed, anchor=baseline, options=ONCE).lrfs
    assert lrf.held == ("tilt_gain", "range_scale", "bearing_zero_rad", "clock_offset_s", "tilt_angles")
    # The data say more than the prior, and the true bias is zero.
    assert 0 < lrf.sigma[11] < 0.02
    assert abs(lrf.instrument[1]) < MAX_SIGMA * lrf.sigma[11]


@pytest.mark.parametrize("scale", [0.05, 1.0, 30.0])
def test_scale_by_ranges_survives_wrong_pairs(samples, scale):
    views = SpotViews.of(samples.observations)
    data = LrfData.of(samples.spots, samples.settings, views, InstrumentSigma())
    # Exact spots in another unit; a tenth of the pairs is wrong, so a fifth of the distances.
    points = samples.spots_in_world[views.frames] / scale
    # Noise of 6 mm on the distances' ends, over a median of more than 0.6 m, averaged over more than 1000 of them.
    assert scale_by_ranges(points, data) == pytest.approx(scale, rel=0.003)


@pytest.mark.parametrize(("sigma_m", "is_stiff"), [(0.0, True), (0.0001, True), (0.003, False)])
def test_joint_solve_begins_in_the_scale_of_a_certain_anchor(sigma_m, is_stiff, scene, samples):
    # Metres of the cameras 3 % long, of a baseline of 90 mm that may give way by five of its sigma.
    data = StudyData.of(scene, samples)
    centres = scene.cameras.centres_in_world
    longer = scene.cameras.with_poses(scene.cameras.rotations, 1.03 * centres)
    baseline = KnownDistance("C0", "C1", 0.0927, sigma_m)
    network = replace(data.network, cameras=longer, points=1.03 * data.network.points, is_held=False, baseline=baseline)
    registered, back = in_scale_of_ranges(network, LrfData.of(samples.spots, samples.settings, network.views))
    # The stereo pair's depth noise included: as `scale_by_ranges` promises.
    np.testing.assert_allclose(registered.cameras.centres_in_world, centres, rtol=0.01, atol=1e-9)
    start, (scanner,) = start_of_joint_solve(network, registered, (scene.scanner,), back)
    if not is_stiff:
        assert start is registered
        assert scanner is scene.scanner
        return
    assert start is network
    assert scanner.range_scale == 1
    true = scene.scanner.world_from_lrf.translation
    np.testing.assert_allclose(scanner.world_from_lrf.translation, 1.03 * true, rtol=0.01)
    np.testing.assert_allclose(scanner.axis_point_in_world, 1.03 * scene.scanner.axis_point_in_world, rtol=0.01)
    # There and back again.
    there = back.apply(registered.cameras.centres_in_world)
    np.testing.assert_allclose(there, network.cameras.centres_in_world, rtol=1e-12, atol=1e-12)


def test_held_cameras_keep_their_scale(scene, samples):
    network = StudyData.of(scene, samples).network
    data = LrfData.of(samples.spots, samples.settings, network.views)
    registered, back = in_scale_of_ranges(network, data)
    assert registered is network
    assert back.scale == 1


def test_scale_without_distances_is_refused(samples):
    views = SpotViews.of(samples.observations)
    data = LrfData.of(samples.spots, samples.settings, views, InstrumentSigma())
    with pytest.raises(DegenerateError, match="no metric scale: 0 distances"):
        scale_by_ranges(np.full((views.n_points, 3), np.nan), data)


def test_paper_sigma_is_the_spread_of_the_paper_numbers(scene):
    # Independent sigmas of 1e-4 in turns and metres; 1000 draws give a standard deviation to 2.2 %.
    rng = np.random.default_rng(8)
    covariance = np.zeros((N_SCANNER, N_SCANNER))
    covariance[:10, :10] = 1e-8 * np.eye(10)
    draws = [paper_numbers(moved(scene.scanner, 1e-4 * rng.standard_normal(10))) for _ in range(1000)]
    np.testing.assert_allclose(paper_sigma(scene.scanner, covariance), np.std(draws, axis=0), rtol=0.1)


def moved(scanner, step):
    part = ScannerPart.from_scanners((scanner,), np.arange(N_SCANNER)[None])
    return part.retract(np.append(step, np.zeros(N_SCANNER - 10))).apply_to((scanner,))[0]


def spots_at(frame, setting):
    n = len(frame)
    one = np.ones(n)
    return LrfSpots(np.array(frame), np.array(setting), one, one, 0 * one, one, one, one)


@pytest.mark.parametrize(
    ("names", "scanner", "frame", "setting", "message"),
    [
        ((), [0], [1], [0], "expected one or more"),
        (("L0", "L0"), [0, 1], [1], [0], "each once"),
        (("L0", "L1"), [0, 0], [1], [0], "2 LRFs need tilt settings each"),
        (("L0",), [0], [1], [1], r"tilt settings 1\.\.1 of 1"),
        (("L0",), [0], [7, 7], [0, 0], "'L0' has two sightings in frame 7"),
    ],
)
def test_session_that_does_not_fit_together_is_refused(names, scanner, frame, setting, message):
    n = len(scanner)
    settings = TiltSettings(np.array(scanner, dtype=int), np.array([0.0, 0.3][:n]), np.zeros((n, n)))
    with pytest.raises(InputError, match=message):
        LrfSession(names, spots_at(frame, setting), settings)
