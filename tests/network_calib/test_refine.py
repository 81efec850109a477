"""Outlier rounds: the exact inlier mask, the noise of each camera, one optimum whatever the start."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from network_calib.errors import ConvergenceError
from network_calib.observations import Observations
from network_calib.optimum import optimise, started_cameras
from network_calib.refine import refine
from network_calib.room_setup import Options, UnitScale
from network_calib.spots import SpotViews
from network_calib.start import Start
from network_calib.synthetic import compare
from network_calib.uncertainty import uncertainty
from network_calib.world import in_world
from tests.network_calib.scenes import SIGMA_PX, setups_of, waved


def solved(name, *, start="auto", **numbers):
    """The room, the views, the exact inlier mask in their order, and the optimum."""
    scene, seen = waved(name, **numbers)
    views = SpotViews.of(seen.observations)
    network = optimise(setups_of(scene), views, anchor=UnitScale(), options=Options(start=start), seed=0)
    return scene, views, seen.is_usable[seen.observations.n_views() >= 2], network.refined


@pytest.mark.parametrize("seed", range(3))
def test_inlier_mask_is_exact_with_gaps_and_false_detections(seed):
    _, views, is_usable, refined = solved("smart_room", seed=seed, missing=0.3, false_detections=0.1)
    assert len(is_usable) == len(views.point)
    # What may differ: 0.03 % of the honest beyond 4 sigma, and strays that chance puts on the epipolar line of the only
    # other view, some 1.6 px of 480 in the 20 % of frames with two views.
    assert (refined.is_inlier == is_usable).mean() >= 0.995
    assert refined.is_inlier[is_usable].mean() > 0.995


@pytest.mark.parametrize("seed", range(3))
def test_outliers_cost_no_accuracy(seed):
    scene, seen = waved("smart_room", seed=seed, missing=0.3, false_detections=0.1)
    _, _, _, dirty = solved("smart_room", seed=seed, missing=0.3, false_detections=0.1)
    views = SpotViews.of(seen.observations.select(seen.is_usable))
    clean = refine(setups_of(scene), dirty.cameras, views, rejection=20.0)
    anchor, options = UnitScale(), Options()
    _, posed = in_world(clean, views, anchor, options)
    sigma = np.sqrt(np.diagonal(uncertainty(posed, setups_of(scene), views, anchor).cameras, 0, 1, 2))
    shift = np.abs(dirty.cameras.intrinsics[:, 0] - clean.cameras.intrinsics[:, 0])
    # The same but for 0.5 % of the observations: these move a parameter by some sqrt(0.005) = 0.07 of its sigma.
    assert (shift < 0.3 * sigma[:, 6]).all()


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_each_camera_is_estimated(seed):
    scene, seen = waved("ring_room", n_cameras=5, n_frames=800, seed=seed)
    # Each camera with a noise of its own: 0.2 px as drawn, more added to three of them.
    rng = np.random.default_rng(seed)
    extra = np.array([0.0, 0.3, 0.0, 0.6, 0.15])
    observations = seen.observations
    px = observations.px + extra[observations.camera, None] * rng.standard_normal(observations.px.shape)
    views = SpotViews.of(replace(observations, px=px))
    refined = refine(setups_of(scene), scene.cameras, views, rejection=4.0)
    true_noise = np.hypot(SIGMA_PX, extra)
    # About half of a camera's 1600 residuals are its redundancy, so a sigma is known to 1 / sqrt(2 * 800) = 2.5 %;
    # five of these. Rejection at four sigma takes 0.15 % of the squares away.
    np.testing.assert_allclose(refined.noise, true_noise, rtol=0.125)


def test_noise_is_a_factor_on_the_detectors_sigma():
    scene, seen = waved("ring_room", n_cameras=4, n_frames=400)
    with_sigma = replace(seen.observations, sigma_px=np.full(len(seen.observations), 0.1))
    refined = refine(setups_of(scene), scene.cameras, SpotViews.of(with_sigma), rejection=4.0)
    # Twice what the detector claims; 800 residuals of redundancy 300 give 4 %, five of them.
    np.testing.assert_allclose(refined.noise, 2.0, rtol=0.2)


def test_squared_errors_fit_the_noise():
    _, views, _, refined = solved("ring_room", n_frames=600, missing=0.3, false_detections=0.1)
    rows = np.flatnonzero(refined.is_inlier)
    dof = 2 * len(rows) - 3 * len(np.unique(views.point[rows])) - refined.state.n_shared + 7
    px, _ = refined.cameras.img_from_world(views.camera[rows], refined.points[views.point[rows]])
    squares = (((px - views.px[rows]) / SIGMA_PX) ** 2).sum()
    low, high = chi2.ppf([5e-4, 1 - 5e-4], dof)
    # The true noise, not the estimated one. Rejection at four sigma lowers the sum by 0.3 %.
    assert 0.995 * low < squares < high


@pytest.mark.parametrize("name", ["ring_room", "smart_room"])
def test_both_starts_reach_the_same_optimum(name):
    anchor, options = UnitScale(), Options()
    scene, views, _, first = solved(name, start="factorisation", n_frames=800, missing=0.3, false_detections=0.1)
    _, _, _, second = solved(name, start="anchor", n_frames=800, missing=0.3, false_detections=0.1)
    assert (first.is_inlier == second.is_inlier).mean() > 0.999
    _, a = in_world(first, views, anchor, options)
    _, b = in_world(second, views, anchor, options)
    sigma = np.sqrt(np.diagonal(uncertainty(a, setups_of(scene), views, anchor).cameras, 0, 1, 2))
    offset = np.abs(a.cameras.centres_in_world - b.cameras.centres_in_world)
    # Both solves stop within 1e-9 of the cost; rounds may differ in one observation in a thousand, sqrt(1e-3) of sigma.
    assert (offset[1:] < 0.05 * sigma[1:, 3:6].max()).all()
    assert (np.abs(a.cameras.intrinsics[:, 0] - b.cameras.intrinsics[:, 0]) < 0.05 * sigma[:, 6]).all()


def test_an_observation_that_was_rejected_comes_back():
    scene, seen = waved("smart_room", n_frames=600)
    views = SpotViews.of(seen.observations)
    # A start so far off that at its tolerance much is rejected: all of it must be admitted again.
    turned = scene.cameras.intrinsics.copy()
    turned[:, :2] *= 1.05
    refined = refine(
        setups_of(scene), replace(scene.cameras, intrinsics=turned), views, rejection=4.0, tolerance_px=6.0
    )
    # exp(-16 / 2) = 0.03 % lie beyond four sigma.
    assert refined.is_inlier.mean() > 0.998
    assert compare(refined.cameras, scene.cameras).centre_m.max() < 0.05


def test_cameras_that_agree_with_nothing_are_an_error():
    scene, seen = waved("smart_room", n_frames=100)
    rng = np.random.default_rng(0)
    observations = seen.observations
    noise = Observations.from_columns(
        observations.camera_names,
        camera=observations.camera,
        frame=observations.frame,
        px=rng.uniform(0, 400, observations.px.shape),
    )
    with pytest.raises(ConvergenceError, match="observations agree"):
        refine(setups_of(scene), scene.cameras, SpotViews.of(noise), rejection=4.0, tolerance_px=0.5)


def test_a_start_becomes_cameras_with_its_focal_lengths():
    scene, _ = waved("smart_room", n_frames=60)
    ratio = np.array([0.5, 0.6, 0.7, 0.8, 0.9])
    start = Start("anchor", scene.cameras.cam_from_world, ratio, np.ones(1, dtype=bool))
    cameras = started_cameras(setups_of(scene), start)
    np.testing.assert_allclose(cameras.intrinsics[:, 0], 640 * ratio)
    np.testing.assert_allclose(cameras.intrinsics[:, 1], 640 * ratio)
    np.testing.assert_allclose(cameras.centres_in_world, scene.cameras.centres_in_world)
