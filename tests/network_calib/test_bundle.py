"""The joint engine: right optimum, whatever the order and the gauge; and quick along curved valleys."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from network_calib import bundle
from network_calib.blocks import Problem, State
from network_calib.bundle import SolverOptions, covariance, solve
from network_calib.camera_block import PART, cameras_of
from network_calib.camera_parameters import CameraParameters, free_columns
from network_calib.cameras import LensModel
from network_calib.errors import ConvergenceError
from network_calib.priors import lens_prior
from network_calib.robust_loss import CauchyLoss, HuberLoss
from network_calib.spots import SpotViews
from network_calib.synthetic import compare
from network_calib.triangulate import triangulate
from tests.network_calib.scenes import (
    SIGMA_PX,
    block_of,
    camera_block,
    joint_problem,
    perturbed,
    setups_of,
    waved,
)

TIGHT = SolverOptions(cost_tolerance=1e-13)


def cameras_at(state, cameras):
    return cameras_of(state.parts).apply_to(cameras)


def peer_residuals(problem, start):
    """Residuals as a function of one flat vector, each measurement scaled so that half its square is half its loss."""
    block = block_of(problem)
    n = start.n_shared

    def residuals(x):
        state = start.retract(x[:n], x[n:].reshape(-1, 3).T)
        whitened = block.residual(state.parts, state.points[:, block.point], slice(0, len(block.point)))
        s = np.maximum((whitened**2).sum(axis=0), 1e-300)
        parts = [(whitened * np.sqrt(block.loss.cost(s) / s)).ravel()]
        parts += [shared.linearise(state.parts)[0] for shared in problem.shared_blocks]
        return np.concatenate(parts)

    return residuals


@pytest.mark.parametrize("loss", [CauchyLoss(2.4), HuberLoss(1.5)])
def test_optimum_is_that_of_scipy(loss):
    scene, seen = waved("ring_room", n_cameras=4, n_frames=60)
    problem, state, _ = joint_problem(scene, seen)
    block = block_of(problem)
    # A twentieth of the detections are wrong by 1 px, five sigma: far out in both losses, yet with one optimum.
    rng = np.random.default_rng(0)
    px = block.px + np.where(rng.random(len(block.point)) < 0.05, rng.standard_normal(block.px.shape), 0.0)
    problem = replace(problem, point_blocks=[replace(block, px=px, loss=loss)])
    start = perturbed(state, size=0.1)
    found = solve(problem, start, TIGHT)
    assert found.has_converged
    n = start.n_shared
    peer = least_squares(
        peer_residuals(problem, start),
        np.zeros(n + start.points.size),
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-12,
        max_nfev=100,
    )
    # The peer has differences for derivatives and wanders along the free gauge: it stops within 1e-5, and never below.
    assert found.cost <= peer.cost * (1 + 1e-9)
    assert peer.cost == pytest.approx(found.cost, rel=1e-5)
    peer_state = start.retract(peer.x[:n], peer.x[n:].reshape(-1, 3).T)
    # Where the cost is d above a quadratic minimum, a parameter is at most sqrt(2 d) of its sigma off. Robust weights
    # make the Hessian a little smaller than the one behind the sigma: twice that.
    sigma = np.sqrt(np.diag(covariance(problem, found.state).shared))[cameras_of(start.parts).columns[:, 6]]
    offset = cameras_of(peer_state.parts).optics[:, 0] - cameras_of(found.state.parts).optics[:, 0]
    assert (np.abs(offset) < 2 * np.sqrt(2 * (peer.cost - found.cost)) * sigma).all()


def test_exact_data_are_explained_exactly():
    scene, _ = waved("ring_room", n_cameras=4, n_frames=100)
    problem, state, views = joint_problem(scene, waved("ring_room", n_cameras=4, n_frames=100)[1], has_prior=False)
    px, _ = scene.cameras.img_from_world(views.camera, scene.trajectory[views.frames][views.point])
    block = block_of(problem)
    exact = Problem([replace(block, px=np.ascontiguousarray(px.T))], (), problem.gauge)
    found = solve(exact, perturbed(state), TIGHT)
    errors = compare(cameras_at(found.state, scene.cameras), scene.cameras)
    # Pixels of some 500 with 16 digits, conditioned by 1e4 (a focal length's sigma over a pixel's, times sqrt of 1e3).
    assert errors.centre_m.max() < 1e-7
    assert np.abs(errors.focal_px).max() < 1e-5


def test_a_similarity_of_the_start_changes_nothing_but_the_frame():
    scene, seen = waved("smart_room", n_frames=200)
    problem, state, _ = joint_problem(scene, seen)
    start = perturbed(state)
    turn, shift, scale = Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix(), np.array([10.0, -4.0, 7.0]), 0.2
    parameters = cameras_of(start.parts)
    moved = CameraParameters(
        parameters.rotations @ turn.T,
        scale * parameters.centres @ turn.T + shift,
        parameters.optics,
        parameters.is_fisheye,
        parameters.columns,
    )
    moved_start = State({PART: moved}, scale * turn @ start.points + shift[:, None])
    found, other = solve(problem, start, TIGHT), solve(problem, moved_start, TIGHT)
    assert other.cost == pytest.approx(found.cost, rel=1e-9)
    errors = compare(cameras_at(other.state, scene.cameras), cameras_at(found.state, scene.cameras))
    # Costs of some 600 that agree to 1e-9 leave a parameter within 1e-3 of its sigma of some cm and px.
    assert errors.centre_m.max() < 5e-5
    assert np.abs(errors.focal_px).max() < 5e-3
    assert errors.relative_scale == pytest.approx(scale, rel=0.2)  # the solve leaves the gauge near where it began


def test_order_of_cameras_and_of_observations_changes_nothing():
    scene, seen = waved("smart_room", n_frames=200)
    problem, state, _ = joint_problem(scene, seen, has_prior=False)
    start = perturbed(state)
    found = solve(problem, start, TIGHT)
    block = block_of(problem)
    rng = np.random.default_rng(3)
    order = rng.permutation(5)  # new camera i is the old one order[i]
    number = np.argsort(order)
    old = cameras_of(start.parts)
    columns = free_columns(
        (LensModel.K1_K2,) * 5,
        is_pose_fixed=np.zeros(5, dtype=bool),
        is_intrinsics_fixed=np.zeros(5, dtype=bool),
        groups=np.arange(5),
    )
    parameters = CameraParameters(
        old.rotations[order], old.centres[order], old.optics[order], old.is_fisheye[order], columns
    )
    point_order = rng.permutation(start.points.shape[1])
    rows = rng.permutation(len(block.point))
    shuffled = block.take(rows)
    shuffled = replace(shuffled, group=number[shuffled.group], point=np.argsort(point_order)[shuffled.point])
    shuffled = replace(shuffled, columns=columns)
    other = solve(
        Problem([shuffled], (), problem.gauge), State({PART: parameters}, start.points[:, point_order]), TIGHT
    )
    # Only the order of summation differs.
    assert other.cost == pytest.approx(found.cost, rel=1e-9)
    ours, theirs = cameras_of(found.state.parts), cameras_of(other.state.parts)
    np.testing.assert_allclose(theirs.optics[number], ours.optics, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(theirs.centres[number], ours.centres, atol=1e-4)


def test_same_input_gives_the_same_digits():
    problem, state, _ = joint_problem(*waved("smart_room", n_frames=200))
    first, second = (solve(problem, perturbed(state)) for _ in range(2))
    assert first.cost == second.cost
    np.testing.assert_array_equal(cameras_of(first.state.parts).optics, cameras_of(second.state.parts).optics)


def a_far_start(scene, seen):
    """Nothing known of the lenses: focal lengths 15 % long, image centre, no distortion. Poses true, spots by them."""
    views = SpotViews.of(seen.observations)
    setups = setups_of(scene)
    intrinsics = np.stack([setup.nominal_intrinsics() for setup in setups])
    intrinsics[:, :2] = 1.15 * scene.cameras.intrinsics[:, :2]
    problem, state, _ = joint_problem(replace_cameras(scene, intrinsics), seen, loss=CauchyLoss(2.4))
    ray_xy = (views.px - intrinsics[views.camera, 2:4]) / intrinsics[views.camera, :2]
    points, is_valid = triangulate(
        views.camera,
        views.point,
        ray_xy,
        scene.cameras.rotations,
        scene.cameras.centres_in_world,
        views.n_points,
    )
    assert is_valid.all()
    return problem, State(state.parts, np.ascontiguousarray(points.T))


def replace_cameras(scene, intrinsics):
    return replace(scene, cameras=replace(scene.cameras, intrinsics=intrinsics))


def test_curved_valley_takes_few_iterations_thanks_to_the_acceleration(monkeypatch):
    # Cameras on a ring that look at one place: focal length trades for distance, principal point for rotation.
    rooms = [waved("ring_room", n_cameras=3, n_frames=300, seed=seed) for seed in range(3)]
    starts = [a_far_start(scene, seen) for scene, seen in rooms]
    found = [solve(problem, start) for problem, start in starts]
    for (scene, _), (_, start), end in zip(rooms, starts, found, strict=True):
        assert end.has_converged
        assert end.n_iterations < 25
        # At the end of the valley: the focal lengths are within some of their sigma of 1 px, from 70 px off.
        assert np.abs(compare(cameras_at(end.state, scene.cameras), scene.cameras).focal_px).max() < 5
        assert np.abs(compare(cameras_at(start, scene.cameras), scene.cameras).focal_px).max() > 60
    monkeypatch.setattr(bundle, "_accelerated", lambda _assembler, _state, _model, _system, step: step)
    plain = [solve(problem, start) for problem, start in starts]
    np.testing.assert_allclose([end.cost for end in plain], [end.cost for end in found], rtol=1e-5)
    assert sum(end.n_iterations for end in plain) > sum(end.n_iterations for end in found)


def test_convergence_is_not_claimed_when_iterations_run_out():
    problem, state, _ = joint_problem(*waved("smart_room", n_frames=60))
    found = solve(problem, perturbed(state), SolverOptions(max_iterations=2))
    assert not found.has_converged
    assert found.n_iterations == 2


def test_cost_is_that_of_the_residuals_and_falls():
    problem, state, _ = joint_problem(*waved("smart_room", n_frames=60), loss=HuberLoss(1.0))
    start = perturbed(state)
    block = block_of(problem)
    whitened = block.residual(start.parts, start.points[:, block.point], slice(0, len(block.point)))
    prior, _ = problem.shared_blocks[0].linearise(start.parts)
    expected = 0.5 * (HuberLoss(1.0).cost((whitened**2).sum(axis=0)).sum() + prior @ prior)
    found = solve(problem, start, SolverOptions(max_iterations=1))
    assert found.cost < expected
    still = solve(problem, found.state, SolverOptions(max_iterations=1, initial_damping=1e9))
    assert still.cost == pytest.approx(found.cost, rel=1e-3)


def test_a_start_with_a_spot_behind_a_camera_is_refused():
    problem, state, _ = joint_problem(*waved("smart_room", n_frames=60))
    with pytest.raises(ConvergenceError, match="behind"):
        solve(problem, State(state.parts, state.points + np.array([[0], [0], [100.0]])))


def test_fixed_cameras_stay_and_spots_are_found():
    scene, seen = waved("smart_room", n_frames=60)
    _, state, views = joint_problem(scene, seen)
    columns = np.full((5, 14), -1)
    parameters = CameraParameters.from_cameras(scene.cameras, columns)
    block = camera_block(views.camera, views.point, views.px, columns)
    found = solve(Problem([block]), State({PART: parameters}, state.points + 0.05), TIGHT)
    np.testing.assert_array_equal(cameras_of(found.state.parts).optics, parameters.optics)
    error_m = np.linalg.norm(found.state.points - state.points, axis=0)
    # A pixel's 0.2 px at 450 px and up to 6 m is 3 mm; two views with a narrow base lose another factor of ten.
    assert np.median(error_m) < 0.005
    assert error_m.max() < 0.15


def test_priors_hold_what_the_data_leave_open():
    scene, seen = waved("smart_room", n_frames=60)
    setups = setups_of(scene)
    problem, state, _ = joint_problem(scene, seen, setups=setups)
    parameters = cameras_of(state.parts)
    prior = lens_prior(setups, parameters)
    # So strong a prior on the principal point that the detections are nothing against it.
    rows = np.isin(prior.entry, [2, 3])
    prior = replace(prior, sigma=np.where(rows, 1e-6, prior.sigma))
    found = solve(Problem(problem.point_blocks, [prior], problem.gauge), perturbed(state), TIGHT)
    # A detection pulls with at most its residual over sigma, a prior's with 1e6 per px: some 1000 detections, 1e-2 px.
    np.testing.assert_allclose(cameras_of(found.state.parts).optics[:, 2:4], [[319.5, 239.5]] * 5, atol=1e-5)
    assert pytest.approx(0.2) == SIGMA_PX
