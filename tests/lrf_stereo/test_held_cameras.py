"""What held cameras are wrong by goes into the LRF's covariance: by re-solving, by Monte Carlo, as a law."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lrf_stereo.calibrate import calibrate_lrfs
from lrf_stereo.held_cameras import CameraSpread, Sensitivity, with_camera_errors
from lrf_stereo.joint_data import LrfData
from lrf_stereo.lrf_priors import InstrumentSigma
from lrf_stereo.network import add_lrfs, calibrate_with_lrfs
from lrf_stereo.refine import lrf_covariance, refine_jointly
from lrf_stereo.session import LrfSession
from lrf_stereo.study_data import StudyData
from lrf_stereo.synthetic import SampleNoise, paper_scene, sample
from network_calib.calibrate import calibrate
from network_calib.camera_block import cameras_of
from network_calib.camera_parameters import CameraParameters
from network_calib.room_setup import CameraSetup, Knowledge, KnownDistance, Options

N_RUNS = 60
# A turn of half a milliradian, a baseline of 90 mm to 0.3 mm, a focal length to half a pixel: as good as the LRF.
C1_SIGMA = np.array([*(5e-4,) * 3, *(3e-4,) * 3, 0.5, 0, 0.3, 0.3, 0, 0, 0, 0])
ONCE = Options(n_repeats=1, holdout_share=0.0)


def stereo_spread(scale=1.0):
    """C0 names the frame; of C1 all is uncertain, and correlated."""
    rng = np.random.default_rng(3)
    mixed = np.linalg.qr(rng.standard_normal((14, 14)))[0]
    root = scale * C1_SIGMA[:, None] * (0.8 * np.eye(14) + 0.6 * mixed)
    return CameraSpread(np.stack([np.zeros((14, 14)), root @ root.T]), 0.0, np.zeros(3)), root


def with_moved_camera(network, camera, step):
    """The network with a camera that is off by a tangent step (14,); the spots are located by it."""
    columns = np.full((len(network.cameras), 14), -1)
    columns[camera] = np.arange(14)
    parameters = CameraParameters.from_cameras(network.cameras, columns)
    return replace(network, cameras=parameters.retract(step).apply_to(network.cameras))


@cache
def a_session(seed, **scene):
    rng = np.random.default_rng(seed)
    built = paper_scene(rng=rng, **scene)
    return StudyData.of(built, sample(built, rng=rng))


def refined(data, network, **options):
    return refine_jointly(network, (data.scene.scanner,), data.spots, data.settings, rejection=30.0, **options)


def scanner_step(found, other):
    """(6,) turn and shift from one solve's scanner to another's, as in the tangent."""
    a, b = (each.scanners[0].world_from_lrf for each in (found, other))
    return np.concatenate([(b.rotation * a.rotation.inv()).as_rotvec(), b.translation - a.translation])


@pytest.mark.parametrize("parameter", [1, 3, 5, 6, 8])
def test_sensitivity_is_what_solving_again_does(parameter):
    data = a_session(1)
    found = refined(data, data.network)
    lrf = LrfData.of(data.spots, data.settings, data.network.views)
    predicted = Sensitivity.at(found, data.network, lrf).by_camera[:6, 1, parameter]
    step = np.zeros(14)
    step[parameter] = 0.2 * C1_SIGMA[parameter]
    ahead, behind = (refined(data, with_moved_camera(data.network, 1, sign * step)) for sign in (1, -1))
    by_solving = (scanner_step(found, ahead) - scanner_step(found, behind)) / (2 * step[parameter])
    # Gauss-Newton leaves out second derivatives times residuals of one sigma: a few percent of the largest.
    assert np.abs(by_solving - predicted).max() < 0.05 * np.abs(predicted).max()


def test_camera_errors_are_in_the_stated_covariance():
    spread, root = stereo_spread()
    squared, alone, surplus = [], [], []
    for run in range(N_RUNS):
        rng = np.random.default_rng((11, run))
        scene = paper_scene(rng=rng)
        data = StudyData.of(scene, sample(scene, rng=rng))
        network = with_moved_camera(data.network, 1, root @ rng.standard_normal(14))
        found = refined(data, network)
        lrf = LrfData.of(data.spots, data.settings, network.views)
        given_cameras = lrf_covariance(found)
        stated = with_camera_errors(given_cameras, spread, found, network, lrf).scanners[0, :6, :6]
        scanner = found.scanners[0]
        true = scene.scanner.world_from_lrf_at(scanner.reference_tilt_rad)
        error = np.concatenate(
            [
                (scanner.world_from_lrf.rotation * true.rotation.inv()).as_rotvec(),
                scanner.world_from_lrf.translation - true.translation,
            ]
        )
        own = given_cameras.scanners[0, :6, :6]
        squared.append(error @ np.linalg.solve(stated, error))
        alone.append(error @ np.linalg.solve(own, error))
        added = Sensitivity.at(found, network, lrf).misfit(spread)
        surplus.append((found.chi2 - found.dof - added) / (added + np.sqrt(found.dof)))
    # Chi-square of 6 dof has mean 6 and variance 12; within four deviations of the mean.
    assert np.mean(squared) == pytest.approx(6.0, abs=4 * np.sqrt(12 / N_RUNS))
    # Without them it would not be.
    assert np.mean(alone) > 6.0 + 4 * np.sqrt(12 / N_RUNS)
    # A sum of one noise and one of C1: standard deviation below sqrt(2) times the scale that it is divided by.
    assert abs(np.mean(surplus)) < 4 * np.sqrt(2 / N_RUNS)


def test_camera_errors_within_their_sigma_raise_no_doubt():
    spread, _ = stereo_spread(4.0)
    data = a_session(12)
    # Two sigma of the turn about x: it moves rows by 1 px, where 0.3 px are expected, and there is no parallax in y.
    network = with_moved_camera(data.network, 1, 2 * np.sqrt(spread.cameras[1, 0, 0]) * np.eye(14)[0])
    known, unknown = (
        calibrate_lrfs(network, data.spots, data.settings, rng=np.random.default_rng(0), held=held)
        for held in (spread, None)
    )
    assert known.doubts == ()
    assert unknown.doubts != ()


@given(st.integers(0, 10_000), st.floats(0, 1))
def test_bound_holds_for_every_correlation_between_cameras(seed, common):
    rng = np.random.default_rng(seed)
    n, n_cameras = 5, 4
    own = np.eye(n) + np.diag(rng.uniform(0, 5, n))
    by_camera = rng.standard_normal((n, n_cameras, 14))
    # Some errors that all cameras share and some of their own; the first camera has none.
    shared, single = rng.standard_normal((n_cameras, 14, 3)), rng.standard_normal((n_cameras, 14, 14))
    root = np.concatenate([common * shared, (1 - common) * single], axis=2)
    root[0] = 0
    sensitivity = Sensitivity(by_camera, np.zeros((n_cameras, 14, n_cameras, 14)), np.zeros((n_cameras, 3)))
    spread = CameraSpread(root @ root.transpose(0, 2, 1), 0.0, np.zeros(3))
    bound = sensitivity.covariance(spread, own)
    together = np.einsum("nck,ckm->nm", by_camera, common * shared * (np.arange(n_cameras) > 0)[:, None, None])
    apart = [(1 - common) * by_camera[:, c] @ single[c] for c in range(1, n_cameras)]
    true = together @ together.T + sum(each @ each.T for each in apart)
    assert np.linalg.eigvalsh(bound - true)[0] > -1e-9 * np.trace(bound)


def test_one_uncertain_camera_gives_its_covariance_itself():
    rng = np.random.default_rng(1)
    by_camera = rng.standard_normal((5, 2, 14))
    spread, root = stereo_spread()
    sensitivity = Sensitivity(by_camera, np.zeros((2, 14, 2, 14)), np.zeros((2, 3)))
    moved = by_camera[:, 1] @ root
    np.testing.assert_allclose(sensitivity.covariance(spread, np.eye(5)), moved @ moved.T, rtol=1e-9, atol=1e-12)


def test_scale_of_all_cameras_moves_the_lrf_along():
    data = a_session(1, n_room_cameras=3)
    lrf = LrfData.of(data.spots, data.settings, data.network.views)
    found = refined(data, data.network)
    centres = data.network.cameras.centres_in_world
    spread = CameraSpread(np.zeros((5, 14, 14)), 0.002, centres[0])
    stated = Sensitivity.at(found, data.network, lrf).covariance(spread, np.eye(10))
    larger = data.network.cameras.with_poses(
        data.network.cameras.rotations, centres[0] + 1.002 * (centres - centres[0])
    )
    step = scanner_step(found, refined(data, replace(data.network, cameras=larger)))
    np.testing.assert_allclose(np.sqrt(np.diag(stated)[:6]), np.abs(step), rtol=0.1, atol=0.05 * np.abs(step[3:]).max())


def test_cross_covariance_is_that_of_scanner_and_camera():
    data = a_session(1)
    spread, _ = stereo_spread()
    found = calibrate_lrfs(data.network, data.spots, data.settings, rng=np.random.default_rng(0), held=spread)
    cross, scanner = found.covariance.camera_scanner[0], found.covariance.scanners[0]
    assert cross.shape == (2, 14, len(scanner))
    assert not cross[0].any()
    # Given C1, what is left is the LRF's own covariance: the Schur complement.
    free = np.flatnonzero(np.diag(scanner) > 0)
    seen = np.flatnonzero(np.diag(spread.cameras[1]) > 0)
    part = cross[1][np.ix_(seen, free)]
    left = scanner[np.ix_(free, free)] - part.T @ np.linalg.solve(spread.cameras[1][np.ix_(seen, seen)], part)
    own = lrf_covariance(found.refined).scanners[0]
    np.testing.assert_allclose(left, own[np.ix_(free, free)], rtol=1e-4, atol=1e-4 * np.diag(own).max())


def test_free_cameras_have_their_cross_covariance_from_the_joint_solve():
    data = a_session(4, n_room_cameras=3)
    network = replace(data.network, is_held=False)
    found = refined(data, network, instrument=InstrumentSigma(range_bias_m=0.01))
    spread = lrf_covariance(found)
    cameras = cameras_of(found.state.parts)
    first, columns = cameras.size, cameras.columns[3, :6]
    expected = spread.joint[np.ix_(columns, first + np.arange(11))]
    # Ten of pose and axis, then the range bias, which stands behind the tilt gain that is held.
    np.testing.assert_array_equal(spread.camera_scanner[0, 3, :6][:, [*range(10), 11]], expected)
    assert not spread.camera_scanner[0, :, :, 10].any()
    assert spread.points.shape == (np.isfinite(found.points).all(axis=1).sum(), 3, 3)


@pytest.fixture(scope="module")
def room():
    scene = paper_scene(rng=np.random.default_rng(4), n_spots_per_tilt=60)
    samples = sample(scene, rng=np.random.default_rng(5), noise=SampleNoise())
    setups = [
        CameraSetup(name, (320, 240), lens, Knowledge.FIXED, row)
        for name, lens, row in zip(scene.cameras.names, scene.cameras.lenses, scene.cameras.intrinsics, strict=True)
    ]
    return samples, setups, LrfSession(("L0",), samples.spots, samples.settings)


def test_result_of_cameras_alone_carries_scale_apart_and_of_a_joint_solve_within(room):
    samples, setups, session = room
    vague = KnownDistance("C0", "C1", 0.09, 0.0009, is_stereo_pair=True)
    alone = calibrate(samples.observations, setups, anchor=vague, options=ONCE)
    spread = CameraSpread.of(alone)
    assert spread.scale_sigma == pytest.approx(0.01)
    np.testing.assert_allclose(spread.fixed_point, 0, atol=1e-12)
    exact = replace(alone, world=replace(alone.world, scale_sigma=0.0))
    sigma = [add_lrfs(each, samples.observations, session).lrfs[0].sigma[:10] for each in (alone, exact)]
    assert (sigma[0] > sigma[1]).all()
    # The joint solve has the scale in its covariances: it must not be counted once more.
    joint = calibrate_with_lrfs(samples.observations, setups, session, anchor=vague, options=ONCE)
    assert joint.world.scale_sigma > 0
    assert CameraSpread.of(joint).scale_sigma == 0


def test_frame_of_given_positions_grows_about_the_middle_of_the_cameras(room):
    samples, setups, _ = room
    alone = calibrate(samples.observations, setups, anchor=KnownDistance("C0", "C1", 0.09), options=ONCE)
    uncertain = replace(alone.cameras[0], covariance=np.eye(14))
    spread = CameraSpread.of(replace(alone, cameras=(uncertain, *alone.cameras[1:])))
    np.testing.assert_allclose(spread.fixed_point, alone.as_cameras().centres_in_world.mean(axis=0))
