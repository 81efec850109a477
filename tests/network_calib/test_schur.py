"""Elimination of the spots and the factorisations behind it, against dense linear algebra."""

import numpy as np
import pytest
from scipy.linalg import LinAlgError

from network_calib import chunks, schur
from network_calib.blocks import Problem, State
from network_calib.bundle import covariance
from network_calib.camera_block import PART
from network_calib.camera_parameters import CameraParameters, free_columns
from network_calib.chunks import cut
from network_calib.linearisation import Assembler
from network_calib.priors import lens_prior
from network_calib.robust_loss import CauchyLoss
from network_calib.room_setup import CameraSetup
from network_calib.schur import ReducedFactoriser, factor_3x3, inverse_spd, solve_lower, solve_upper
from network_calib.spots import SpotViews
from network_calib.sync import CLOCKS, Clocks, DelayedCameraBlock
from tests.network_calib.scenes import (
    block_of,
    camera_block,
    dense_jacobian,
    joint_problem,
    perturbed,
    random_problem,
    setups_of,
    waved,
)

DAMPING = 1e-3


@pytest.fixture
def small_chunks(monkeypatch):
    """Chunks of at most 16 spots, so that small problems have many."""
    monkeypatch.setattr(chunks, "_SIZES", (16,))


def assert_is_the_dense_step(problem, state):
    """The engine's damped step is Marquardt's, from the full normal equations."""
    residual, jacobian = dense_jacobian(problem, state)
    normal = jacobian.T @ jacobian
    normal[np.diag_indices_from(normal)] *= 1 + DAMPING
    units = np.sqrt(np.diag(normal))
    normal = normal / units[:, None] / units
    expected = np.linalg.solve(normal, -jacobian.T @ residual / units)
    shared, points, _, _ = engine_step(problem, state, DAMPING)
    found = np.concatenate([shared, points.T.ravel()]) * units
    # Two solutions of one system differ by its condition number (of some 1 / DAMPING) times the last place.
    tolerance = 100 * np.linalg.cond(normal) * 2.2e-16
    assert tolerance < 1e-8
    np.testing.assert_allclose(found, expected, atol=tolerance * np.abs(expected).max())


def engine_step(problem, state, damping):
    assembler = Assembler(problem, state)
    model = assembler.linearise(state)
    system, eliminated = assembler.eliminate(model, damping)
    return *system.solve(model.shared_gradient, model.point_gradient), assembler, eliminated


def two_blocks():
    """Two camera blocks over the same cameras and spots: the second only sees cameras 1 and 2, with delayed clocks."""
    problem, state = random_problem(n_cameras=4, n_points=50, missing=0.4, loss=CauchyLoss(2.0))
    first = block_of(problem)
    rng = np.random.default_rng(5)
    rows = np.flatnonzero(np.isin(first.group, [1, 2]))
    inner = first.take(rows)
    moved = camera_block(inner.group, inner.point, inner.px.T + rng.normal(size=(len(rows), 2)), inner.columns)
    n = state.n_shared
    delayed = DelayedCameraBlock(moved, 5 * rng.standard_normal((2, len(rows))), np.array([-1, n, n + 1, -1]))
    parts = {PART: state.parts[PART], CLOCKS: Clocks(np.zeros(3), 0)}

    def gauge(at):
        inner_gauge = problem.gauge_at(State({PART: at.parts[PART]}, at.points))
        constraints = np.pad(inner_gauge.constraints, ((0, 0), (0, 2)))
        return type(inner_gauge)(constraints, np.pad(inner_gauge.null, ((0, 2), (0, 0))))

    return Problem([first, delayed], (), gauge), State(parts, state.points)


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("loss", [None, CauchyLoss(1.0)])
@pytest.mark.usefixtures("small_chunks")
def test_elimination_equals_the_dense_normal_equations(missing, loss):
    problem, state = random_problem(n_cameras=4, n_points=50, missing=missing, loss=loss)
    assert len(Assembler(problem, state).chunks) == 4
    assert_is_the_dense_step(problem, state)


@pytest.mark.usefixtures("small_chunks")
def test_blocks_of_several_kinds_and_priors_join_in_one_system():
    problem, state = two_blocks()
    setups = [CameraSetup(f"C{c}", (600, 600)) for c in range(4)]
    parameters = state.parts[PART]
    assert isinstance(parameters, CameraParameters)
    problem = Problem(problem.point_blocks, [lens_prior(setups, parameters)], problem.gauge)
    assert_is_the_dense_step(problem, state)


@pytest.mark.usefixtures("small_chunks")
def test_shared_intrinsics_add_up_over_the_cameras_of_a_group():
    problem, state = random_problem(n_cameras=4, n_points=50)
    parameters = state.parts[PART]
    assert isinstance(parameters, CameraParameters)
    none = np.zeros(4, dtype=bool)
    columns = free_columns(
        (setups_of(waved("smart_room", n_frames=50)[0])[0].lens,) * 4,
        is_pose_fixed=none,
        is_intrinsics_fixed=none,
        groups=np.array([0, 1, 0, 0]),
    )
    block = block_of(problem)
    grouped = Problem([camera_block(block.group, block.point, block.px.T, columns)], (), problem.gauge)
    at = State(
        {
            PART: CameraParameters(
                parameters.rotations, parameters.centres, parameters.optics, parameters.is_fisheye, columns
            )
        },
        state.points,
    )
    assert_is_the_dense_step(grouped, at)


@pytest.mark.usefixtures("small_chunks")
def test_chunks_hold_every_row_once():
    problem, _ = two_blocks()
    blocks, pieces = cut(problem.point_blocks, 50)
    for b, block in enumerate(blocks):
        seen = np.concatenate([np.arange(len(block.point))[piece.blocks[b].rows] for piece in pieces])
        np.testing.assert_array_equal(seen, np.arange(len(block.point)))
        for piece in pieces:
            inside = block.point[piece.blocks[b].rows]
            assert ((inside >= piece.points.start) & (inside < piece.points.stop)).all()
            lengths = [g.rows.stop - g.rows.start for g in piece.blocks[b].groups]
            assert sum(lengths) == len(inside)
    # The first camera sees the first half of the spots: the last chunk does not carry its columns.
    assert pieces[0].columns.min() == 0
    assert pieces[-1].columns.min() > 0


@pytest.mark.usefixtures("small_chunks")
def test_point_covariance_is_the_block_of_the_dense_inverse():
    problem, state = random_problem(n_cameras=4, n_points=50, missing=0.3)
    found = covariance(problem, state)
    _, jacobian = dense_jacobian(problem, state)
    n = state.n_shared
    constraints = np.pad(problem.gauge_at(state).constraints, ((0, 0), (0, 150)))
    # The covariance under constraints is that block of the inverse of the bordered normal matrix.
    bordered = np.block([[jacobian.T @ jacobian, constraints.T], [constraints, np.zeros((7, 7))]])
    scale = 1 / np.sqrt(np.maximum(np.diag(bordered), 1.0))
    inverse = scale[:, None] * np.linalg.inv(bordered * scale[:, None] * scale) * scale
    # Inverses of a scaled matrix with condition below 1e8 agree to 1e-6.
    np.testing.assert_allclose(found.shared, inverse[:n, :n], atol=1e-6 * np.abs(inverse[:n, :n]).max())
    for j in (0, 20, 49):
        at = slice(n + 3 * j, n + 3 * j + 3)
        np.testing.assert_allclose(found.points[j], inverse[at, at], atol=1e-6 * np.abs(inverse[at, at]).max())


def chain_problem():
    """A chain of 50 cameras: more than MIN_BANDED_SIZE parameters, each tied to its neighbours only."""
    scene, seen = waved("corridor_chain", n_cameras=50, n_frames=1500)
    problem, state, _ = joint_problem(scene, seen)
    assert state.n_shared >= schur.MIN_BANDED_SIZE
    return problem, state


def test_banded_factorisation_of_a_chain_equals_the_dense_one(monkeypatch):
    problem, state = chain_problem()
    assembler = Assembler(problem, state)
    model = assembler.linearise(state)
    reduced, _ = assembler.reduce(model, DAMPING)
    banded = ReducedFactoriser()
    rhs = np.random.default_rng(0).standard_normal(len(reduced))
    solution = banded.factor(reduced)(rhs)
    assert 0 < banded._bandwidth <= len(reduced) // 5
    monkeypatch.setattr(schur, "MIN_BANDED_SIZE", 10**6)
    dense = ReducedFactoriser().factor(reduced)(rhs)
    # Both are backward stable: they differ by the condition number (of the scaled matrix) times the last place.
    scale = 1 / np.sqrt(np.diag(reduced))
    condition = np.linalg.cond(reduced * scale[:, None] * scale)
    np.testing.assert_allclose(
        solution / scale, dense / scale, atol=100 * condition * 2.2e-16 * np.abs(dense / scale).max()
    )


def test_a_large_network_that_is_no_chain_is_factorised_densely():
    n = schur.MIN_BANDED_SIZE
    half = np.random.default_rng(0).standard_normal((n, n))
    matrix = half @ half.T + n * np.eye(n)
    rhs = np.ones(n)
    # The smallest eigenvalue is above n, the largest below 6 n: no digit to lose.
    np.testing.assert_allclose(matrix @ ReducedFactoriser().factor(matrix)(rhs), rhs, atol=1e-11)


def test_an_indefinite_matrix_is_an_error_in_both_factorisations():
    for n in (10, schur.MIN_BANDED_SIZE):
        matrix = np.diag(np.append(np.ones(n - 1), -1.0))
        with pytest.raises(LinAlgError):
            ReducedFactoriser().factor(matrix)


def test_three_by_three_factors_solve_their_systems():
    rng = np.random.default_rng(0)
    half = rng.standard_normal((20, 3, 5))
    normal = half @ half.transpose(0, 2, 1)
    factor = factor_3x3(np.stack([normal[:, i, j] for i in range(3) for j in range(i + 1)]))
    rhs = rng.standard_normal((3, 20))
    solution = solve_upper(factor, solve_lower(factor, rhs.copy()))
    # Condition numbers of Wishart matrices with 5 degrees of freedom stay below 1e5 here: 1e-11 is left.
    np.testing.assert_allclose(np.einsum("pij,jp->ip", normal, solution), rhs, atol=1e-10)


def test_inverse_of_a_matrix_in_mixed_units():
    rng = np.random.default_rng(0)
    half = rng.standard_normal((30, 60))
    units = 10.0 ** rng.uniform(-6, 6, 30)
    matrix = (half @ half.T) * units[:, None] * units
    inverse = inverse_spd(matrix)
    # Units taken off, the condition number is below 100.
    product = (inverse / (1 / units[:, None] / units)) @ (half @ half.T)
    np.testing.assert_allclose(product, np.eye(30), atol=1e-11)
    np.testing.assert_allclose(inverse, inverse.T, rtol=1e-14)


@pytest.mark.parametrize("diagonal", [[1.0, 0.0], [1.0, -1.0], [1.0, np.nan]])
def test_inverse_of_what_is_not_positive_definite_is_an_error(diagonal):
    with pytest.raises(LinAlgError):
        inverse_spd(np.diag(diagonal))
    with pytest.raises(LinAlgError):
        inverse_spd(np.array([[1.0, 2.0], [2.0, 1.0]]))


def test_memory_of_the_coupling_grows_with_the_observations_not_with_the_cameras():
    # A chain of 20 and of 40 cameras, the same number of frames in view of each: 2 x the observations, 2 x the entries.
    sizes = []
    for n_cameras in (20, 40):
        scene, seen = waved("corridor_chain", n_cameras=n_cameras, n_frames=60 * n_cameras)
        problem, state, _ = joint_problem(scene, seen)
        _, pieces = cut(problem.point_blocks, state.points.shape[1])
        entries = sum(len(piece.columns) * 3 * piece.n_points for piece in pieces)
        sizes.append(entries / len(SpotViews.of(seen.observations).camera))
    assert sizes[1] < 1.25 * sizes[0]  # a dense coupling would give 2


def test_a_perturbed_state_changes_the_step():
    # Guards the tests above: a step that ignored the state would pass none of them by chance.
    problem, state, _ = joint_problem(*waved("smart_room", n_frames=60))
    here, *_ = engine_step(problem, state, DAMPING)
    there, *_ = engine_step(problem, perturbed(state), DAMPING)
    assert np.abs(here - there).max() > 1e-3
