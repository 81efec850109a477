"""Doubts: what is accepted but must not pass silently, and that a good calibration raises none."""

from dataclasses import replace

import numpy as np
import pytest

from network_calib import doubts
from network_calib.calibrate import calibrate
from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.result import CameraQuality, ErrorSummary
from network_calib.room_setup import CameraSetup, Knowledge, Options
from network_calib.sync import TimeOffsets
from network_calib.synthetic import Room, observe
from network_calib.synthetic_rooms import look_at
from tests.network_calib.scenes import calibrated, setups_of, stereo_anchor, waved, with_frames_shifted

QUICK = Options(n_repeats=1)


def codes(calibration):
    return {doubt.code for doubt in calibration.warnings}


def about(calibration, code):
    return [doubt for doubt in calibration.warnings if doubt.code == code]


@pytest.mark.parametrize("name", ["smart_room", "ring_room", "wide_fisheye", "tele_beside_wide"])
def test_a_good_room_raises_no_doubt(name):
    _, calibration = calibrated(name)
    assert calibration.warnings == ()


def test_centres_on_a_line_are_named():
    _, calibration = calibrated("colinear_centres")
    (doubt,) = about(calibration, "colinear")
    assert "one line" in doubt.message
    assert doubt.advice


@pytest.mark.parametrize("camera", [0, 3])
def test_a_camera_one_frame_off_is_named_and_no_other(camera):
    scene, seen = waved("smart_room", n_frames=1200)
    shifted = with_frames_shifted(seen.observations, camera, 1)
    calibration = calibrate(shifted, setups_of(scene), anchor=stereo_anchor(scene), options=QUICK)
    (doubt,) = about(calibration, "sync")
    assert doubt.message.startswith(f"C{camera} exposes ")
    assert float(doubt.message.split()[2]) == pytest.approx(1.0, abs=0.1)
    assert "earlier" in doubt.message


def with_longer_lenses(scene, knowledge, which):
    """Intrinsics given for the cameras `which`, their focal lengths 10 % too long."""
    wrong = scene.cameras.intrinsics * np.where(np.arange(8) < 2, 1.1, 1.0)
    return [
        replace(setup, knowledge=knowledge, intrinsics=wrong[c]) if c in which else setup
        for c, setup in enumerate(setups_of(scene))
    ]


@pytest.mark.parametrize("which", [(2,), (0, 1, 2, 3, 4)])
def test_wrong_intrinsics_held_fixed_are_contradicted(which):
    scene, seen = waved("smart_room", n_frames=1200, missing=0.3, false_detections=0.1)
    setups = with_longer_lenses(scene, Knowledge.FIXED, which)
    calibration = calibrate(seen.observations, setups, anchor=stereo_anchor(scene), options=QUICK)
    found = about(calibration, "intrinsics")
    assert {doubt.message.split(":")[0] for doubt in found} == {f"C{c}" for c in which}
    for c in which:  # held as asked, doubted or not
        np.testing.assert_allclose(calibration.cameras[c].intrinsics, setups[c].intrinsics, rtol=1e-15)
        assert calibration.cameras[c].is_intrinsics_fixed
    wanted = float(found[0].message.split("they want ")[1].split()[0])
    assert wanted == pytest.approx(scene.cameras.intrinsics[which[0], 0], rel=0.01)


def test_wrong_intrinsics_as_a_prior_are_contradicted_and_overruled():
    scene, seen = waved("smart_room", n_frames=1200, missing=0.3, false_detections=0.1)
    setups = with_longer_lenses(scene, Knowledge.INITIAL, (2,))
    calibration = calibrate(seen.observations, setups, anchor=stereo_anchor(scene), options=QUICK)
    (doubt,) = about(calibration, "intrinsics")
    assert "prior only" in doubt.advice
    assert calibration.cameras[2].intrinsics[0] == pytest.approx(scene.cameras.intrinsics[2, 0], rel=0.01)


def test_right_intrinsics_held_fixed_raise_no_doubt():
    scene, seen = waved("smart_room", n_frames=1200, missing=0.3, false_detections=0.1)
    setups = [
        replace(setup, knowledge=Knowledge.FIXED, intrinsics=row)
        for setup, row in zip(setups_of(scene), scene.cameras.intrinsics, strict=True)
    ]
    calibration = calibrate(seen.observations, setups, anchor=stereo_anchor(scene), options=QUICK)
    assert calibration.warnings == ()


def test_a_camera_hardly_seen_is_doubted():
    scene, seen = waved("smart_room", n_frames=1200)
    observations = seen.observations
    rows = np.flatnonzero(observations.camera == 2)
    thin = observations.select(~np.isin(np.arange(len(observations)), rows[60:]))
    calibration = calibrate(thin, setups_of(scene), anchor=stereo_anchor(scene), options=QUICK)
    assert {"coverage", "overlap"} <= codes(calibration)
    assert all(doubt.message.startswith("C2") for doubt in about(calibration, "coverage"))


def test_a_camera_with_many_false_detections_is_doubted():
    scene, seen = waved("smart_room", n_frames=1200)
    rng = np.random.default_rng(0)
    px = seen.observations.px.copy()
    own = np.flatnonzero(seen.observations.camera == 1)
    stray = rng.choice(own, len(own) * 3 // 10, replace=False)
    px[stray] = rng.uniform(0, 470, (len(stray), 2))
    calibration = calibrate(
        replace(seen.observations, px=px), setups_of(scene), anchor=stereo_anchor(scene), options=QUICK
    )
    (doubt,) = about(calibration, "outliers")
    assert doubt.message.startswith("C1: only 7")


def test_a_blurred_camera_is_doubted():
    scene, seen = waved("smart_room", n_frames=1200)
    rng = np.random.default_rng(0)
    px = (
        seen.observations.px
        + 1.5 * rng.standard_normal(seen.observations.px.shape) * (seen.observations.camera == 3)[:, None]
    )
    calibration = calibrate(
        replace(seen.observations, px=px), setups_of(scene), anchor=stereo_anchor(scene), options=QUICK
    )
    (doubt,) = about(calibration, "noise")
    assert doubt.message.startswith("C3: detection noise 1.5")


def quality(**changes):
    errors = ErrorSummary(80, 0.2, 0.25, 0.18, 0.5)
    return replace(CameraQuality(100, errors, errors, 0.2, 0.8), **changes)


@pytest.mark.parametrize(
    ("changes", "focal_sigma_px", "code"),
    [
        ({"coverage": 0.24}, 1.0, "coverage"),
        ({"n_observations": 110}, 1.0, "outliers"),
        ({}, 5.1, "focal"),
        ({"noise_sigma_px": 0.9}, 1.0, "noise"),
    ],
)
def test_limits_of_a_camera(changes, focal_sigma_px, code):
    setups = [CameraSetup(name, (640, 480)) for name in ("A", "B", "C")]
    qualities = [quality(), quality(**changes), quality()]
    found = list(doubts.about_cameras(setups, qualities, np.full(3, 500.0), np.array([1.0, focal_sigma_px, 1.0])))
    assert [doubt.code for doubt in found] == [code]
    assert found[0].message.startswith("B")


def test_limits_of_the_hold_out():
    fitted = ErrorSummary(100, 0.2, 0.25, 0.20, 0.5)
    assert not list(doubts.about_holdout(fitted, replace(fitted, median_px=0.29), 0.9))
    (doubt,) = doubts.about_holdout(fitted, replace(fitted, median_px=0.31), 0.9)
    assert "0.31" in doubt.message
    (doubt,) = doubts.about_holdout(fitted, fitted, 0.7)
    assert "70 %" in doubt.message
    # No hold-out asked for: not a number, and no doubt.
    assert not list(doubts.about_holdout(fitted, ErrorSummary.of(np.zeros(0)), float("nan")))


def test_the_odd_clock_is_named_even_when_it_is_the_reference():
    offsets = TimeOffsets(np.array([0.0, 1.0, 1.01, 1.0]), np.array([0.0, 0.01, 0.01, 0.01]), 0)
    (doubt,) = doubts.about_time(["A", "B", "C", "D"], offsets)
    assert doubt.message == "A exposes 1.00 ± 0.01 frames earlier than the others"


def test_offsets_within_their_uncertainty_or_unknown_are_no_doubt():
    sigma = np.array([0.0, 0.2, np.inf])
    assert not list(doubts.about_time(["A", "B", "C"], TimeOffsets(np.array([0.0, 0.9, 0.0]), sigma, 0)))
    (doubt,) = doubts.about_time(["A", "B"], TimeOffsets(np.array([0.0, 0.5]), np.array([0.0, 0.01]), 0))
    assert doubt.message == "B exposes 0.50 ± 0.01 frames later than A"


def test_an_unsettled_solve_and_a_near_twin_are_doubted():
    assert not list(doubts.about_convergence(True, 5.0))
    assert [doubt.code for doubt in doubts.about_convergence(False, 5.0)] == ["convergence"]
    assert [doubt.code for doubt in doubts.about_convergence(True, 1.2)] == ["twin"]


def known_cameras(centres, looks_at, focal_px, spots):
    """Cameras of 640 x 480 pixels with held intrinsics, calibrated from random spots at 0.3 px."""
    n = len(centres)
    intrinsics = np.tile([focal_px, focal_px, 319.5, 239.5, 0, 0, 0, 0], (n, 1))
    rotations = np.stack([look_at(centre, target) for centre, target in zip(centres, looks_at, strict=True)])
    names, lenses = tuple(f"C{c}" for c in range(n)), (LensModel.NONE,) * n
    cameras = Cameras(
        names, np.tile([640, 480], (n, 1)), lenses, intrinsics, poses_from_centres(rotations, np.asarray(centres))
    )
    seen = observe(Room("known", cameras, spots, 25.0), rng=np.random.default_rng(2), sigma_px=0.3)
    setups = [
        CameraSetup(name, (640, 480), LensModel.NONE, Knowledge.FIXED, row)
        for name, row in zip(names, intrinsics, strict=True)
    ]
    return calibrate(seen.observations, setups, options=QUICK)


@pytest.mark.parametrize(("distance_m", "is_doubted"), [(10.0, False), (160.0, True)])
def test_a_mirrored_twin_is_doubted_from_far_through_long_lenses_only(distance_m, is_doubted):
    # What tells depths apart is X z / distance at 85 px/m, 0.6 m and 0.7 m RMS: 3.6 px RMS at 10 m, and 0.2 px at
    # 160 m, less than the noise of 0.3 px.
    azimuth = np.radians([-25, 0, 28])
    centres = distance_m * np.stack([np.sin(azimuth), [0.1, -0.15, 0.12], -np.cos(azimuth)], axis=1)
    spots = np.random.default_rng(1).uniform(-1, 1, (400, 3)) * [1.2, 0.9, 1.2]
    calibration = known_cameras(centres, np.zeros((3, 3)), 85 * distance_m, spots)
    assert ("twin" in codes(calibration)) == is_doubted


def test_a_stereo_head_is_not_doubted_when_its_twin_turns_back_into_itself():
    # Parallel cameras 90 mm apart: mirrored in depth they are the same pair, and the spots climb back to their places.
    centres = np.array([[0.0, 0.0, 0.0], [0.09, 0.0, 0.0]])
    spots = np.random.default_rng(1).uniform([-1.5, 1, -1], [1.5, 3, 1], (600, 3))
    assert codes(known_cameras(centres, centres + np.array([0.0, 1.0, 0.0]), 520.0, spots)) == set()
