"""Section IV on the paper's set-up: exact data, real noise, wrong pairs, refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lrf_stereo.paper import PlaneSamples, calibrate_paper, calibrate_screw
from network_calib.errors import ConvergenceError, DegenerateError, InputError
from tests.lrf_stereo.stereo_scene import (
    CHECKED_TILTS,
    FOCAL_PX,
    TILTS,
    Noise,
    errors_at,
    plane_samples,
    project,
    scanner,
    spots_in_plane,
)

N_RUNS = 30


@pytest.fixture
def rng():
    return np.random.default_rng(20)


def test_noise_free_paper_method_shows_its_phase_error_in_pixels(rng):
    truth = scanner(0.04, 0.06)
    found = calibrate_paper(plane_samples(truth, 22, rng), rng=rng).scanner
    assert errors_at(found, truth, TILTS[0], rng)[0] < 1e-8
    reach, bearing, points = spots_in_plane(truth, TILTS[2], 200, rng)
    pixels = np.linalg.norm(project(found.points_in_world(reach, bearing, TILTS[2])) - project(points), axis=1)
    # All points move by one vector: 2 sin(37.9 deg / 2) |(40, 60 - 72.1) mm| = 27.1 mm along a known direction.
    shift = found.world_from_lrf_at(TILTS[2]).translation - truth.world_from_lrf_at(TILTS[2]).translation
    assert np.linalg.norm(shift) == pytest.approx(0.02714, abs=5e-6)
    across = shift[:2] - points[:, :2] / points[:, 2:] * shift[2]
    # First order in shift / depth, at most 27 mm / 0.7 m = 4 %.
    assert pixels == pytest.approx(FOCAL_PX * np.linalg.norm(across, axis=1) / points[:, 2], rel=0.04)
    # The review's 4.0 px is for its own camera pose. A direction of the shift 20 degrees nearer to the view or farther
    # away changes it by up to a fifth, and depths by as much.
    assert np.median(pixels) == pytest.approx(4.0, abs=1.0)


@pytest.mark.parametrize("mount", [{}, {"mount_roll_rad": 0.0175, "mount_yaw_rad": 0.0175}])
def test_noise_free_screw_method_is_exact(rng, mount):
    truth = scanner(0.04, 0.06, **mount)
    found = calibrate_screw(plane_samples(truth, 22, rng), rng=rng)
    assert max(errors_at(found.scanner, truth, tilt, rng)[0] for tilt in CHECKED_TILTS) < 1e-8
    form = found.scanner.as_paper()
    assert [form.dx_m, form.dz_m] == pytest.approx([0.04, 0.06], abs=1e-11)
    assert found.is_inlier.all()
    assert found.rms_m == pytest.approx([0, 0, 0], abs=1e-12)


def test_a_mount_misalignment_of_one_degree_harms_the_paper_method(rng):
    # Without dx the paper is exact but for the mount: one degree of roll and yaw turns the axis by
    # 2 sin(37.9 deg / 2) * hypot(1, 1) degrees = 16 mrad at 50 degrees, 4.2 px at the image's centre, more beside it.
    truth = scanner(0.0, 0.07, mount_roll_rad=0.0175, mount_yaw_rad=0.0175)
    samples = plane_samples(truth, 22, rng)
    found = calibrate_paper(samples, rng=rng).scanner
    turn = found.world_from_lrf_at(TILTS[2]).rotation * truth.world_from_lrf_at(TILTS[2]).rotation.inv()
    assert turn.magnitude() == pytest.approx(2 * np.sin(np.deg2rad(37.9) / 2) * 0.0175 * 2**0.5, rel=0.03)
    assert errors_at(found, truth, TILTS[2], rng)[0] > 2


@cache
def medians(method, *, n, wrong=0.0):
    """Median over runs of the pixel error at each checked tilt."""
    truth, runs = scanner(), []
    for seed in range(N_RUNS):
        rng = np.random.default_rng(seed)
        samples = plane_samples(truth, n, rng, noise=Noise(), wrong=wrong)
        found = method(samples, rng=rng).scanner
        runs.append([errors_at(found, truth, tilt, rng)[0] for tilt in CHECKED_TILTS])
    return np.median(runs, axis=0)


def unweighted_screw(samples, *, rng):
    return calibrate_screw(replace(samples, noise=None), rng=rng)


def test_with_real_noise_the_weighted_screw_beats_the_paper_several_times():
    paper, plain, weighted = (medians(m, n=22) for m in (calibrate_paper, unweighted_screw, calibrate_screw))
    # The review's 2.6, 1.8, 2.1, 3.0, 4.5 px were those of another camera pose and of 150 runs. A median of 30 runs of
    # a Rayleigh-like error has an sd of 13 %; the worst tilt is dominated by the phase error of 3.6 px.
    assert 2.5 < paper.max() < 7
    assert (paper[[0, 3, 4]] > 1.2).all()
    # The joint solve's 0.35, 0.22, 0.17, 0.17, 0.26 px are the bound; the two-step solution may lose three times that.
    assert (weighted < 3 * np.array([0.35, 0.22, 0.17, 0.17, 0.26])).all()
    assert (3 * weighted < plain).all()
    assert (2 * weighted < paper).all()


def test_a_fifth_of_wrong_pairs_costs_no_more_than_their_number():
    clean, dirty = medians(calibrate_screw, n=22), medians(calibrate_screw, n=22, wrong=0.2)
    # Four of 22 pairs lost: sqrt(22 / 18) = 1.11; and two medians of 30 runs of sd 13 % each, twice.
    assert (dirty < clean * (1.11 + 2 * 0.13 * 2**0.5)).all()


def test_wrong_pairs_are_marked(rng):
    truth = scanner()
    samples = plane_samples(truth, 22, rng, noise=Noise(), wrong=0.2)
    found = calibrate_screw(samples, rng=rng)
    tilt = samples.tilt_rad[samples.setting]
    error = np.linalg.norm(
        samples.spot_in_cam - truth.points_in_world(samples.range_m, samples.bearing_rad, tilt), axis=1
    )
    # An honest pair errs by the depth noise, 0.2 m at most at 3.5 m, one sigma; wrong ones by their random place.
    assert not found.is_inlier[error > 1.0].any()
    assert (error > 1.0).sum() > 3
    assert found.is_inlier.mean() > 0.75


def test_same_seed_same_calibration(rng):
    samples = plane_samples(scanner(), 30, rng, noise=Noise(), wrong=0.1)
    for method in (calibrate_paper, calibrate_screw):
        first, second = (method(samples, rng=np.random.default_rng(5)) for _ in range(2))
        poses = [found.scanner.world_from_lrf_at(TILTS).as_matrix() for found in (first, second)]
        assert (poses[0] == poses[1]).all()


def test_more_tilts_than_three_serve_the_screw_and_not_the_paper(rng):
    tilts = np.deg2rad([12.0, 20.0, 30.0, 45.0])
    truth = scanner()
    samples = plane_samples(truth, 12, rng, tilts=tilts)
    found = calibrate_screw(samples, rng=rng)
    assert max(errors_at(found.scanner, truth, tilt, rng)[0] for tilt in CHECKED_TILTS) < 1e-8
    with pytest.raises(InputError, match="exactly 3 tilts, got 4"):
        calibrate_paper(samples, rng=rng)


def test_tilts_too_close_are_refused_with_the_reason(rng):
    tilts = np.deg2rad([10.0, 12.0, 14.0])
    with pytest.raises(DegenerateError, match=r"span 4\.0 degrees"):
        calibrate_screw(plane_samples(scanner(), 22, rng, tilts=tilts), rng=rng)


def test_refusals_name_the_tilt(rng):
    samples = plane_samples(scanner(), 22, rng)

    def at_last_tilt(keep):
        return select(samples, (samples.setting < 2) | keep)

    with pytest.raises(DegenerateError, match=r"tilt setting 2 \(50\.0 degrees, 2 spots\).* got 2"):
        calibrate_paper(at_last_tilt(np.arange(66) >= 64), rng=rng)
    with pytest.raises(DegenerateError, match=r"tilt setting 2 .*0 spots"):
        calibrate_screw(at_last_tilt(np.zeros(66, dtype=bool)), rng=rng)
    on_line = replace(samples, bearing_rad=np.where(samples.setting == 1, 0.1, samples.bearing_rad))
    exact = scanner().points_in_world(on_line.range_m, on_line.bearing_rad, TILTS[on_line.setting])
    with pytest.raises(DegenerateError, match=r"tilt setting 1 .*on one line"):
        calibrate_screw(replace(on_line, spot_in_cam=exact), rng=rng)
    shuffled = replace(
        samples, range_m=np.where(samples.setting == 0, rng.permutation(samples.range_m), samples.range_m)
    )
    with pytest.raises(ConvergenceError, match=r"tilt setting 0 \(12\.1 degrees, 22 spots\): no rigid motion"):
        calibrate_paper(shuffled, rng=rng, threshold_m=0.02)


def select(samples, rows):
    return PlaneSamples(
        samples.spot_in_cam[rows], samples.range_m[rows], samples.bearing_rad[rows], samples.setting[rows],
        samples.tilt_rad,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"range_m": np.ones(65)}, r"different lengths: \[65, 66\]"),
        ({"range_m": np.full(66, np.nan)}, "not finite"),
        ({"setting": np.full(66, 3)}, r"settings 3\.\.3 of 3 tilts"),
    ],
)
def test_unusable_columns_are_refused(rng, change, reason):
    with pytest.raises(InputError, match=reason):
        replace(plane_samples(scanner(), 22, rng), **change)
