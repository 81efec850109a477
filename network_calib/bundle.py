"""The joint least-squares engine: residual blocks over shared parameters and latent spot positions.

It knows nothing of cameras, lasers or clocks. A problem (`blocks.py`) is a list of residual blocks, each returning
whitened residuals and their Jacobians. The latent points are eliminated (`linearisation.py`, `schur.py`) and the shared
parameters solved by Levenberg-Marquardt with Marquardt's scaling and geodesic acceleration (Transtrum, Sethna,
arXiv:1201.5885): self-calibration from spots has long curved valleys (focal length against distance, principal point
against rotation) along which the plain method creeps. A gauge that the data leave free is held by the
damping in the solve; the covariance is exactly that of the gauge that the caller names.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError
from threadpoolctl import ThreadpoolController

from network_calib.blocks import Problem, State
from network_calib.errors import ConvergenceError
from network_calib.linearisation import Assembler, Linearisation
from network_calib.observations import FloatArray
from network_calib.schur import EliminatedSystem, inverse_spd

# Small products dominate: more BLAS threads only make them slower, and sums in another order.
_BLAS = ThreadpoolController()
# The acceleration is trusted where it is at most this share of the step, in Marquardt's scale (Transtrum: 0.75).
_MAX_ACCELERATION = 0.75
_PROBE_FRACTION = 0.1
# Holds the gauge's free directions, along which the gradient is zero: the step has no part in them. Rows of constraints
# would do so too, but fill the reduced matrix of a long chain of cameras.
MIN_DAMPING = 1e-9


@dataclass(frozen=True, slots=True)
class SolverOptions:
    """When to stop.

    Attributes:
        max_iterations: linearisations at most.
        cost_tolerance: relative decrease of the cost below which the solve has converged.
        initial_damping: relative to Marquardt's scale.
    """

    max_iterations: int = 100
    cost_tolerance: float = 1e-8
    initial_damping: float = 1e-4


@dataclass(frozen=True, slots=True)
class Solution:
    """Where a solve ended.

    Attributes:
        state: parameters and points.
        cost: half the (robust) sum of squares.
        n_iterations: linearisations.
        has_converged: the last step changed the cost by less than the tolerance.
    """

    state: State
    cost: float
    n_iterations: int
    has_converged: bool


@dataclass(frozen=True, slots=True)
class Covariance:
    """Covariance of the shared tangent vector (n, n) and of the points (F, 3, 3) under the problem's gauge."""

    shared: FloatArray
    points: FloatArray


def solve(problem: Problem, start: State, options: SolverOptions | None = None) -> Solution:
    """Minimise the problem from a start.

    Raises:
        ConvergenceError: the cost at the start is not finite.
    """
    with _BLAS.limit(limits=1):
        return _minimise(Assembler(problem, start), start, options or SolverOptions())


def covariance(problem: Problem, state: State) -> Covariance:
    """Covariance at an optimum: the inverse of J'J under the named gauge (whitened residuals have unit variance).

    Raises:
        LinAlgError: the information matrix is singular: something is unobservable beyond the named gauge.
    """
    with _BLAS.limit(limits=1):
        assembler = Assembler(problem, state)
        model = assembler.linearise(state)
        reduced, chunks = assembler.reduce(model, 0.0)
        gauge = problem.gauge_at(state)
        reduced += model.shared_scale.mean() * gauge.constraints.T @ gauge.constraints
        shared = inverse_spd(reduced)
        # Whatever constraints the inverse was made with, the projection along the free directions gives that of the
        # named gauge, symmetric and positive semidefinite by construction.
        project = np.eye(len(shared)) - gauge.null @ np.linalg.solve(gauge.constraints @ gauge.null, gauge.constraints)
        shared = project @ shared @ project.T
        shared = (shared + shared.T) / 2
        points = [chunk.point_covariance(shared) for chunk in chunks]
        return Covariance(shared, np.concatenate(points) if points else np.zeros((0, 3, 3)))


def _minimise(assembler: Assembler, start: State, options: SolverOptions) -> Solution:
    state, cost = start, assembler.cost(start)
    if not np.isfinite(cost):
        raise ConvergenceError("the start of the joint solve is unusable: a spot lies behind a camera that saw it")
    damping = options.initial_damping
    for iteration in range(1, options.max_iterations + 1):
        model = assembler.linearise(state)
        while True:
            step = _step(assembler, state, model, damping)
            if step is not None:
                moved = state.retract(step.shared, step.points)
                moved_cost = assembler.cost(moved)
                if moved_cost <= cost:
                    break
                if step.predicted_decrease < options.cost_tolerance * cost:
                    return Solution(state, cost, iteration, has_converged=True)
            damping *= 8
            if damping > 1e10:
                return Solution(state, cost, iteration, has_converged=False)
        decrease, state, cost = cost - moved_cost, moved, moved_cost
        if decrease <= options.cost_tolerance * cost:
            return Solution(state, cost, iteration, has_converged=True)
        damping = max(damping / 10, MIN_DAMPING)
    return Solution(state, cost, options.max_iterations, has_converged=False)


@dataclass(frozen=True, slots=True)
class _Step:
    """A step (n,), (3, F), and what the linear model promises for it before the acceleration bends it."""

    shared: FloatArray
    points: FloatArray
    predicted_decrease: float


def _step(assembler: Assembler, state: State, model: Linearisation, damping: float) -> _Step | None:
    """Damped Gauss-Newton step with geodesic acceleration; None when the damping is too small for either."""
    try:
        system, _ = assembler.eliminate(model, damping)
    except LinAlgError:
        return None
    step = system.solve(model.shared_gradient, model.point_gradient)
    accelerated = _accelerated(assembler, state, model, system, step)
    return None if accelerated is None else _Step(*accelerated, _predicted_decrease(model, step, damping))


def _accelerated(
    assembler: Assembler,
    state: State,
    model: Linearisation,
    system: EliminatedSystem,
    step: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray] | None:
    shared_pull, point_pull = assembler.curvature_pull(state, model, *step, _PROBE_FRACTION)
    if not (np.isfinite(shared_pull).all() and np.isfinite(point_pull).all()):
        return None
    shared, points = system.solve(shared_pull, point_pull)
    if 0.5 * _scaled_norm(model, shared, points) > _MAX_ACCELERATION * _scaled_norm(model, *step):
        return None
    return step[0] - 0.5 * shared, step[1] - 0.5 * points


def _scaled_norm(model: Linearisation, shared: FloatArray, points: FloatArray) -> float:
    square = float(shared @ (model.shared_scale * shared)) + float(np.sum(points * model.point_scale * points))
    return square**0.5


def _predicted_decrease(model: Linearisation, step: tuple[FloatArray, FloatArray], damping: float) -> float:
    """What the linear model promises for its own step: (damping step' D step + step' gradient) / 2."""
    shared, points = step
    along = float(shared @ model.shared_gradient) + float(np.sum(points * model.point_gradient))
    return 0.5 * (damping * _scaled_norm(model, shared, points) ** 2 + along)
