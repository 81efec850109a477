"""Real bright-spot recordings: plausible cameras, small errors on what was fitted and on what was not."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from network_calib.calibrate import calibrate
from network_calib.cameras import cam_from_img
from network_calib.formats.source import read_source
from network_calib.gauge import fit_similarity
from network_calib.room_setup import Knowledge, Options
from network_calib.triangulate import triangulate

# Mean error of Svoboda's own code over the observations it kept, px.
SVOBODA_MEAN_PX = {
    "DATA20100906_134124": 0.634,
    "caldata20130726_122220": 0.254,
    "DATA20090709_111010": 0.146,
}
# Median of the left-out test that the best other tool reaches, or a little below, px.
LEFT_OUT_MEDIAN_PX = {
    "DATA20100906_134124": 0.55,
    "caldata20130726_122220": 0.29,
    "DATA20090709_111010": 0.14,
}


@functools.cache
def observed(recording: Path):
    """The recording's observations, and setups from which given intrinsics are taken away."""
    read = read_source(recording)
    setups = [replace(setup, knowledge=Knowledge.UNKNOWN, intrinsics=None) for setup in read.setups]
    return read, setups


@functools.cache
def calibrated_blindly(recording: Path):
    read, setups = observed(recording)
    return calibrate(read.observations, setups)


def test_cameras_are_plausible(recording):
    calibration = calibrated_blindly(recording)
    for camera in calibration.cameras:
        focal_x, focal_y, centre_x, centre_y = camera.intrinsics[:4]
        width, height = camera.size_px
        assert 0 < centre_x < width - 1
        assert 0 < centre_y < height - 1
        assert focal_x == focal_y
        assert 0.3 * width < focal_x < 5 * width
        assert np.linalg.det(camera.cam_from_world.rotation.as_matrix()) == pytest.approx(1.0)
    assert not {doubt.code for doubt in calibration.warnings} & {"twin", "convergence", "sync", "colinear"}


def test_fit_is_closer_than_svobodas_and_nearly_all_data_take_part(recording):
    quality = calibrated_blindly(recording).quality
    assert quality.n_inliers >= 0.95 * quality.n_observations
    assert quality.fitted.mean_px < 0.6 * SVOBODA_MEAN_PX[recording.name]
    assert quality.chi2_per_dof == pytest.approx(1.0, abs=0.05)


def test_every_frame_with_two_views_is_used(recording):
    read, _ = observed(recording)
    quality = calibrated_blindly(recording).quality
    shared = read.observations.in_frames_with_views(2)
    assert quality.n_observations == len(shared)
    assert quality.n_points >= 0.97 * len(np.unique(shared.frame))


def test_repeats_with_other_seeds_agree(recording):
    calibration = calibrated_blindly(recording)
    sigma = np.array([camera.sigma for camera in calibration.cameras])
    assert calibration.quality.repeat_centre_spread < sigma[:, 3:6].max()
    assert calibration.quality.repeat_focal_spread_px < sigma[:, 6].max()


def left_out_errors_px(cameras, observations):
    """Each view of a frame predicted from the frame's other views: errors of all that can be predicted, px."""
    intrinsics, is_fisheye = cameras.intrinsics[observations.camera], cameras.is_fisheye[observations.camera]
    ray_xy, has_ray = cam_from_img(intrinsics, is_fisheye, observations.px)
    frames, point = np.unique(observations.frame, return_inverse=True)
    errors = []
    for c in range(len(cameras)):
        rest = has_ray & (observations.camera != c)
        enough = np.bincount(point[rest], minlength=len(frames)) >= 2
        points, is_located = triangulate(
            observations.camera[rest],
            point[rest],
            ray_xy[rest],
            cameras.rotations,
            cameras.centres_in_world,
            len(frames),
        )
        own = (observations.camera == c) & (enough & is_located)[point]
        px, is_valid = cameras.img_from_world(observations.camera[own], points[point[own]])
        errors.append(np.where(is_valid, np.linalg.norm(px - observations.px[own], axis=1), np.inf))
    return np.concatenate(errors)


def test_views_that_were_not_fitted_are_predicted_from_the_others(recording):
    read, setups = observed(recording)
    observations = read.observations
    is_fitted = observations.frame % 2 == 0
    cameras = calibrate(observations.select(is_fitted), setups, options=Options(n_repeats=1)).as_cameras()
    errors_px = left_out_errors_px(cameras, observations.select(~is_fitted))
    # Every second frame was left out, and no outlier is taken from what is predicted.
    assert len(errors_px) > 0.3 * len(observations)
    assert np.median(errors_px) <= LEFT_OUT_MEDIAN_PX[recording.name]


def test_hold_out_of_the_result_is_near_the_fit(recording):
    quality = calibrated_blindly(recording).quality
    # Segments of the way were never fitted: the cameras' own uncertainty comes on top, up to half of the noise.
    assert quality.holdout.median_px < 1.5 * quality.fitted.median_px


def test_centres_are_where_they_were_measured(recordings_dir):
    recording = recordings_dir / "caldata20130726_122220"
    if not recording.is_dir():
        pytest.skip("real recording caldata20130726_122220 is absent from ../shared/data")
    read, _ = observed(recording)
    found = calibrated_blindly(recording).as_cameras().centres_in_world
    assert read.known_centres is not None
    assert read.known_centres.names == read.observations.camera_names
    known = read.known_centres.centres_in_world_m
    offset_m = np.linalg.norm(fit_similarity(found, known).apply(found) - known, axis=1)
    print(f"distance to the recorded centres, m: {offset_m.round(4)}")
    # The network is 1 m across.
    assert offset_m.max() < 0.05


def test_given_intrinsics_as_priors_keep_the_fit(recordings_dir):
    recording = recordings_dir / "caldata20130726_122220"
    if not recording.is_dir():
        pytest.skip("real recording caldata20130726_122220 is absent from ../shared/data")
    read, _ = observed(recording)
    assert {setup.knowledge for setup in read.setups} == {Knowledge.INITIAL}
    blind = calibrated_blindly(recording)
    primed = calibrate(read.observations, read.setups, options=Options(n_repeats=1))
    assert primed.quality.fitted.mean_px < 1.1 * blind.quality.fitted.mean_px
    held = [replace(setup, knowledge=Knowledge.FIXED) for setup in read.setups]
    fixed = calibrate(read.observations, held, options=Options(n_repeats=1))
    # The board's intrinsics are not those of the day: holding them costs, and is said.
    assert fixed.quality.fitted.mean_px > 1.3 * blind.quality.fitted.mean_px
    assert "intrinsics" in {doubt.code for doubt in fixed.warnings}
