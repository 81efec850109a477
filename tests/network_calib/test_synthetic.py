"""The rooms are what they claim, detections are as noisy as asked, and `compare` sees errors and no gauge."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from network_calib.cameras import LensModel
from network_calib.errors import InputError
from network_calib.synthetic import ROOM_NAMES, align_cameras, compare, observe, room
from network_calib.synthetic_rooms import look_at

FREE_WAVING = [name for name in ROOM_NAMES if name not in ("planar_waving", "line_waving", "two_islands")]


def make(name, *, seed=0, **numbers):
    return room(name, rng=np.random.default_rng(seed), **numbers)


def views(scene, **options):
    """(F, C) which camera sees the spot in which frame."""
    seen = observe(scene, rng=np.random.default_rng(1), **options).observations
    table = np.zeros((len(scene.trajectory), len(scene.cameras)), dtype=bool)
    table[seen.frame, seen.camera] = True
    return table


@pytest.mark.parametrize("name", ROOM_NAMES)
def test_every_detection_without_noise_is_the_projected_spot_in_front_and_in_the_image(name):
    scene = make(name)
    seen = observe(scene, rng=np.random.default_rng(1), sigma_px=0.0).observations
    px, is_valid = scene.cameras.img_from_world(seen.camera, scene.trajectory[seen.frame])
    assert is_valid.all()
    assert scene.cameras.is_in_image(seen.camera, seen.px).all()
    # The spot is moved into the camera by R (x - c) here and by R x + t there: 10 m, rounded, at 0.2 m and 2500 px.
    np.testing.assert_allclose(seen.px, px, rtol=0, atol=1e-9)
    assert np.isnan(seen.sigma_px).all()


@pytest.mark.parametrize("name", ROOM_NAMES)
def test_every_camera_sees_enough_and_sits_under_the_ceiling(name):
    scene = make(name)
    assert views(scene).sum(axis=0).min() >= 100
    assert (scene.cameras.centres_in_world[:, 2] < 2.8).all()
    assert (scene.cameras.centres_in_world[:, 2] > 1.5).all()
    assert scene.trajectory[:, 2].min() >= 0.2
    assert scene.trajectory[:, 2].max() <= 2.2
    is_inside = (scene.cameras.intrinsics[:, 2:4] > 0) & (scene.cameras.intrinsics[:, 2:4] < scene.cameras.size_px)
    assert is_inside.all()


@pytest.mark.parametrize("name", FREE_WAVING)
@pytest.mark.parametrize("seed", range(3))
def test_spot_is_walked_at_hand_speed_through_a_volume(name, seed):
    scene = make(name, seed=seed)
    speed_m_s = np.linalg.norm(np.diff(scene.trajectory, axis=0), axis=1) * scene.frame_rate_hz
    # Set between 0.65 and 1.85 m/s along the curve; at a sharp turn the chord of one frame is shorter than its arc.
    assert speed_m_s.max() <= 2.0
    assert np.quantile(speed_m_s, 0.005) >= 0.5
    assert scene.frame_rate_hz == 25.0
    # Uniform use of a height of 2 m has a spread of 2 / sqrt(12) = 0.58 m; no plane may hold the way.
    spread_m = np.linalg.svd(scene.trajectory - scene.trajectory.mean(axis=0), compute_uv=False)
    assert spread_m[2] / np.sqrt(len(scene.trajectory)) > 0.4


@pytest.mark.parametrize("seed", range(5))
def test_smart_room_is_as_described(seed):
    scene = make("smart_room", seed=seed)
    assert scene.cameras.names == ("C0", "C1", "C2", "C3", "C4")
    assert 0.3 <= scene.baseline_m <= 0.4
    offset_in_c0 = scene.cameras.rotations[0] @ (scene.cameras.centres_in_world[1] - scene.cameras.centres_in_world[0])
    assert offset_in_c0[0] > 0.95 * scene.baseline_m  # C1 stands to the right of C0, give or take some degrees
    n_views = views(scene).sum(axis=1)
    assert (n_views >= 3).mean() > 0.9
    # Every eighth of the walked box is visited: 2000 frames spread evenly put 250 into each, 50 are asked for.
    is_high = scene.trajectory > np.array([3.0, 2.55, 1.2])
    assert np.bincount(is_high @ np.array([1, 2, 4]), minlength=8).min() >= 50


@pytest.mark.parametrize("n_cameras", [20, 200])
def test_corridor_chain_links_neighbours_and_only_neighbours(n_cameras):
    table = views(make("corridor_chain", n_cameras=n_cameras)).astype(float)
    shared = table.T @ table
    assert np.diag(shared, 1).min() >= 100
    ahead = np.array([(shared[i, i + 1 :] > 0).sum() for i in range(n_cameras)])
    assert ahead[:-6].min() >= 2
    assert ahead.max() <= 7
    assert 3 <= np.median(ahead[:-6]) <= 6


def test_corridor_chain_with_few_frames_is_still_walked_to_its_end_at_walking_speed():
    scene = make("corridor_chain", n_frames=300)
    speed_m_s = np.linalg.norm(np.diff(scene.trajectory, axis=0), axis=1) * scene.frame_rate_hz
    assert scene.frame_rate_hz < 25
    assert speed_m_s.max() <= 2.0
    assert views(scene).any(axis=0).all()


def test_ring_room_is_seen_whole_by_everyone():
    assert views(make("ring_room")).mean() > 0.95


def test_facing_cameras_have_the_opposite_pair_in_the_image():
    cameras = make("facing_cameras").cameras
    for near, far in [((0, 1), (2, 3)), ((2, 3), (0, 1))]:
        camera = np.repeat(near, 2)
        px, is_valid = cameras.img_from_world(camera, cameras.centres_in_world[np.tile(far, 2)])
        assert is_valid.all()
        assert cameras.is_in_image(camera, px).all()


def test_fisheye_diagonals_span_150_to_170_degrees():
    cameras = make("wide_fisheye").cameras
    assert set(cameras.lenses) == {LensModel.FISHEYE}
    for row, size_px in zip(cameras.intrinsics, cameras.size_px, strict=True):
        theta = np.linspace(0, np.pi / 2, 10_000)
        theta_d = theta * (1 + row[4] * theta**2 + row[5] * theta**4 + row[6] * theta**6 + row[7] * theta**8)
        diagonal_deg = 2 * np.degrees(np.interp(np.hypot(*size_px) / 2 / row[0], theta_d, theta))
        assert 149.9 < diagonal_deg < 170.1  # the table's step is 0.02 degrees


def test_tele_beside_wide_mixes_focal_lengths_from_300_to_2500_px():
    focal_px = make("tele_beside_wide").cameras.intrinsics[:, 0]
    assert (focal_px.min(), focal_px.max()) == (300, 2500)


@pytest.mark.parametrize(("name", "rank"), [("planar_waving", 2), ("line_waving", 1)])
def test_negative_controls_wave_in_a_plane_and_on_a_line(name, rank):
    way = make(name).trajectory
    extent = np.linalg.svd(way - way.mean(axis=0), compute_uv=False)
    # 2000 rounded positions of 5 m; their singular values err by sqrt(2000) * 5 * 1.1e-16 = 2e-14.
    assert extent[rank:].max() < 1e-12
    assert extent[rank - 1] > 10


def test_colinear_centres_lie_on_one_line():
    centres = make("colinear_centres").cameras.centres_in_world
    extent = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
    assert extent[1] < 1e-12
    assert extent[0] > 1


def test_two_islands_share_no_frame():
    table = views(make("two_islands")).astype(int)
    shared = table.T @ table
    assert (shared[:3, 3:] == 0).all()
    assert shared[:3, :3].min() >= 100
    assert shared[3:, 3:].min() >= 100


def test_stereo_only_has_two_cameras_that_share_most_frames():
    table = views(make("stereo_only"))
    assert table.shape[1] == 2
    assert table.all(axis=1).mean() > 0.8


def test_folded_back_spots_are_not_seen():
    scene = make("smart_room")
    intrinsics = scene.cameras.intrinsics.copy()
    intrinsics[:, 4], intrinsics[:, 5] = -0.3, 0.0  # folds at 46.5 degrees
    folding = replace(scene, cameras=replace(scene.cameras, intrinsics=intrinsics))
    seen = observe(folding, rng=np.random.default_rng(0), sigma_px=0.0).observations
    offset = scene.trajectory[seen.frame] - scene.cameras.centres_in_world[seen.camera]
    in_cam = np.einsum("kij,kj->ki", scene.cameras.rotations[seen.camera], offset)
    assert np.hypot(in_cam[:, 0] / in_cam[:, 2], in_cam[:, 1] / in_cam[:, 2]).max() <= 1 / np.sqrt(0.9)


@pytest.mark.parametrize("sigma_px", [0.05, 0.2, 1.0])
def test_noise_has_the_spread_asked_for(sigma_px):
    scene = make("ring_room")
    seen = observe(scene, rng=np.random.default_rng(3), sigma_px=sigma_px).observations
    px, _ = scene.cameras.img_from_world(seen.camera, scene.trajectory[seen.frame])
    error = (seen.px - px) / sigma_px
    # Each sum of n squares is chi-square with n degrees of freedom; the bounds fail once in 10^4 seeds.
    for axis in range(2):
        low, high = chi2.ppf([5e-5, 1 - 5e-5], len(seen))
        assert low < (error[:, axis] ** 2).sum() < high
    # The correlation of n independent pairs has a spread of 1 / sqrt(n), and so has each mean.
    assert abs((error[:, 0] * error[:, 1]).mean()) < 4 / np.sqrt(len(seen))
    assert np.abs(error.mean(axis=0)).max() < 4 / np.sqrt(len(seen))


def test_masks_tell_true_from_false_detections():
    scene = make("smart_room")
    full = observe(scene, rng=np.random.default_rng(5)).observations
    sighting = observe(scene, rng=np.random.default_rng(5), missing=0.3, false_detections=0.1)
    seen = sighting.observations
    n_full, n_seen = len(full), len(seen)
    # A binomial number stays within 4 of its standard deviations.
    assert abs(n_seen - 0.7 * n_full) < 4 * np.sqrt(n_full * 0.3 * 0.7)
    # Exactly a tenth is moved; chance lands within 1 px of the truth once in 640 * 480 / pi cases.
    assert round(0.1 * n_seen) - 2 <= (~sighting.is_true).sum() <= round(0.1 * n_seen)
    px, _ = scene.cameras.img_from_world(seen.camera, scene.trajectory[sighting.point])
    error_px = np.linalg.norm(seen.px - px, axis=1)
    assert error_px[~sighting.is_true].min() > 5 * 0.2
    # Rayleigh: 9000 draws exceed 6 sigma with a probability of 9000 exp(-18) = 1e-4.
    assert error_px[sighting.is_true].max() < 6 * 0.2
    assert scene.cameras.is_in_image(seen.camera[~sighting.is_true], seen.px[~sighting.is_true]).all()
    assert (sighting.point == seen.frame).all()


def test_usable_rows_are_true_and_have_true_company():
    sighting = observe(make("smart_room"), rng=np.random.default_rng(6), missing=0.6, false_detections=0.3)
    expected = [
        bool(sighting.is_true[k] and sighting.is_true[sighting.point == sighting.point[k]].sum() >= 2)
        for k in range(len(sighting.point))
    ]
    assert sighting.is_usable.tolist() == expected
    assert 0 < sum(expected) < sighting.is_true.sum()


def test_stray_pixel_on_the_spot_is_no_false_detection():
    # With sigma as large as the image no stray pixel is 5 sigma away.
    sighting = observe(make("stereo_only"), rng=np.random.default_rng(7), sigma_px=800.0, false_detections=0.5)
    assert sighting.is_true.all()


def test_noisy_pixels_are_not_clipped():
    scene = make("smart_room")
    seen = observe(scene, rng=np.random.default_rng(8), sigma_px=20.0).observations
    assert not scene.cameras.is_in_image(seen.camera, seen.px).all()


def test_stamps_are_frame_times():
    scene = make("smart_room")
    seen = observe(scene, rng=np.random.default_rng(0)).observations
    assert seen.stamp_ns is not None
    assert (seen.stamp_ns == seen.frame * 40_000_000).all()


@pytest.mark.parametrize("name", ROOM_NAMES)
def test_same_generator_state_gives_the_same_room_and_sighting(name):
    first, second, other = make(name, n_frames=50), make(name, n_frames=50), make(name, n_frames=50, seed=1)
    assert (first.trajectory == second.trajectory).all()
    assert (first.cameras.intrinsics == second.cameras.intrinsics).all()
    assert (first.cameras.centres_in_world == second.cameras.centres_in_world).all()
    assert not (first.trajectory == other.trajectory).all()
    sightings = [observe(first, rng=np.random.default_rng(2), missing=0.2, false_detections=0.1) for _ in range(2)]
    assert (sightings[0].observations.px == sightings[1].observations.px).all()


@pytest.mark.parametrize(
    ("name", "numbers", "message"),
    [
        ("ballroom", {}, "ballroom"),
        ("smart_room", {"n_cameras": 7}, "2 to 6"),
        ("stereo_only", {"n_cameras": 1}, "2 to 2"),
        ("smart_room", {"n_frames": 1}, "at least 2"),
    ],
)
def test_impossible_rooms_are_refused(name, numbers, message):
    with pytest.raises(InputError, match=message):
        make(name, **numbers)


def test_look_at_is_upright_in_opencv_axes():
    rotation = look_at(np.array([1.0, 2.0, 3.0]), np.array([1.0, 6.0, 3.0]))
    # Looking along +y with z up: right is +x, down is -z.
    np.testing.assert_allclose(rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)


def moved(cameras, rng, *, scale=1.0):
    """The cameras in a world that is turned, shifted and scaled at random."""
    turn = Rotation.random(rng=rng).as_matrix()
    centres = scale * cameras.centres_in_world @ turn.T + rng.uniform(-10, 10, 3)
    return cameras.with_poses(cameras.rotations @ turn.T, centres)


@settings(deadline=None)
@given(
    st.sampled_from(["smart_room", "stereo_only", "colinear_centres", "ring_room"]),
    st.floats(1e-2, 1e2),
    st.integers(0, 2**32 - 1),
)
def test_compare_is_blind_to_any_similarity_and_to_camera_order(name, scale, seed):
    rng = np.random.default_rng(seed)
    truth = make(name, n_frames=2).cameras
    order = rng.permutation(len(truth))
    shuffled = replace(
        truth,
        names=tuple(truth.names[i] for i in order),
        size_px=truth.size_px[order],
        lenses=tuple(truth.lenses[i] for i in order),
        intrinsics=truth.intrinsics[order],
        cam_from_world=truth.cam_from_world[order],
    )
    errors = compare(moved(shuffled, rng, scale=scale), truth)
    # A shift of 10 m is rounded to 2e-15 m; at a scale of 0.01 and a baseline of 0.3 m that is 6e-13 of the network.
    assert errors.names == shuffled.names
    assert errors.centre_m.max() < 1e-10
    assert errors.rotation_deg.max() < 1e-8
    assert errors.relative_scale == pytest.approx(scale, rel=1e-10)
    assert (errors.focal_px == 0).all()


@pytest.mark.parametrize("name", ["smart_room", "stereo_only", "colinear_centres"])
def test_rigid_alignment_keeps_the_scale_error(name):
    truth = make(name, n_frames=2).cameras
    errors = compare(moved(truth, np.random.default_rng(0), scale=1.1), truth, align="rigid")
    centres = truth.centres_in_world
    # About the common mean every centre is 10 % too far out.
    expected_m = 0.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1)
    np.testing.assert_allclose(errors.centre_m, expected_m, rtol=0, atol=1e-10)
    assert errors.relative_scale == pytest.approx(1.1, rel=1e-10)
    assert errors.rotation_deg.max() < 1e-8


def test_without_alignment_a_known_shift_and_turn_are_reported_as_they_are():
    truth = make("smart_room", n_frames=2).cameras
    turns = Rotation.from_rotvec(np.radians(2.0) * np.eye(3)[[0, 1, 2, 0, 1]]).as_matrix()
    estimate = truth.with_poses(turns @ truth.rotations, truth.centres_in_world + np.array([0.03, 0.04, 0.0]))
    errors = compare(estimate, truth, align="none")
    np.testing.assert_allclose(errors.centre_m, 0.05, rtol=0, atol=1e-12)
    np.testing.assert_allclose(errors.rotation_deg, 2.0, rtol=0, atol=1e-10)


def test_compare_finds_the_one_camera_that_was_turned_and_its_focal_length():
    truth = make("smart_room", n_frames=2).cameras
    rotations, intrinsics = truth.rotations.copy(), truth.intrinsics.copy()
    rotations[3] = Rotation.from_rotvec([0.0, np.radians(1.5), 0.0]).as_matrix() @ rotations[3]
    intrinsics[3, :2] += 7.0
    estimate = moved(
        replace(truth, intrinsics=intrinsics).with_poses(rotations, truth.centres_in_world),
        np.random.default_rng(2),
        scale=3.0,
    )
    errors = compare(estimate, truth)
    # The centres are untouched, so the alignment is exact and leaves everything to camera 3.
    np.testing.assert_allclose(errors.rotation_deg, [0, 0, 0, 1.5, 0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(errors.focal_px, [0, 0, 0, 7, 0], rtol=0, atol=1e-12)
    assert errors.centre_m.max() < 1e-10


def test_compare_finds_the_one_camera_that_was_moved():
    truth = make("ring_room", n_cameras=40, n_frames=2).cameras
    centres = truth.centres_in_world.copy()
    centres[7] += np.array([0.0, 0.0, 0.10])
    errors = compare(moved(truth.with_poses(truth.rotations, centres), np.random.default_rng(3)), truth)
    # Least squares gives a camera of 40 about 1/40 of the shift (mean) and of its turn and scale: (1 + 3 + 1) / 40 at
    # most for the camera itself, as much again for all others.
    assert np.argmax(errors.centre_m) == 7
    assert errors.centre_m[7] == pytest.approx(0.10, abs=0.10 * 5 / 40)
    assert np.delete(errors.centre_m, 7).max() < 0.10 * 5 / 40


def test_mirrored_world_is_not_mistaken_for_the_true_one():
    truth = make("smart_room", n_frames=2).cameras
    flip = np.diag([1.0, 1.0, -1.0])
    mirrored = truth.with_poses(flip @ truth.rotations @ flip, truth.centres_in_world @ flip)
    aligned, _ = align_cameras(mirrored, truth)
    # A rotation cannot undo a mirror: aligned frames stay right-handed and the errors large.
    np.testing.assert_allclose(np.linalg.det(aligned.rotations), 1.0, rtol=0, atol=1e-12)
    assert compare(mirrored, truth).rotation_deg.max() > 10


def test_compare_names_a_camera_that_the_truth_lacks():
    truth = make("smart_room", n_frames=2).cameras
    with pytest.raises(InputError, match="C9"):
        compare(replace(truth, names=("C0", "C1", "C2", "C3", "C9")), truth)


def test_compare_of_coincident_cameras_reports_no_scale_but_still_turns():
    truth = make("stereo_only", n_frames=2).cameras
    together = truth.with_poses(truth.rotations, np.zeros((2, 3)))
    errors = compare(together, truth)
    assert errors.relative_scale == 0
    np.testing.assert_allclose(errors.centre_m, 0.5 * make("stereo_only", n_frames=2).baseline_m, rtol=1e-9)
    assert errors.rotation_deg.max() < 1e-8
