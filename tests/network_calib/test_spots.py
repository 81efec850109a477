"""Spots: numbering of frames, robust positions, and residuals in units of their own standard deviation."""

from dataclasses import replace

import numpy as np
import pytest

from network_calib.observations import Observations
from network_calib.spots import (
    SpotViews,
    drop_lonely,
    locate,
    normalised_error,
    reprojection_error,
    spot_leverage,
)
from tests.network_calib.scenes import SIGMA_PX, waved

TOLERANCE_PX = 4 * SIGMA_PX


def at_the_truth(name="smart_room", **numbers):
    """True cameras, views, and the exact inlier mask in the views' order."""
    scene, seen = waved(name, **numbers)
    views = SpotViews.of(seen.observations)
    is_kept = np.isin(seen.observations.frame, views.frames)
    return scene, views, seen.is_usable[is_kept]


def test_frames_with_one_view_are_left_out_and_the_rest_numbered():
    observations = Observations.from_columns(
        ("A", "B"),
        camera=[0, 1, 0, 0, 1],
        frame=[7, 7, 8, 90, 90],
        px=np.arange(10).reshape(5, 2),
        sigma_px=[0.5, np.nan, 1, 2, 3],
    )
    views = SpotViews.of(observations)
    np.testing.assert_array_equal(views.frames, [7, 90])
    np.testing.assert_array_equal(views.point, [0, 0, 1, 1])
    np.testing.assert_array_equal(views.sigma_px, [0.5, 1.0, 2.0, 3.0])
    assert (views.n_points, views.n_cameras) == (2, 2)


def test_selected_points_keep_their_frames():
    _, views, _ = at_the_truth(n_frames=200, missing=0.4)
    is_kept = np.random.default_rng(0).random(views.n_points) < 0.5
    part = views.select_points(is_kept)
    np.testing.assert_array_equal(part.frames, views.frames[is_kept])
    np.testing.assert_array_equal(part.frames[part.point], part.observations.frame)
    assert len(np.unique(part.point)) == part.n_points


def test_located_spots_are_where_they_were():
    scene, views, _ = at_the_truth(n_frames=400)
    points, is_inlier = locate(scene.cameras, views, np.full(len(views.point), TOLERANCE_PX))
    error_m = np.linalg.norm(points - scene.trajectory[views.frames], axis=1)
    # 0.2 px at 450 px and 3 m is 1.3 mm across the ray; along it the stereo pair alone is ten times worse.
    assert np.nanmedian(error_m) < 0.003
    # Of 2D Gaussian errors exp(-16 / 2) = 0.03 % lie beyond four sigma, and a spot takes its worst view along.
    assert is_inlier.mean() > 0.995


def test_false_views_are_told_from_true_ones():
    scene, views, is_usable = at_the_truth(missing=0.3, false_detections=0.1)
    points, is_inlier = locate(scene.cameras, views, np.full(len(views.point), TOLERANCE_PX))
    # Chance: a stray pixel within a band of 1.6 px around one of the other views' epipolar lines, where no third view
    # contradicts it.
    assert (is_inlier == is_usable).mean() > 0.985
    n_agreeing = np.bincount(views.point[is_inlier], minlength=views.n_points)
    assert (n_agreeing[np.isfinite(points).all(axis=1)] >= 2).all()
    assert np.isnan(points[n_agreeing < 2]).all()


def test_a_spot_without_two_agreeing_views_has_no_position():
    _, views, _ = at_the_truth(n_frames=60)
    is_inlier = np.ones(len(views.point), dtype=bool)
    is_inlier[np.flatnonzero(views.point == 5)[1:]] = False
    points, kept = drop_lonely(views, np.ones((views.n_points, 3)), is_inlier)
    assert np.isnan(points[5]).all()
    assert not kept[views.point == 5].any()
    assert kept[views.point != 5].all()
    assert np.isfinite(np.delete(points, 5, axis=0)).all()


def test_error_is_predicted_minus_detected_and_infinite_behind():
    scene, views, _ = at_the_truth(n_frames=60)
    points = scene.trajectory[views.frames]
    px, _ = scene.cameras.img_from_world(views.camera, points[views.point])
    np.testing.assert_allclose(reprojection_error(scene.cameras, views, points), px - views.px)
    points = points.copy()
    points[3] = [3.0, -50.0, 1.4]
    error = reprojection_error(scene.cameras, views, points)
    assert np.isinf(error[(views.point == 3) & (views.camera <= 1)]).all()  # the stereo pair looks the other way


def fitted(scene, views):
    is_inlier = np.ones(len(views.point), dtype=bool)
    points, _ = locate(scene.cameras, views, np.full(len(views.point), 50.0))
    return points, is_inlier


def test_leverage_is_the_share_of_noise_that_the_spot_absorbs():
    scene, views, _ = at_the_truth(n_frames=300)
    points, is_inlier = fitted(scene, views)
    leverage = spot_leverage(scene.cameras, views, points, is_inlier, np.full(len(views.point), SIGMA_PX))
    trace = np.bincount(views.point, np.trace(leverage, axis1=1, axis2=2))
    # A least-squares projection onto three coordinates has trace three, whatever the geometry.
    np.testing.assert_allclose(trace, 3.0, rtol=1e-6)


@pytest.mark.parametrize("is_in", [True, False])
def test_normalised_errors_of_honest_views_are_of_unit_size(is_in):
    # In or out of its spot, an honest observation must get the same verdict.
    scene, views, _ = at_the_truth(n_frames=1000)
    enough = np.bincount(views.point)[views.point] >= 3
    is_inlier = np.ones(len(views.point), dtype=bool)
    rows = np.flatnonzero(enough & (views.camera == 3))
    is_inlier[rows] = is_in
    kept = views.observations.select(is_inlier)
    part = SpotViews.of(kept)
    located, _ = locate(scene.cameras, part, np.full(len(part.point), 50.0))
    points = np.full((views.n_points, 3), np.nan)
    points[np.searchsorted(views.frames, part.frames)] = located
    sigma_px = np.full(len(views.point), SIGMA_PX)
    error = normalised_error(scene.cameras, views, points, is_inlier, sigma_px)[rows]
    # Squared norms of n unit Gaussians in 2D: mean 2, standard deviation of the mean 2 / sqrt(n); five of them.
    assert (error**2).mean() == pytest.approx(2.0, abs=5 * 2 / np.sqrt(len(rows)))


def test_an_unlocated_spot_is_infinitely_wrong():
    scene, views, _ = at_the_truth(n_frames=60)
    points = scene.trajectory[views.frames].copy()
    points[4] = np.nan
    is_inlier = views.point != 4
    error = normalised_error(scene.cameras, views, points, is_inlier, np.full(len(views.point), SIGMA_PX))
    assert np.isinf(error[views.point == 4]).all()
    assert np.isfinite(error[views.point != 4]).all()


def test_the_detectors_own_sigma_weighs_a_view():
    scene, views, _ = at_the_truth(n_frames=60)
    points = scene.trajectory[views.frames]
    is_inlier = np.zeros(len(views.point), dtype=bool)  # nothing fitted: errors are plain quotients
    one = normalised_error(scene.cameras, views, points, is_inlier, np.full(len(views.point), 1.0))
    two = normalised_error(scene.cameras, replace(views), points, is_inlier, np.full(len(views.point), 2.0))
    np.testing.assert_allclose(one, 2 * two, rtol=1e-5)
