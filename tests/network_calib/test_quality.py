"""Figures of quality: they say what they claim, on data whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from network_calib.quality import N_SEGMENTS, camera_qualities, chi2_per_dof, coverage, hold_out, overall_error
from network_calib.refine import refine
from network_calib.result import ErrorSummary
from network_calib.room_setup import CameraSetup
from network_calib.spots import SpotViews, reprojection_error
from tests.network_calib.scenes import SIGMA_PX, calibrated, setups_of, waved


@pytest.fixture(scope="module")
def solved():
    """The smart room with false detections: room, views, optimum."""
    scene, seen = waved("smart_room", n_frames=1200, missing=0.3, false_detections=0.1)
    views = SpotViews.of(seen.observations)
    return scene, views, refine(setups_of(scene), scene.cameras, views, rejection=4.0)


def test_a_summary_is_of_the_numbers():
    summary = ErrorSummary.of(np.array([3.0, 4.0, 0.0, 1.0]))
    assert (summary.n, summary.mean_px, summary.median_px) == (4, 2.0, 2.0)
    assert summary.rms_px == pytest.approx(np.sqrt(26 / 4))
    assert ErrorSummary.of(np.zeros(0)).n == 0
    assert np.isnan(ErrorSummary.of(np.zeros(0)).mean_px)


def test_coverage_counts_cells_of_the_image():
    setup = CameraSetup("C0", (640, 480))
    every = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).reshape(-1, 2)
    assert coverage(setup, every) == 1.0
    assert coverage(setup, every[every[:, 0] < 319.5]) == pytest.approx(0.5)
    assert coverage(setup, np.array([[-0.5, -0.5]])) == pytest.approx(1 / 48)
    # Pixels outside the image belong to no cell: neither to the other side nor to the cell next to them.
    assert coverage(setup, np.array([[-3.0, 10.0], [700.0, 10.0], [10.0, 480.0]])) == 0.0


def test_hold_out_leaves_out_whole_segments_and_the_share_asked_for(solved):
    scene, views, refined = solved
    held = hold_out(setups_of(scene), refined, views, share=0.2)
    is_held = np.zeros(views.n_points, dtype=bool)
    is_held[views.point[np.isfinite(held.error_px)]] = True
    # Short by the frames of which no two views agree: of those with two views (a third), one fifth has a false one.
    assert 0.2 * (1 - 0.1) < is_held.mean() <= 0.2 + 1 / N_SEGMENTS
    # Five runs of a 25th each: between them nothing is left out.
    segment = np.arange(views.n_points) * N_SEGMENTS // views.n_points
    shares = np.array([is_held[segment == s].mean() for s in range(N_SEGMENTS)])
    assert (shares > 0.7).sum() == 5
    assert (shares == 0).sum() == N_SEGMENTS - 5


def test_hold_out_error_is_that_of_spots_from_cameras_that_are_known(solved):
    scene, views, refined = solved
    held = hold_out(setups_of(scene), refined, views, share=0.2)
    fitted = overall_error(refined, views)
    held_error = held.error_px[np.isfinite(held.error_px)]
    # The spots of held-out frames are fitted to their own views too; only the cameras' own error comes on top, and a
    # room waved through pins it to a tenth of the noise.
    assert np.median(held_error) == pytest.approx(fitted.median_px, rel=0.1)
    # The same observations agree as in the fit, but for strays within the wider tolerance.
    is_held = (np.arange(views.n_points) * N_SEGMENTS // views.n_points % 5 == 2)[views.point]
    assert held.agreeing_share == pytest.approx(refined.is_inlier[is_held].mean(), abs=0.02)


def test_hold_out_sees_a_camera_that_moved():
    # The first half of the time camera 4 looks elsewhere by 3 degrees: no fit of the whole explains both halves.
    scene, seen = waved("smart_room", n_frames=1200)
    observations = seen.observations
    px = observations.px.copy()
    is_moved = (observations.camera == 4) & (observations.frame < 600)
    px[is_moved] += 25.0
    views = SpotViews.of(replace(observations, px=px))
    refined = refine(setups_of(scene), scene.cameras, views, rejection=4.0)
    held = hold_out(setups_of(scene), refined, views, share=0.2)
    assert held.agreeing_share < 0.95 or refined.is_inlier[views.camera == 4].mean() < 0.8


def test_no_hold_out_gives_no_figures(solved):
    scene, views, refined = solved
    held = hold_out(setups_of(scene), refined, views, share=0.0)
    assert np.isnan(held.error_px).all()
    assert np.isnan(held.agreeing_share)


def test_figures_of_each_camera_are_of_its_own_observations(solved):
    scene, views, refined = solved
    held = hold_out(setups_of(scene), refined, views, share=0.2)
    qualities = camera_qualities(setups_of(scene), refined, views, held)
    error = np.linalg.norm(reprojection_error(refined.cameras, views, refined.points), axis=1)
    for c, quality in enumerate(qualities):
        own = views.camera == c
        assert quality.n_observations == own.sum()
        assert quality.fitted.n == (own & refined.is_inlier).sum()
        assert quality.fitted.mean_px == pytest.approx(error[own & refined.is_inlier].mean())
        assert quality.holdout.n == np.isfinite(held.error_px[own]).sum()
        # Some 600 residuals of redundancy one half: 4 %, five of them.
        assert quality.noise_sigma_px == pytest.approx(SIGMA_PX, rel=0.2)
        assert 0.3 < quality.coverage <= 1.0
    assert sum(quality.fitted.n for quality in qualities) == refined.is_inlier.sum()


@pytest.mark.parametrize(("claimed_px", "expected"), [(0.2, 1.0), (0.1, 4.0), (0.4, 0.25)])
def test_chi2_tells_whether_the_detectors_sigma_is_true(claimed_px, expected):
    scene, seen = waved("ring_room", n_cameras=4, n_frames=500)
    claimed = replace(seen.observations, sigma_px=np.full(len(seen.observations), claimed_px))
    views = SpotViews.of(claimed)
    refined = refine(setups_of(scene), scene.cameras, views, rejection=4.0)
    # 2500 degrees of freedom: sqrt(2 / 2500) = 3 %; five of them.
    assert chi2_per_dof(refined, views, np.ones(len(claimed), dtype=bool)) == pytest.approx(expected, rel=0.15)


def test_chi2_of_estimated_noise_is_one(solved):
    _, views, refined = solved
    found = chi2_per_dof(refined, views, np.zeros(len(views.point), dtype=bool))
    assert found == pytest.approx(1.0, abs=0.02)


def test_figures_of_the_network_hang_together():
    _, calibration = calibrated("smart_room", n_frames=1200)
    quality = calibration.quality
    assert quality.n_inliers == quality.fitted.n == sum(camera.quality.fitted.n for camera in calibration.cameras)
    assert quality.n_observations == sum(camera.quality.n_observations for camera in calibration.cameras)
    assert 0 < quality.spot_sigma_median < quality.spot_sigma_p95
    assert np.isnan(quality.repeat_centre_spread)  # asked for no repeats
