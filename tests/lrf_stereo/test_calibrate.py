"""Sections IV and V with the general model on the paper's set-up: the reach, what is refused, what is doubted."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from lrf_stereo.calibrate import calibrate_lrfs
from lrf_stereo.noise import LrfNoise
from lrf_stereo.study import Method, StudySetup, accuracy, calibrated, run_study, simulate
from lrf_stereo.study_data import StudyData
from lrf_stereo.synthetic import SampleNoise, paper_scene, sample
from network_calib.errors import DegenerateError

# Errors of a run scatter by about a third of their size (ten parameters), medians over 20 of them by a tenth: a figure
# that is half of its bound is seven such deviations away.
N_RUNS = 20
N_COVERED = 60


def a_session(seed, *, noise=None, **scene):
    """A session of the paper's set-up and what was sampled."""
    rng = np.random.default_rng(seed)
    built = paper_scene(rng=rng, **scene)
    samples = sample(built, rng=rng, noise=noise)
    return StudyData.of(built, samples), samples


def joint(data, **options):
    return calibrate_lrfs(data.network, data.spots, data.settings, rng=np.random.default_rng(0), **options)


def codes(calibration):
    return [doubt.code for doubt in calibration.doubts]


def z_of(scanner):
    return scanner.world_from_lrf.rotation.as_matrix()[:, 2]


def origin_error(calibration, scene):
    """(3,) error of the LRF origin at the scanner's reference tilt."""
    found = calibration.refined.scanners[0]
    truth = scene.scanner.world_from_lrf_at(found.reference_tilt_rad)
    return found.world_from_lrf.translation - truth.translation


@cache
def study():
    return run_study((Method.PAPER, Method.JOINT), n_runs=N_RUNS, seed=4, n_spots=(6, 22))


def test_joint_reaches_half_a_pixel_and_five_millimetres_at_every_tilt():
    errors = study().of(Method.JOINT, 22)
    assert errors.n_refused == 0
    assert errors.px_by_tilt.max() <= 0.5
    assert errors.space_m_by_tilt.max() <= 5e-3


def test_joint_with_six_spots_is_below_the_paper_with_twenty_two():
    assert (study().of(Method.JOINT, 6).px_by_tilt < study().of(Method.PAPER, 22).px_by_tilt).all()


def test_five_cameras_reach_a_quarter_pixel():
    errors = run_study((Method.JOINT,), n_runs=N_RUNS, seed=4, n_spots=(22,), setup=StudySetup(n_room_cameras=3))
    assert np.median(errors.of(Method.JOINT, 22).px) <= 0.25


def test_noise_free_paper_has_its_phase_error_and_the_others_none():
    data, _ = a_session(1, noise=SampleNoise(scale=0.0))
    errors = {method: accuracy(_by(method, data), data.scene) for method in Method}
    for method in (Method.SCREW, Method.JOINT):
        assert errors[method].px.max() < 0.01
    # d = |(40, 60)| = 72.1 mm; 2 sin(|a - 12.1°| / 2) |(40, 60 - 72.1)| at 2, 12.1, 23.2, 35, 50°.
    turned = np.radians(np.abs(np.array([2, 12.1, 23.2, 35, 50]) - 12.1))
    shift = 2 * np.sin(turned / 2) * np.hypot(0.04, 0.06 - np.hypot(0.04, 0.06))
    assert errors[Method.PAPER].translation_m == pytest.approx(shift, abs=1e-9)
    # All points move by 27.1 mm, mostly across the view: f * 27.1 mm over depths of 1 to 2.6 m is 2.7 to 7 px.
    by_tilt = np.median(errors[Method.PAPER].px, axis=1)
    assert by_tilt[1] < 1e-6
    assert by_tilt[4] == pytest.approx(4.0, abs=1.0)


def _by(method, data):
    return calibrated(method, data, rng=np.random.default_rng(0))


def test_one_wrong_pair_in_five_changes_nothing():
    pixels, without = [], []
    right = 0
    for run in range(N_RUNS):
        data, samples = a_session((7, run), noise=SampleNoise(wrong_pairs=0.2))
        found = joint(data)
        right += (found.refined.is_inlier == samples.is_true).sum()
        pixels.append(accuracy(found.refined.scanners[0], data.scene).px)
        alone = joint(data.keep(samples.is_true))
        without.append(accuracy(alone.refined.scanners[0], data.scene).px)
    assert np.median(pixels) == pytest.approx(np.median(without), rel=0.05)
    # A wrong pair inside four sigma of the stereo depth may stay: up to 0.8 m of depth, but 20 mm across, so some two
    # in a hundred of the directions.
    assert right / (66 * N_RUNS) >= 0.99


@pytest.mark.parametrize(("wrong", "expected"), [(0.2, []), (0.4, ["lrf outliers"])])
def test_many_wrong_pairs_are_doubted(wrong, expected):
    # A quarter is the limit; of 66 pairs one or two wrong ones may agree by chance.
    data, _ = a_session(13, noise=SampleNoise(wrong_pairs=wrong))
    assert codes(joint(data)) == expected


def test_stated_covariance_is_that_of_the_errors():
    squared, surprises = [], []
    for run in range(N_COVERED):
        data = simulate(StudySetup(), n_spots=22, run=run, seed=5)
        found = joint(data)
        error = origin_error(found, data.scene)
        squared.append(error @ np.linalg.solve(found.covariance.scanners[0, 3:6, 3:6], error))
        surprises.append((found.refined.chi2 - found.refined.dof) / np.sqrt(2 * found.refined.dof))
        assert codes(found) == []
    # Mean of chi-square of 3 dof: 3 with variance 6 / runs; coverage: binomial; both within four deviations.
    assert np.mean(squared) == pytest.approx(3.0, abs=4 * np.sqrt(6 / N_COVERED))
    inside = np.mean(np.array(squared) < chi2.ppf(0.95, 3))
    assert inside == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / N_COVERED))
    # Unit variance, but that the bearing's uniform error has less in its tails.
    assert abs(np.mean(surprises)) < 4 / np.sqrt(N_COVERED)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("off_deg", [(0.5, 0, 0), (0, 0.5, 0), (0, 0, -0.5)])
def test_trusted_tilt_angle_that_is_wrong_by_half_a_degree_is_told(seed, off_deg):
    data, _ = a_session((8, seed))
    wrong = replace(data.settings, angle_rad=data.settings.angle_rad + np.radians(off_deg))
    found = joint(replace(data, settings=wrong))
    assert "tilt angles" in codes(found)


def test_angles_wrong_together_are_harmless_and_not_told():
    # Only differences of angle matter: the zero of the tilt is a gauge.
    data, _ = a_session(8)
    shifted = replace(data.settings, angle_rad=data.settings.angle_rad + np.radians(3.0))
    found, before = joint(replace(data, settings=shifted)), joint(data)
    assert codes(found) == []
    # The same optimum, each settled to 1e-5 sigma of 2 mm.
    difference = origin_error(found, data.scene) - origin_error(before, data.scene)
    turned = data.scene.scanner.world_from_lrf_at(np.mean(data.settings.angle_rad)).translation
    at_shifted = data.scene.scanner.world_from_lrf_at(np.mean(shifted.angle_rad)).translation
    assert difference == pytest.approx(turned - at_shifted, abs=1e-6)


def test_tilt_angles_with_a_sigma_are_estimated():
    measured, solved, squared = [], [], []
    for run in range(N_RUNS):
        noise = SampleNoise(lrf=LrfNoise(tilt_rad=np.radians(0.5)))
        data, _ = a_session((10, run), noise=noise)
        found = joint(data)
        truth = np.diff(data.scene.tilts_rad)
        measured.append(np.diff(data.settings.angle_rad) - truth)
        solved.append(np.diff(found.refined.tilt_rad) - truth)
        # The reference setting stays, so its differences are the angles' errors against it.
        error = (
            found.refined.tilt_rad[1:]
            - found.refined.tilt_rad[0]
            - (data.scene.tilts_rad[1:] - data.scene.tilts_rad[0])
        )
        squared.append(error @ np.linalg.solve(found.covariance.tilts[1:, 1:], error))
        assert codes(found) == []
    # The spots know differences to 0.05 and 0.12°, the measurement to 0.7°.
    assert np.std(solved) < np.std(measured) / 4
    assert np.mean(squared) == pytest.approx(2.0, abs=4 * np.sqrt(4 / N_RUNS))


def test_tilts_that_span_less_than_five_degrees_are_refused():
    data, _ = a_session(1, tilts_deg=(20.0, 22.0, 24.0))
    with pytest.raises(DegenerateError, match=r"span 4\.0 degrees: the tilt axis is unobservable below 5"):
        joint(data)


def test_tilts_that_span_less_than_twenty_degrees_are_doubted():
    data, _ = a_session(1, tilts_deg=(20.0, 25.0, 30.0))
    assert codes(joint(data)) == ["tilt span"]


def test_too_few_sightings_at_a_tilt_are_refused_with_the_tilt():
    data, _ = a_session(1)
    is_kept = (data.spots.setting != 1) | (np.arange(66) < 22 + 5)
    with pytest.raises(DegenerateError, match=r"tilt 23\.2° \(5\); 6 or more"):
        joint(data.keep(is_kept))


def one_sided(data, bound_m):
    return replace(data, spots=replace(data.spots, bias_bound_m=bound_m))


def test_one_sided_crossing_is_declared_and_its_sigma_carried():
    # A 40 mm ball under half a beam of 5 mrad: the bound at 1 to 3.5 m is 25 to 37 mm, the centre 18 mm below.
    data, _ = a_session(9, noise=SampleNoise(out_of_plane_bias_m=-0.018))
    found = joint(one_sided(data, 0.02 + 5e-3 * data.spots.range_m))
    assert codes(found) == ["one-sided crossing"]
    along = z_of(found.refined.scanners[0])
    sigma = np.sqrt(along @ found.covariance.scanners[0, 3:6, 3:6] @ along)
    # Between the smallest and the largest bound, over root 3; and the joint matrix says the same.
    assert 0.025 / np.sqrt(3) < sigma < 0.038 / np.sqrt(3)
    assert np.diag(found.covariance.joint)[3:6] == pytest.approx(np.diag(found.covariance.scanners[0])[3:6])
    error = origin_error(found, data.scene) @ along
    # The spots are 18 mm below the plane, so that the plane is put there; 2 mm is what the noise leaves.
    assert error == pytest.approx(-0.018, abs=4 * 0.002)
    assert abs(error) < 3 * sigma
    # No residual shows the bias, and without the declaration the stated sigma would be wrong.
    silent = joint(data)
    assert codes(silent) == []
    assert abs(error) > 5 * np.sqrt(along @ silent.covariance.scanners[0, 3:6, 3:6] @ along)


def test_two_sided_crossings_pull_the_shared_bias_down():
    data, _ = a_session(9)
    bound = np.full(66, 0.03)
    whole, half = (joint(one_sided(data, b)) for b in (bound, np.where(np.arange(66) % 2, bound, 0.0)))
    sigma = [
        np.sqrt(z_of(c.refined.scanners[0]) @ c.covariance.scanners[0, 3:6, 3:6] @ z_of(c.refined.scanners[0]))
        for c in (whole, half)
    ]
    # Half of the weight: half of 17.3 mm; the 1.5 mm of the rest adds less than a fiftieth.
    assert sigma[1] == pytest.approx(sigma[0] / 2, rel=0.05)
