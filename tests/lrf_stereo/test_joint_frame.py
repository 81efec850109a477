"""World frames, metric anchors and the scale of a joint solve, against the truth of a room of five cameras."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.joint_frame import GivenPositions, JointFrame, moved
from lrf_stereo.network import add_lrfs, calibrate_with_lrfs
from lrf_stereo.session import LrfSession
from lrf_stereo.synthetic import SampleNoise, paper_scene, sample
from network_calib.calibrate import calibrate
from network_calib.errors import ConvergenceError, DegenerateError, InputError
from network_calib.gauge import level_to_floor
from network_calib.room_setup import (
    CameraSetup,
    Knowledge,
    KnownCentres,
    KnownDistance,
    KnownPoints,
    Options,
)
from network_calib.synthetic import compare

ONCE = Options(n_repeats=1, holdout_share=0.0)
# Three numbers beyond this Mahalanobis distance are chance once in 10^5; one number beyond 4.4.
MAX_SIGMA, MAX_SIGMA_ONE = 5.1, 4.4
# Of the room's own frame: any place and turn will do.
WORLD = RigidTransform.from_components([3.0, 1.0, 2.5], Rotation.from_rotvec([0.3, -1.2, 0.4]))


@pytest.fixture(scope="module")
def scene():
    return paper_scene(rng=np.random.default_rng(4), n_spots_per_tilt=60, n_room_cameras=3)


@pytest.fixture(scope="module")
def samples(scene):
    return sample(scene, rng=np.random.default_rng(5), noise=SampleNoise())


@pytest.fixture(scope="module")
def session(samples):
    return LrfSession(("L0",), samples.spots, samples.settings)


@pytest.fixture(scope="module")
def setups(scene):
    cameras = scene.cameras
    return [
        CameraSetup(name, (int(size[0]), int(size[1])), lens, Knowledge.FIXED, row)
        for name, size, lens, row in zip(
            cameras.names, cameras.size_px, cameras.lenses, cameras.intrinsics, strict=True
        )
    ]


@pytest.fixture(scope="module")
def solved(samples, setups, session):
    """Calibrate with an anchor and options."""

    def run(anchor=None, options=ONCE):
        return calibrate_with_lrfs(samples.observations, setups, session, anchor=anchor, options=options)

    return run


@pytest.fixture(scope="module")
def by_ranges(solved):
    return solved()


def known_distance(scene, *, factor=1.0, sigma_m=0.002):
    centres = scene.cameras.centres_in_world
    return KnownDistance("C2", "C3", factor * float(np.linalg.norm(centres[2] - centres[3])), sigma_m)


def known_points(samples, n=5):
    """Frames that many cameras see, in another world."""
    seen = np.bincount(samples.observations.frame, minlength=len(samples.spots))
    frames = np.flatnonzero(seen >= 4)
    frames = frames[np.linspace(0, len(frames) - 1, n).astype(int)]
    return KnownPoints(tuple(frames.tolist()), WORLD.apply(samples.spots_in_world[frames]))


def known_centres(scene):
    rng = np.random.default_rng(6)
    centres = scene.cameras.centres_in_world
    return KnownCentres(scene.cameras.names, WORLD.apply(centres + 0.003 * rng.standard_normal(centres.shape)))


def in_first_camera(calibration):
    (lrf,) = calibration.lrfs
    return calibration.cameras[0].cam_from_world * lrf.world_from_lrf


def scale_error(calibration, scene):
    return compare(calibration.as_cameras(), scene.cameras).relative_scale - 1


def codes(calibration):
    return {doubt.code for doubt in calibration.warnings} - {"overlap"}


@pytest.mark.parametrize("anchor", ["distance", "points", "centres"])
def test_every_anchor_puts_the_lrf_where_it_is_beside_the_cameras(anchor, scene, samples, solved, by_ranges):
    given = {"distance": known_distance(scene), "points": known_points(samples), "centres": known_centres(scene)}
    calibration = solved(given[anchor])
    assert codes(calibration) == set()
    true = scene.scanner.world_from_lrf_at(
        scene.tilts_rad[0] + by_ranges.lrfs[0].reference_tilt_rad - by_ranges.lrfs[0].tilt_rad[0]
    )
    error = in_first_camera(calibration).translation - true.translation
    # The covariance of the solve by ranges is in the first camera's frame, and no anchor makes it larger.
    spread = by_ranges.lrfs[0].covariance[3:6, 3:6]
    assert error @ np.linalg.solve(spread, error) < MAX_SIGMA**2
    assert abs(scale_error(calibration, scene)) < MAX_SIGMA_ONE * calibration.world.scale_sigma
    # Ranges and anchor together know the scale better than the ranges alone.
    assert calibration.world.scale_sigma < by_ranges.world.scale_sigma


def test_scale_sigma_is_that_of_the_scale(scene, by_ranges, solved):
    assert by_ranges.world.scale_source == "the ranges of L0"
    assert abs(scale_error(by_ranges, scene)) < MAX_SIGMA_ONE * by_ranges.world.scale_sigma
    # 180 ranges of 4 mm (with the spot's own place) over 2 m each: 2e-3 / sqrt(180), times what pose and shape cost.
    assert 1.5e-4 < by_ranges.world.scale_sigma < 1.5e-3
    # An anchor that knows nothing adds nothing; one that knows all leaves the shape's share.
    vague = solved(known_distance(scene, sigma_m=1.0)).world.scale_sigma
    assert vague == pytest.approx(by_ranges.world.scale_sigma, rel=0.01)
    exact = solved(known_distance(scene, sigma_m=0.0)).world.scale_sigma
    assert exact < by_ranges.world.scale_sigma


@pytest.mark.parametrize("kind", ["points", "centres"])
def test_given_positions_are_met_as_well_as_a_rigid_motion_can(kind, scene, samples, solved):
    anchor = known_points(samples) if kind == "points" else known_centres(scene)
    calibration = solved(anchor)
    assert calibration.world.name == f"given {kind}"
    assert calibration.world.unit == "m"
    if isinstance(anchor, KnownCentres):
        found, given = np.array([camera.centre_in_world for camera in calibration.cameras]), anchor.centres_in_world_m
        error = found - given
        # Of the best motion the mean error and the mean moment are zero.
        assert np.abs(error.sum(axis=0)).max() < 1e-9
        assert np.abs(np.cross(given - given.mean(axis=0), error).sum(axis=0)).max() < 1e-9
        rms_m = np.sqrt((error**2).sum(axis=1).mean())
        assert f"5 given camera centres, met within {rms_m:.4g} m RMS, and the ranges of L0" == (
            calibration.world.scale_source
        )
    # Three coordinates of a spot or centre are off by 5 mm at most, over an extent of some metres.
    motion = calibration.cameras[0].cam_from_world.inv() * scene.cameras.cam_from_world[0] * WORLD.inv()
    assert motion.rotation.magnitude() < 0.02
    assert np.linalg.norm(motion.apply(WORLD.translation) - WORLD.translation) < 0.03


def test_given_positions_prefer_no_camera_in_the_covariance(scene, solved, by_ranges):
    calibration = solved(known_centres(scene))
    own, others = (
        [max(np.diag(camera.covariance)[3:6]) for camera in each.cameras] for each in (calibration, by_ranges)
    )
    # The first camera is as uncertain as any, where it names the frame it is not at all (but for rounding).
    assert own[0] > 0.05 * max(own)
    assert others[0] < 1e-9 * max(others)
    total = [sum(np.trace(camera.covariance[3:6, 3:6]) for camera in each.cameras) for each in (calibration, by_ranges)]
    # Inner constraints: the smallest covariance in the mean.
    assert total[0] < total[1]


@pytest.mark.parametrize("is_given", [False, True])
def test_floor_levels_cameras_and_lrf_alike(is_given, samples, solved, by_ranges):
    frames = (3, 70, 140, 171)
    anchor = known_points(samples) if is_given else None
    options = Options(n_repeats=1, holdout_share=0.0, floor_frames=frames)
    calibration = solved(anchor, options)
    assert calibration.world.name == "floor"
    first = calibration.cameras[0].centre_in_world
    assert np.abs(first[:2]).max() < 1e-9
    assert first[2] > 0
    # Levelled, and then nothing is left to level.
    again = level_to_floor(np.eye(3) * [1, 1, 0], calibration.as_cameras())
    assert np.abs(again.apply(first[None])[0] - first).max() < 1e-9
    if not is_given:
        # The same solve by another way: settled to 1e-5 sigma of 2 mm.
        difference = in_first_camera(calibration).inv() * in_first_camera(by_ranges)
        assert np.abs(difference.translation).max() < 1e-6
        assert difference.rotation.magnitude() < 1e-6


def test_floor_points_of_the_joint_solve_are_the_ones_that_are_levelled():
    rng = np.random.default_rng(1)
    scene = paper_scene(rng=rng)
    points = rng.uniform(-1, 1, (20, 3))
    frame = JointFrame(floor=np.array([2, 5, 11, 17]))
    motion = frame.world_from_solve(scene.cameras, points, scene.cameras.cam_from_world[0])
    height = motion.apply(points[frame.floor])[:, 2]
    assert abs(height.mean()) < 1e-12
    centred = points[frame.floor] - points[frame.floor].mean(axis=0)
    # The plane of least squares: what remains is the smallest singular value.
    assert np.linalg.norm(height) == pytest.approx(np.linalg.svd(centred, compute_uv=False)[2], rel=1e-9)


def test_drift_of_the_solve_leaves_no_trace():
    rng = np.random.default_rng(2)
    scene = paper_scene(rng=rng, n_room_cameras=3)
    points = rng.uniform(-1, 1, (20, 3))
    # A first camera that is not the origin: a floor was levelled before.
    cameras = moved(scene.cameras, RigidTransform.from_components([0.5, 0.1, 2.0], Rotation.from_rotvec([1.0, 0.2, 0])))
    drift = RigidTransform.from_components([0.1, -0.2, 0.3], Rotation.from_rotvec([0.1, 0.2, -0.1]))
    none = np.empty(0, dtype=int)
    given = GivenPositions(np.array([0, 2, 4]), none, WORLD.apply(cameras.centres_in_world[[0, 2, 4]]))
    for frame in (
        JointFrame(),
        JointFrame(given),
        JointFrame(given, np.array([1, 4, 9])),
        JointFrame(None, np.arange(5)),
    ):
        one = frame.world_from_solve(cameras, points, cameras.cam_from_world[0])
        other = frame.world_from_solve(moved(cameras, drift), drift.apply(points), cameras.cam_from_world[0])
        np.testing.assert_allclose((other * drift).as_matrix(), one.as_matrix(), atol=1e-9)
    stays = JointFrame().world_from_solve(cameras, points, cameras.cam_from_world[0])
    np.testing.assert_allclose(stays.as_matrix(), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(JointFrame(given).rms_m(moved(cameras, WORLD), WORLD.apply(points)), 0, atol=1e-12)


@pytest.mark.parametrize("percent", [1.0, -1.0])
def test_distance_that_contradicts_the_ranges_is_told_with_its_size(percent, scene, solved):
    calibration = solved(known_distance(scene, factor=1 + percent / 100))
    assert codes(calibration) >= {"lrf scale"}
    (doubt,) = (doubt for doubt in calibration.warnings if doubt.code == "lrf scale")
    assert doubt.message.startswith("LRF L0: its ranges are ")
    assert ("shorter" in doubt.message) == (percent > 0)
    size, sigma = (
        float(word) for word in doubt.message.removeprefix("LRF L0: its ranges are ").split(" %")[0].split(" ± ")
    )
    # Ranges are read against metres that are 1 % long: 1 % short, and more than 4 sigma, or it would not be told.
    assert abs(size - 1.0) < MAX_SIGMA_ONE * sigma
    assert size > 4 * sigma


def test_short_baseline_that_is_too_long_is_told_and_not_refused(solved):
    # 90 mm given as 94.5, as if exact. From so short a baseline the images know the room's scale to 0.7 %: 5 % are
    # seven sigma, and the pair gives way, not the room.
    calibration = solved(KnownDistance("C0", "C1", 0.0945, is_stereo_pair=True))
    assert "lrf scale" in codes(calibration)
    assert np.linalg.norm(calibration.cameras[1].centre_in_world) == pytest.approx(0.0945, rel=1e-4)
    (lrf,) = calibration.lrfs
    # One honest sighting in 10^4 is lost at 4 sigma; bent by the baseline, a few more may be.
    assert lrf.n_inliers > 0.95 * lrf.n_sightings


def test_ranges_without_an_anchor_have_nothing_to_contradict(samples, setups, session, by_ranges):
    long = replace(session, spots=replace(session.spots, range_m=1.05 * session.spots.range_m))
    calibration = calibrate_with_lrfs(samples.observations, setups, long, options=ONCE)
    assert codes(calibration) == set()
    sizes = [np.linalg.norm(each.cameras[2].centre_in_world) for each in (calibration, by_ranges)]
    # All lengths grow by the same, but for those that the tilt axis and the crossings know otherwise.
    assert sizes[0] / sizes[1] == pytest.approx(1.05, rel=0.005)


@pytest.mark.parametrize(
    ("factor", "metres"),
    [
        # Half of the sightings and more do not fit; what the cameras' shape gives way by is missing from 5 %.
        (1.05, r"only \d+ of 180 LRF sightings agree.*; and the cameras' metres are [345]\.\d % longer than"),
        # As given, to the 0.3 % that distances between spots tell.
        (1.2, r"; and the cameras' metres are (19|20)\.\d % longer than those of the ranges"),
    ],
)
def test_distance_that_no_sighting_allows_is_refused_with_the_reason(factor, metres, scene, solved):
    with pytest.raises((ConvergenceError, DegenerateError), match=metres) as caught:
        solved(known_distance(scene, factor=factor))
    assert "range_m" in caught.value.advice


def test_held_cameras_of_a_wrong_scale_are_told(scene, samples, setups, session):
    wrong = calibrate(
        samples.observations, setups, anchor=known_distance(scene, factor=1.01, sigma_m=0.0), options=ONCE
    )
    calibration = add_lrfs(wrong, samples.observations, session)
    assert "lrf scale" in codes(calibration)
    # With a sigma that allows for it there is nothing to tell, and the LRF's own sigma has it.
    vague = calibrate(
        samples.observations, setups, anchor=known_distance(scene, factor=1.01, sigma_m=0.05), options=ONCE
    )
    allowed = add_lrfs(vague, samples.observations, session)
    assert codes(allowed) == set()
    assert (allowed.lrfs[0].sigma[3:6] > calibration.lrfs[0].sigma[3:6]).all()


def test_anchor_of_an_unknown_camera_is_refused_before_anything_else(solved):
    with pytest.raises(InputError, match="'C9'"):
        solved(KnownCentres(("C0", "C1", "C9"), np.eye(3)))
