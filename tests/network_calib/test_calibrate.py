"""The whole calibration: named rooms against their truth and their own uncertainty, anchors, repeatability."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from network_calib.calibrate import calibrate
from network_calib.camera_parameters import N_POSE
from network_calib.observations import Observations
from network_calib.room_setup import Knowledge, KnownCentres, KnownDistance, KnownPoints, Options, UnitScale
from network_calib.synthetic import compare
from tests.network_calib.scenes import SIGMA_PX, calibrated, setups_of, stereo_anchor, waved

QUICK = Options(n_repeats=1)
# Largest of some 40 numbers of unit variance: beyond 4 sigma with a chance of 40 * 6e-5 = 0.25 % per room.
N_SIGMA = 4.0


def in_first_cameras_frame(scene):
    """(C, 3) true centres and (C, 3, 3) rotations in the frame of camera 0, as a calibration gives them."""
    rotation, origin = scene.cameras.rotations[0], scene.cameras.centres_in_world[0]
    centres = (scene.cameras.centres_in_world - origin) @ rotation.T
    return centres, scene.cameras.rotations @ rotation.T


def whitened_centres(scene, calibration):
    """(C, 3) centre errors over their sigma, cameras beyond the first."""
    true, _ = in_first_cameras_frame(scene)
    error = calibration.as_cameras().centres_in_world - true
    sigma = np.array([camera.sigma[3:6] for camera in calibration.cameras])
    return error[2:] / sigma[2:]


ROOMS = [
    ("smart_room", {}),
    ("ring_room", {"n_frames": 800}),
    ("facing_cameras", {}),
    ("wide_fisheye", {}),
    ("tele_beside_wide", {}),
    ("colinear_centres", {}),
    ("corridor_chain", {"n_cameras": 12}),
]


@pytest.mark.parametrize(("name", "numbers"), ROOMS)
def test_rooms_are_found_within_their_own_uncertainty(name, numbers):
    scene, calibration = calibrated(name, **numbers)
    assert np.abs(whitened_centres(scene, calibration)).max() < N_SIGMA
    intrinsics = np.stack([camera.intrinsics for camera in calibration.cameras])
    sigma = np.array([camera.sigma[N_POSE:] for camera in calibration.cameras])
    free = [0, 2, 3, 4, 5] if name != "wide_fisheye" else [0, 2, 3, 4]
    assert (np.abs(intrinsics - scene.cameras.intrinsics)[:, free] < N_SIGMA * sigma[:, free]).all()
    # The sigmas are worth something: a room that is waved through well is known to centimetres and a hundredth.
    assert np.median([camera.sigma[3:6] for camera in calibration.cameras[2:]]) < 0.05
    assert (sigma[:, 0] < 0.01 * intrinsics[:, 0]).all()
    errors = compare(calibration.as_cameras(), scene.cameras, align="rigid")
    assert errors.relative_scale == pytest.approx(1.0, abs=0.03)
    for camera in calibration.cameras:
        assert camera.quality.noise_sigma_px == pytest.approx(SIGMA_PX, rel=0.25)
    assert calibration.quality.chi2_per_dof == pytest.approx(1.0, abs=0.03)


def test_the_start_is_chosen_and_recorded():
    assert calibrated("smart_room")[1].provenance.start_method == "factorisation"
    assert calibrated("corridor_chain", n_cameras=12)[1].provenance.start_method == "anchor"


def test_ellipsoids_hold_the_truth_as_often_as_they_say():
    # Rooms, ways and noise anew for each seed; camera 2 of each, so that the draws are independent.
    nees = []
    for seed in range(20):
        scene, seen = waved("ring_room", n_cameras=4, n_frames=300, seed=100 + seed)
        options = Options(n_repeats=1, holdout_share=0.0)
        calibration = calibrate(seen.observations, setups_of(scene), anchor=stereo_anchor(scene), options=options)
        true, _ = in_first_cameras_frame(scene)
        error = calibration.cameras[2].centre_in_world - true[2]
        nees.append(error @ np.linalg.solve(calibration.cameras[2].covariance[3:6, 3:6], error))
    nees = np.array(nees)
    n_inside = int((nees < chi2.ppf(0.95, 3)).sum())
    assert n_inside >= binom.ppf(1e-3, 20, 0.95)
    # The sum sees what a count of 20 cannot: sigmas too small, or too large.
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 3 * len(nees))
    assert low < nees.sum() < high


def figures(calibration):
    """Everything but the clock, as nested plain values."""
    cameras = [
        (
            camera.name,
            camera.intrinsics.tolist(),
            camera.cam_from_world.as_matrix().tolist(),
            camera.covariance.tolist(),
            camera.quality,
        )
        for camera in calibration.cameras
    ]
    provenance = replace(calibration.provenance, created_utc="")
    return cameras, calibration.world, repr(calibration.quality), calibration.warnings, provenance


def test_two_runs_are_equal_to_the_last_bit():
    scene, seen = waved("smart_room", n_frames=800, missing=0.3, false_detections=0.1)
    first, second = (
        calibrate(seen.observations, setups_of(scene), options=Options(n_repeats=2), seed=5) for _ in range(2)
    )
    assert figures(first) == figures(second)


def test_another_seed_changes_little_against_sigma():
    scene, seen = waved("smart_room", n_frames=800, missing=0.3, false_detections=0.1)
    anchor = stereo_anchor(scene)
    runs = [
        calibrate(seen.observations, setups_of(scene), anchor=anchor, options=QUICK, seed=seed) for seed in range(3)
    ]
    sigma = np.array([camera.sigma for camera in runs[0].cameras])
    for other in runs[1:]:
        shift = np.abs(other.as_cameras().centres_in_world - runs[0].as_cameras().centres_in_world)
        assert (shift[1:] < 0.1 * sigma[1:, 3:6].max()).all()
        focal_px = [np.array([camera.intrinsics[0] for camera in run.cameras]) for run in (runs[0], other)]
        assert (np.abs(focal_px[1] - focal_px[0]) < 0.1 * sigma[:, 6]).all()


def test_repeat_spread_is_that_of_the_next_seeds():
    scene, seen = waved("ring_room", n_cameras=4, n_frames=500, missing=0.3, false_detections=0.1)
    anchor = stereo_anchor(scene)
    runs = [
        calibrate(seen.observations, setups_of(scene), anchor=anchor, options=QUICK, seed=seed) for seed in range(3)
    ]
    spread = calibrate(
        seen.observations, setups_of(scene), anchor=anchor, options=Options(n_repeats=3), seed=0
    ).quality.repeat_centre_spread
    centres = [run.as_cameras().centres_in_world for run in runs]
    expected = max(np.linalg.norm(other - centres[0], axis=1).max() for other in centres[1:])
    assert spread == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_order_of_the_cameras_does_not_matter():
    scene, seen = waved("smart_room", n_frames=800)
    observations, order = seen.observations, [2, 4, 0, 1, 3]
    shuffled = Observations.from_columns(
        tuple(observations.camera_names[c] for c in order),
        camera=np.argsort(order)[observations.camera],
        frame=observations.frame,
        px=observations.px,
    )
    setups = setups_of(scene)
    anchor = KnownCentres(scene.cameras.names, scene.cameras.centres_in_world)
    straight = calibrate(observations, setups, anchor=anchor, options=QUICK)
    other = calibrate(shuffled, [setups[c] for c in order], anchor=anchor, options=QUICK)
    assert [camera.name for camera in other.cameras] == [f"C{c}" for c in order]
    sigma_m = np.array([camera.sigma[3:6] for camera in straight.cameras])
    for camera, c in zip(other.cameras, order, strict=True):
        shift = np.abs(camera.centre_in_world - straight.cameras[c].centre_in_world)
        assert shift.max() < 0.1 * sigma_m.max()


@pytest.fixture(scope="module")
def smart():
    return waved("smart_room", n_frames=800, missing=0.3, false_detections=0.1)


def test_anchors_name_the_world(smart):
    scene, seen = smart
    setups = setups_of(scene)
    truth = scene.cameras.centres_in_world
    unit = calibrate(seen.observations, setups, options=QUICK)
    assert (unit.world.name, unit.world.unit) == ("C0", "unit")
    assert np.linalg.norm(unit.cameras[1].centre_in_world) == pytest.approx(1.0)

    anchor = KnownDistance("C2", "C3", float(np.linalg.norm(truth[3] - truth[2])))
    taped = calibrate(seen.observations, setups, anchor=anchor, options=QUICK)
    assert taped.world.unit == "m"
    gap = taped.cameras[3].centre_in_world - taped.cameras[2].centre_in_world
    assert np.linalg.norm(gap) == pytest.approx(anchor.distance_m)

    surveyed = calibrate(seen.observations, setups, anchor=KnownCentres(scene.cameras.names, truth), options=QUICK)
    errors = compare(surveyed.as_cameras(), scene.cameras, align="none")
    sigma_m = np.array([camera.sigma[3:6] for camera in surveyed.cameras])
    assert errors.centre_m.max() < N_SIGMA * np.linalg.norm(sigma_m, axis=1).max()

    usable = seen.is_usable
    frames = np.unique(seen.point[usable])[::60]
    known = KnownPoints(tuple(frames.tolist()), scene.trajectory[frames])
    marked = calibrate(seen.observations, setups, anchor=known, options=QUICK)
    assert compare(marked.as_cameras(), scene.cameras, align="none").centre_m.max() < 0.03

    shapes = [compare(run.as_cameras(), unit.as_cameras()).centre_m.max() for run in (taped, surveyed, marked)]
    assert max(shapes) < 1e-6  # one calibration in four frames


def test_floor_frames_level_the_room(smart):
    scene, seen = smart
    # The spot is put down four times: all cameras see it rest on the floor for one frame.
    rng = np.random.default_rng(0)
    spots = np.array([[1.5, 1.5, 0.0], [4.5, 1.5, 0.0], [2.0, 3.5, 0.0], [4.0, 3.0, 0.0]])
    frame, camera = (a.ravel() for a in np.meshgrid(5000 + np.arange(4), np.arange(5), indexing="ij"))
    px, is_valid = scene.cameras.img_from_world(camera, spots[frame - 5000])
    is_seen = is_valid & scene.cameras.is_in_image(camera, px)
    px = px + SIGMA_PX * rng.standard_normal(px.shape)
    observations = seen.observations
    both = Observations.from_columns(
        observations.camera_names,
        camera=np.concatenate([observations.camera, camera[is_seen]]),
        frame=np.concatenate([observations.frame, frame[is_seen]]),
        px=np.concatenate([observations.px, px[is_seen]]),
    )
    options = Options(n_repeats=1, floor_frames=(5000, 5001, 5002, 5003))
    calibration = calibrate(both, setups_of(scene), anchor=stereo_anchor(scene), options=options)
    assert calibration.world.name == "floor"
    heights = np.array([camera.centre_in_world[2] for camera in calibration.cameras])
    # Centres and spots are known to some 1 cm.
    np.testing.assert_allclose(heights, scene.cameras.centres_in_world[:, 2], atol=0.04)


def test_stereo_pair_alone_with_known_lenses():
    scene, seen = waved("stereo_only", n_frames=800, missing=0.2)
    setups = [
        replace(setup, knowledge=Knowledge.FIXED, intrinsics=row)
        for setup, row in zip(setups_of(scene), scene.cameras.intrinsics, strict=True)
    ]
    calibration = calibrate(seen.observations, setups, anchor=stereo_anchor(scene), options=QUICK)
    _, true_rotations = in_first_cameras_frame(scene)
    rotation = calibration.cameras[1].cam_from_world.rotation.as_matrix()
    error_rad = np.linalg.norm(rotation - true_rotations[1]) / np.sqrt(2)
    assert error_rad < N_SIGMA * np.linalg.norm(calibration.cameras[1].sigma[:3])
    assert all(camera.is_intrinsics_fixed for camera in calibration.cameras)
    np.testing.assert_array_equal([camera.covariance[N_POSE:].any() for camera in calibration.cameras], False)


def test_cameras_of_one_group_get_one_lens():
    scene, _ = waved("ring_room", n_cameras=5, n_frames=500)
    same = replace(scene, cameras=replace(scene.cameras, intrinsics=np.tile(scene.cameras.intrinsics[0], (5, 1))))
    rng = np.random.default_rng(3)
    camera, frame = (a.ravel() for a in np.meshgrid(np.arange(5), np.arange(500), indexing="ij"))
    px, is_valid = same.cameras.img_from_world(camera, same.trajectory[frame])
    is_seen = is_valid & same.cameras.is_in_image(camera, px)
    observations = Observations.from_columns(
        same.cameras.names,
        camera=camera[is_seen],
        frame=frame[is_seen],
        px=px[is_seen] + SIGMA_PX * rng.standard_normal((is_seen.sum(), 2)),
    )
    grouped = [replace(setup, group="ceiling") for setup in setups_of(same)]
    together = calibrate(observations, grouped, anchor=stereo_anchor(same), options=QUICK)
    apart = calibrate(observations, setups_of(same), anchor=stereo_anchor(same), options=QUICK)
    for camera_found in together.cameras[1:]:
        np.testing.assert_array_equal(camera_found.intrinsics, together.cameras[0].intrinsics)
    # Five cameras know one lens at least as well as the best of them alone.
    sigma = [min(c.sigma[6] for c in run.cameras) for run in (together, apart)]
    assert sigma[0] < sigma[1]
    offset = together.cameras[0].intrinsics[0] - same.cameras.intrinsics[0, 0]
    assert abs(offset) < N_SIGMA * together.cameras[0].sigma[6]


def test_fixed_lenses_stay_and_help(smart):
    scene, seen = smart
    setups = [
        replace(setup, knowledge=Knowledge.FIXED, intrinsics=row)
        for setup, row in zip(setups_of(scene), scene.cameras.intrinsics, strict=True)
    ]
    fixed = calibrate(seen.observations, setups, anchor=stereo_anchor(scene), options=QUICK)
    free = calibrate(seen.observations, setups_of(scene), anchor=stereo_anchor(scene), options=QUICK)
    np.testing.assert_allclose([c.intrinsics for c in fixed.cameras], scene.cameras.intrinsics, rtol=1e-15)
    sigma = [np.median([c.sigma[3:6] for c in run.cameras[1:]]) for run in (fixed, free)]
    assert sigma[0] < 0.7 * sigma[1]
    assert np.abs(whitened_centres(scene, fixed)).max() < N_SIGMA


def test_given_lenses_as_priors_are_improved(smart):
    scene, seen = smart
    near = scene.cameras.intrinsics * np.where(np.arange(8) < 2, 1.02, 1.0)  # 2 %, within the prior's 3 %
    setups = [
        replace(setup, knowledge=Knowledge.INITIAL, intrinsics=row)
        for setup, row in zip(setups_of(scene), near, strict=True)
    ]
    calibration = calibrate(seen.observations, setups, anchor=stereo_anchor(scene), options=QUICK)
    found = np.array([camera.intrinsics[0] for camera in calibration.cameras])
    np.testing.assert_allclose(found, scene.cameras.intrinsics[:, 0], rtol=0.004)
    assert calibration.warnings == ()


def test_what_was_asked_stands_in_the_result(smart):
    scene, seen = smart
    steps = []
    calibration = calibrate(
        seen.observations,
        setups_of(scene),
        anchor=UnitScale(),
        options=Options(n_repeats=1, rejection=5.0),
        seed=17,
        input_name="the room",
        input_sha256="abc",
        progress=lambda step, part: steps.append((step, part)),
    )
    provenance = calibration.provenance
    assert (provenance.seed, provenance.input_name, provenance.input_sha256) == (17, "the room", "abc")
    assert '"rejection": 5.0' in provenance.options_json
    assert '"kind": "UnitScale"' in provenance.options_json
    parts = [part for _, part in steps]
    assert parts == sorted(parts)
    assert (parts[0], parts[-1]) == (0.0, 1.0)


def test_both_starts_may_be_asked_for(smart):
    scene, seen = smart
    runs = [
        calibrate(
            seen.observations,
            setups_of(scene),
            anchor=stereo_anchor(scene),
            options=Options(n_repeats=1, start=start),
        )
        for start in ("factorisation", "anchor")
    ]
    assert [run.provenance.start_method for run in runs] == ["factorisation", "anchor"]
    sigma_m = np.max([camera.sigma[3:6] for camera in runs[0].cameras])
    shift = runs[0].as_cameras().centres_in_world - runs[1].as_cameras().centres_in_world
    assert np.abs(shift).max() < 0.05 * sigma_m
