"""The simulated set-up is what it says: geometry exact, noise of the stated size, scans like a real scanner's."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import RigidTransform

from lrf_stereo.noise import NEIGHBOUR_CORRELATION, LrfNoise, correlated_noise, mean_variance_factor
from lrf_stereo.scanner import ScanSteps, TiltingScanner
from lrf_stereo.synthetic import BASELINE_M, BoxRoom, SampleNoise, paper_scene, sample, spots_on_plane
from lrf_stereo.synthetic_scans import FULL_PART, UNSEEN_PART, Capsule, ScannedRoom, ScanNoise
from network_calib.errors import InputError

STEPS = ScanSteps()


def rng(seed=0):
    return np.random.default_rng(seed)


# The scene


@pytest.mark.parametrize("mount_deg", [(0.0, 0.0), (1.0, 1.0)])
def test_spots_lie_on_their_scan_planes_in_view_of_the_pair_and_in_the_room(mount_deg):
    scene = paper_scene(rng=rng(), tilts_deg=(2, 12.1, 23.2, 35, 50), mount_deg=mount_deg)
    np.testing.assert_array_equal(np.bincount(scene.spot_tilt), [22] * 5)
    range_m, _, height_m = scene.scanner.measure(scene.spots_in_world, scene.tilts_rad[scene.spot_tilt])
    # Rotations of a few metres, each to 1e-16.
    np.testing.assert_allclose(height_m, 0, atol=1e-13)
    assert ((range_m > 1) & (range_m < 3.5)).all()
    assert scene.room.holds(scene.spots_in_world).all()
    for camera in (0, 1):
        index = np.full(110, camera)
        px, is_valid = scene.cameras.img_from_world(index, scene.spots_in_world)
        assert (is_valid & scene.cameras.is_in_image(index, px)).all()


def test_the_world_is_the_left_cameras_frame_and_the_pair_has_its_baseline():
    cameras = paper_scene(rng=rng()).cameras
    np.testing.assert_allclose(cameras.cam_from_world[0].as_matrix(), np.eye(4), atol=1e-15)
    np.testing.assert_allclose(cameras.centres_in_world[1], [BASELINE_M, 0, 0], atol=1e-15)


def test_the_scanner_has_the_stated_offsets_and_mount():
    scanner = paper_scene(rng=rng(), dx_m=0.05, dz_m=0.02, mount_deg=(1.0, -0.5)).scanner
    form = scanner.as_paper()
    np.testing.assert_allclose([form.dx_m, form.dz_m], [0.05, 0.02], atol=1e-12)
    np.testing.assert_allclose([form.mount_roll_rad, form.mount_yaw_rad], np.radians([1.0, -0.5]), atol=1e-12)


def test_in_the_five_camera_room_most_spots_are_seen_by_all():
    scene = paper_scene(rng=rng(), n_room_cameras=3, tilts_deg=(2, 12.1, 23.2, 35, 50))
    samples = sample(scene, rng=rng(1))
    assert samples.observations.n_cameras == 5
    n_views = np.bincount(samples.observations.frame)
    assert (n_views >= 2).all()
    assert np.mean(n_views == 5) > 0.9


@pytest.mark.parametrize("arguments", [{"n_room_cameras": 6}, {"tilts_deg": (-40.0,)}])
def test_what_cannot_be_built_is_refused(arguments):
    with pytest.raises(InputError):
        paper_scene(rng=rng(), **arguments)


# Samples


def test_exact_samples_are_the_truth():
    scene = paper_scene(rng=rng(), n_room_cameras=3)
    samples = sample(scene, rng=rng(1), noise=SampleNoise(scale=0.0))
    np.testing.assert_array_equal(samples.spots_in_world, scene.spots_in_world)
    tilts = samples.settings.angle_rad[samples.spots.setting]
    points = scene.scanner.points_in_world(samples.spots.range_m, samples.spots.bearing_rad, tilts)
    np.testing.assert_allclose(points, scene.spots_in_world, atol=1e-12)
    seen = samples.observations
    px, _ = scene.cameras.img_from_world(seen.camera, scene.spots_in_world[seen.frame])
    np.testing.assert_array_equal(seen.px, px)


def test_errors_have_the_stated_sizes():
    n = 3000
    scene = paper_scene(rng=rng(), n_spots_per_tilt=n // 3)
    samples = sample(scene, rng=rng(1))
    spots = samples.spots
    range_m, bearing, height = scene.scanner.measure(samples.spots_in_world, scene.tilts_rad[spots.setting])
    # 0.1 % and 99.9 % points of the mean square of n unit normals.
    low, high = stats.chi2.ppf([1e-3, 1 - 1e-3], n) / n
    assert low < np.mean(((spots.range_m - range_m) / spots.sigma_range_m) ** 2) < high
    assert low < np.mean((height / spots.sigma_out_of_plane_m) ** 2) < high
    np.testing.assert_allclose(spots.sigma_range_m, 2.25e-3 + 0.73e-3 * range_m, rtol=1e-12)
    error_steps = (spots.bearing_rad - bearing) / STEPS.step_rad
    assert np.abs(error_steps).max() <= 0.5 + 1e-9
    # The mean square of a uniform error is 1/12, with a variance of 1/180 over n.
    assert abs(np.mean(error_steps**2) - 1 / 12) < 4 * np.sqrt(1 / 180 / n)
    whole = STEPS.step(spots.bearing_rad)
    np.testing.assert_allclose(whole, np.round(whole), atol=1e-9)
    seen = samples.observations
    px, _ = scene.cameras.img_from_world(seen.camera, samples.spots_in_world[seen.frame])
    low, high = stats.chi2.ppf([1e-3, 1 - 1e-3], px.size) / px.size
    assert low < np.mean(((seen.px - px) / 0.3) ** 2) < high


def test_wrong_pairs_are_marked_exactly_and_far_from_the_spot():
    scene = paper_scene(rng=rng(), n_spots_per_tilt=100)
    samples = sample(scene, rng=rng(1), noise=SampleNoise(wrong_pairs=0.2, scale=0.0))
    assert (~samples.is_true).sum() == 60
    tilts = scene.tilts_rad[samples.spots.setting]
    points = scene.scanner.points_in_world(samples.spots.range_m, samples.spots.bearing_rad, tilts)
    distance = np.linalg.norm(points - samples.spots_in_world, axis=1)
    assert distance[samples.is_true].max() < 1e-12
    assert distance[~samples.is_true].min() > 0.1 - 1e-12


def test_a_one_sided_crossing_leaves_the_spots_below_the_plane_and_the_sightings_silent():
    scene = paper_scene(rng=rng())
    samples = sample(scene, rng=rng(1), noise=SampleNoise(out_of_plane_bias_m=-0.015, scale=0.0))
    _, _, height = scene.scanner.measure(samples.spots_in_world, scene.tilts_rad[samples.spots.setting])
    np.testing.assert_allclose(height, -0.015, atol=1e-12)
    assert (samples.spots.out_of_plane_m == 0).all()


def test_reported_tilts_err_as_stated():
    scene = paper_scene(rng=rng(), tilts_deg=(2, 12.1, 23.2, 35, 50), n_spots_per_tilt=2)
    noise = SampleNoise(lrf=LrfNoise(tilt_rad=2e-3))
    errors = [sample(scene, rng=rng(k), noise=noise).settings.angle_rad - scene.tilts_rad for k in range(100)]
    low, high = stats.chi2.ppf([1e-3, 1 - 1e-3], 500) / 500
    assert low < np.mean((np.array(errors) / 2e-3) ** 2) < high


def test_same_seed_same_samples():
    one, two = (sample(paper_scene(rng=rng(4)), rng=rng(5), noise=SampleNoise(wrong_pairs=0.1)) for _ in range(2))
    np.testing.assert_array_equal(one.observations.px, two.observations.px)
    np.testing.assert_array_equal(one.spots.range_m, two.spots.range_m)


# Noise


def test_neighbouring_beams_are_correlated_as_measured():
    noise = correlated_noise((400, 682), rng=rng())
    for lag, expected in enumerate((*NEIGHBOUR_CORRELATION, 0.0, 0.0)):
        measured = np.mean(noise[:, : 682 - lag] * noise[:, lag:])
        # Of 270,000 products fewer than 7 in a row are correlated: a standard error below sqrt(2 * 7 / 270000).
        assert abs(measured - expected) < 4 * np.sqrt(14 / 270_000)
    assert abs(np.mean(noise[1:] * noise[:-1])) < 4 * np.sqrt(14 / 270_000)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
def test_the_mean_of_neighbours_varies_as_the_factor_says(n):
    noise = correlated_noise((200_000, n), rng=rng())
    # The relative error of a variance from 200,000 draws is sqrt(2 / 200000) = 0.3 %.
    assert noise.mean(axis=1).var() == pytest.approx(mean_variance_factor(n), rel=0.0127)


# Scans


def a_scanned_room(**noise):
    return ScannedRoom.of(paper_scene(rng=rng()), rng=rng(1), noise=ScanNoise(**noise))


def a_bare_room(size_m=2.0):
    """A scanner in the middle of a cube whose walls are `size_m` away, without any fault."""
    scanner = TiltingScanner.from_paper(RigidTransform.identity(), 0.0, 0.0)
    room = BoxRoom(RigidTransform.identity(), np.full(3, -size_m), np.full(3, size_m))
    noise = ScanNoise(LrfNoise(0.0, 0.0, 0.0), dead_share=0.0, dropout=0.0, error_codes=0.0)
    return ScannedRoom(room, scanner, STEPS, noise, np.zeros(STEPS.n_measured, dtype=bool))


def beam_at(bearing_rad):
    return int(np.round(STEPS.step(bearing_rad))) - STEPS.first_step


def test_walls_are_where_they_are():
    ranges, part = a_bare_room().true_ranges(0.0)
    assert (part == 0).all()
    for bearing_deg, expected in ((0, 2.0), (90, 2.0), (-90, 2.0), (45, 2 * np.sqrt(2))):
        assert ranges[beam_at(np.radians(bearing_deg))] == pytest.approx(expected, abs=1e-12)
    # Tilted down by 60 degrees the forward beam meets the floor, 2 m below, after 2 / sin 60.
    tilted, _ = a_bare_room().true_ranges(np.radians(60))
    assert tilted[beam_at(0.0)] == pytest.approx(2 / np.sin(np.radians(60)), abs=1e-12)


def test_a_ball_and_a_pole_are_hit_on_their_near_side():
    ball = Capsule.ball(np.array([1.5, 0.0, 0.0]), diameter_m=0.2)
    pole = Capsule(np.array([0.0, 1.2, -1.0]), np.array([0.0, 1.2, 1.0]), 0.05)
    ranges, part = a_bare_room().true_ranges(0.0, [ball, pole])
    front, left = beam_at(0.0), beam_at(np.pi / 2)
    assert part[[front, left]] == pytest.approx(1.0)
    # Within a beam of 2.5 mrad (1 sigma) the surface recedes by x^2 / 2r in each direction: 0.12 mm in all for the ball
    # of 0.1 m at 1.4 m, 0.08 mm for the pole of 0.05 m at 1.15 m; the beam's middle is up to half a step aside: 0.1 mm.
    assert ranges[front] == pytest.approx(1.4, abs=3e-4)
    assert ranges[left] == pytest.approx(1.15, abs=3e-4)
    # The ball spans 2 asin(0.1 / 1.5) = 133.4 mrad = 21.7 steps.
    assert abs((part[front - 30 : front + 31] > 0.5).sum() - 21.7) <= 1


def test_a_body_out_of_the_scan_plane_is_not_seen_before_it_touches_the_beam():
    room = a_bare_room()
    for height, is_seen in ((0.019, True), (0.035, False)):
        _, part = room.true_ranges(0.0, [Capsule.ball(np.array([1.5, 0.0, height]))])
        assert (part.max() > UNSEEN_PART) == is_seen


def test_edges_mix_the_ball_with_the_wall():
    room = a_bare_room()
    ranges, part = room.true_ranges(0.0, [Capsule.ball(np.array([1.5, 0.003, 0.0]), diameter_m=0.3)])
    is_mixed = (part > UNSEEN_PART) & (part < FULL_PART)
    walls, _ = room.true_ranges(0.0)
    assert is_mixed.sum() in (1, 2, 3, 4)
    assert (ranges[is_mixed] > 1.36).all()
    assert (ranges[is_mixed] < walls[is_mixed]).all()
    np.testing.assert_array_equal(ranges[part <= UNSEEN_PART], walls[part <= UNSEEN_PART])


def test_a_scan_has_the_codes_and_noise_of_the_device():
    # Tilted by 50 degrees every beam but the sideward ones meets the floor within the device's reach.
    scanned, tilt = a_scanned_room(), float(np.radians(50))
    scans = np.stack([scanned.readings_mm(tilt, rng=rng(k)) for k in range(100)])
    true, _ = scanned.true_ranges(tilt)
    is_range = STEPS.is_range(scans)
    in_reach = true < 5.4
    assert set(scans[~is_range]) == {0, 1, 6, 7, 10}
    # Dead stretches end within 15 steps of their share of 14 %; 2 % drop out, 0.4 % are other codes.
    assert 0.15 < 1 - is_range[:, in_reach].mean() < 0.20
    others = np.isin(scans, [1, 6, 7, 10]).mean()
    assert abs(others - 0.004) < 5 * np.sqrt(0.004 / scans.size)
    alive = in_reach & ~scanned.is_dead
    errors = np.where(is_range, 1e-3 * scans - true, np.nan)[:, alive]
    # Rounding to millimetres adds 1/12 mm^2; ten thousands of numbers, correlated over a few steps.
    expected = np.sqrt(scanned.noise.lrf.range_m(true[alive]) ** 2 + 1e-6 / 12)
    assert np.nanmean((errors / expected) ** 2) == pytest.approx(1.0, abs=0.05)


def test_a_dead_background_gives_no_range_but_a_body_in_front_of_it_does():
    scanned = a_scanned_room(dead_share=0.14, dropout=0.0, error_codes=0.0)
    tilt = float(np.radians(23.2))
    beam = int(np.flatnonzero(scanned.is_dead & (np.abs(STEPS.bearings_rad) < 0.5))[2])
    centre = scanned.scanner.points_in_world(2.0, STEPS.bearings_rad[beam], tilt)
    assert scanned.readings_mm(tilt, rng=rng())[beam] == 0
    with_ball = scanned.readings_mm(tilt, [Capsule.ball(centre)], rng=rng())
    assert abs(with_ball[beam] - 1980) < 5 * 3.7 + 2


def test_a_series_shows_the_body_where_it_is_when_the_mirror_points_at_it():
    room = a_bare_room()

    def at(time_s):
        return (Capsule.ball(np.array([1.0 + time_s, 0.0, 0.0])),)

    stamps, scans = room.series_mm(0.0, at, 5, rng=rng())
    np.testing.assert_allclose(stamps, 0.1 * np.arange(5))
    # The forward step is measured 37.5 ms after step 0; 20 mm from centre to surface.
    expected = 1e3 * (1.0 + stamps + 0.0375) - 20
    np.testing.assert_allclose(scans[:, beam_at(0.0)], expected, atol=1.1)


def test_spots_can_be_drawn_on_the_plane_of_any_tilt_for_evaluation():
    scene = paper_scene(rng=rng())
    spots = spots_on_plane(scene.cameras, scene.scanner, float(np.radians(30)), 50, room=scene.room, rng=rng(2))
    _, _, height = scene.scanner.measure(spots, np.radians(30))
    np.testing.assert_allclose(height, 0, atol=1e-13)
