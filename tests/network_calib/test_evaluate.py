"""Evaluation of a calibration on observations that it may never have seen."""

from dataclasses import replace

import numpy as np
import pytest

from network_calib.errors import InputError
from network_calib.evaluate import evaluate
from network_calib.observations import Observations
from network_calib.synthetic import observe, room
from tests.network_calib.scenes import SIGMA_PX, calibrated


def another_walk(seed=0, **noise):
    """The same room and cameras, waved through anew."""
    scene = room("smart_room", rng=np.random.default_rng(seed), n_frames=1200)
    way = room("smart_room", rng=np.random.default_rng(seed + 50), n_frames=600).trajectory
    fresh = replace(scene, trajectory=way)
    return observe(fresh, rng=np.random.default_rng(seed + 1), sigma_px=SIGMA_PX, **noise)


@pytest.fixture(scope="module")
def calibration():
    return calibrated("smart_room", n_frames=1200)[1]


def test_new_data_show_the_noise_and_little_more(calibration):
    seen = another_walk()
    found = evaluate(calibration, seen.observations)
    # A 2D residual of noise 0.2 px of which the spot absorbs 3 of 2 n: RMS 0.2 sqrt(2 - 3 / n) for some n = 3.5 views.
    assert found.overall.rms_px == pytest.approx(0.2 * np.sqrt(2 - 3 / 3.5), rel=0.15)
    assert found.is_inlier.mean() > 0.995
    assert found.n_frames == len(np.unique(seen.observations.frame[seen.observations.n_views() >= 2]))
    assert sum(camera.n for camera in found.cameras) == found.overall.n


def test_false_detections_are_told_apart(calibration):
    seen = another_walk(false_detections=0.1)
    found = evaluate(calibration, seen.observations)
    is_usable = seen.is_usable[seen.observations.n_views() >= 2]
    # The tolerance is ten sigma, so that nothing honest is left out and errors are not trimmed; of strays, those within
    # 2 px of an only epipolar line pass.
    assert found.is_inlier[is_usable].mean() > 0.99
    assert found.is_inlier[~is_usable].mean() < 0.1
    assert found.overall.rms_px < 0.35


def test_a_camera_that_was_moved_shows(calibration):
    seen = another_walk()
    px = seen.observations.px.copy()
    px[seen.observations.camera == 2] += [1.2, 0.0]
    found = evaluate(calibration, replace(seen.observations, px=px))
    medians = [camera.median_px for camera in found.cameras]
    assert int(np.argmax(medians)) == 2
    assert medians[2] > 2 * np.median(medians)


def test_cameras_are_matched_by_name_not_by_number(calibration):
    observations = another_walk().observations
    order = [3, 0, 4, 1, 2]
    shuffled = Observations.from_columns(
        tuple(observations.camera_names[c] for c in order),
        camera=np.argsort(order)[observations.camera],
        frame=observations.frame,
        px=observations.px,
    )
    direct, renumbered = evaluate(calibration, observations), evaluate(calibration, shuffled)
    assert renumbered.overall == direct.overall
    assert renumbered.cameras == direct.cameras


def test_a_subset_of_the_cameras_can_be_evaluated(calibration):
    observations = another_walk().observations
    kept = observations.select(observations.camera < 2)
    two = Observations.from_columns(("C0", "C1"), camera=kept.camera, frame=kept.frame, px=kept.px)
    found = evaluate(calibration, two)
    assert [camera.n > 0 for camera in found.cameras] == [True, True, False, False, False]


def test_what_cannot_be_evaluated_is_refused(calibration):
    observations = another_walk().observations
    with pytest.raises(InputError, match="camera 'door' is not in the calibration, which has C0, C1"):
        evaluate(calibration, replace(observations, camera_names=("C0", "C1", "door", "C3", "C4")))
    with pytest.raises(InputError, match="nothing to evaluate"):
        evaluate(calibration, observations.select(observations.camera == 0))
