"""A problem linearised at a state: whitened, reweighted Jacobians by chunk, and the normal equations made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from network_calib.blocks import PointBlock, Problem, State
from network_calib.chunks import BlockRows, Chunk, GroupRows, cut
from network_calib.observations import FloatArray
from network_calib.robust_loss import Loss
from network_calib.schur import EliminatedChunk, EliminatedSystem, ReducedFactoriser, factor_3x3, solve_lower


@dataclass(slots=True)
class _Rows:
    """Linearised measurements of one block in one chunk; all but `root_weight` already multiplied by it."""

    residual: FloatArray
    by_shared: FloatArray
    by_point: FloatArray
    root_weight: FloatArray | None


@dataclass(slots=True)
class _LinearChunk:
    rows: list[_Rows]
    normal: FloatArray


@dataclass(slots=True)
class Linearisation:
    """Gauss-Newton's model at a state.

    Attributes:
        normal: (n, n) shared part of J'J.
        shared_gradient: (n,) minus J'r.
        point_gradient: (3, F) minus J'r.
        chunks: the Jacobians, chunk by chunk.
    """

    normal: FloatArray
    shared_gradient: FloatArray
    point_gradient: FloatArray
    chunks: list[_LinearChunk]

    @property
    def shared_scale(self) -> FloatArray:
        """(n,) Marquardt's scale of the shared parameters."""
        return np.diag(self.normal)

    @property
    def point_scale(self) -> FloatArray:
        """(3, F) Marquardt's scale of the points."""
        return np.concatenate([chunk.normal[[0, 2, 5]] for chunk in self.chunks], axis=1)


class Assembler:
    """A problem with its measurements in chunk order: linearises it, and eliminates the points."""

    def __init__(self, problem: Problem, state: State) -> None:
        self.problem = problem
        self.n_points = state.points.shape[1]
        self.blocks: Sequence[PointBlock]
        self.blocks, self.chunks = cut(problem.point_blocks, self.n_points)
        self._factoriser = ReducedFactoriser()

    def cost(self, state: State) -> float:
        """Half the sum of losses; infinite when a residual is not finite."""
        total = 0.0
        for chunk in self.chunks:
            for block, part in zip(self.blocks, chunk.blocks, strict=True):
                residual = block.residual(state.parts, state.points[:, block.point[part.rows]], part.rows)
                total += float(block.loss.cost(_squared_norm(residual)).sum())
        for shared in self.problem.shared_blocks:
            residual, _ = shared.linearise(state.parts)
            total += float(residual @ residual)
        return 0.5 * total if np.isfinite(total) else np.inf

    def linearise(self, state: State) -> Linearisation:
        """Jacobians and normal equations at a state."""
        n = state.n_shared
        model = Linearisation(np.zeros((n, n)), np.zeros(n), np.zeros((3, self.n_points)), [])
        self._add_shared_blocks(state, model)
        for chunk in self.chunks:
            model.chunks.append(self._linearise_chunk(state, chunk, model))
        return model

    def eliminate(self, model: Linearisation, damping: float) -> tuple[EliminatedSystem, list[EliminatedChunk]]:
        """The damped system with the points eliminated.

        Raises:
            LinAlgError: the reduced matrix is not positive definite.
        """
        reduced, eliminated = self.reduce(model, damping)
        return EliminatedSystem(eliminated, self._factoriser.factor(reduced)), eliminated

    def reduce(self, model: Linearisation, damping: float) -> tuple[FloatArray, list[EliminatedChunk]]:
        """The reduced matrix (n, n) and the eliminated chunks."""
        reduced = model.normal.copy()
        reduced[np.diag_indices_from(reduced)] += damping * model.shared_scale
        eliminated = []
        for chunk, linear in zip(self.chunks, model.chunks, strict=True):
            damped = linear.normal.copy()
            damped[[0, 2, 5]] *= 1 + damping
            factor = factor_3x3(damped)
            coupling = solve_lower(factor, _coupling(chunk, linear)).reshape(len(chunk.columns), 3 * chunk.n_points)
            reduced[np.ix_(chunk.columns, chunk.columns)] -= coupling @ coupling.T
            eliminated.append(EliminatedChunk(chunk.points, chunk.columns, coupling, factor))
        return reduced, eliminated

    def curvature_pull(
        self, state: State, model: Linearisation, shared_step: FloatArray, point_step: FloatArray, fraction: float
    ) -> tuple[FloatArray, FloatArray]:
        """J' of the residuals' second derivative along a step, by a finite difference over `fraction` of it.

        Returns:
            (n,) and (3, F), the right-hand sides whose solution times -1/2 is the geodesic acceleration.
        """
        ahead = state.retract(fraction * shared_step, fraction * point_step)
        shared_pull, point_pull = np.zeros_like(shared_step), np.zeros_like(point_step)
        for chunk, linear in zip(self.chunks, model.chunks, strict=True):
            local_step = point_step[:, chunk.points]
            for block, part, rows in zip(self.blocks, chunk.blocks, linear.rows, strict=True):
                residual = block.residual(ahead.parts, ahead.points[:, block.point[part.rows]], part.rows)
                if rows.root_weight is not None:
                    residual *= rows.root_weight
                slope = np.einsum("amn,an->mn", rows.by_point, local_step[:, part.local_point])
                for group in part.groups:
                    step = shared_step[chunk.columns[group.targets]]
                    by_shared = rows.by_shared[group.used][:, :, group.rows]
                    slope[:, group.rows] += np.einsum("d,dmn->mn", step, by_shared)
                second = (2 / fraction) * ((residual - rows.residual) / fraction - slope)
                _pull_back(chunk, part, rows, second, shared_pull, point_pull)
        return shared_pull, point_pull

    def _add_shared_blocks(self, state: State, model: Linearisation) -> None:
        for block in self.problem.shared_blocks:
            residual, jacobian = block.linearise(state.parts)
            is_used = block.columns >= 0
            jacobian = np.where(is_used, jacobian, 0.0)
            columns = np.where(is_used, block.columns, 0)
            np.add.at(model.shared_gradient, columns, -jacobian * residual[:, None])
            products = jacobian[:, :, None] * jacobian[:, None, :]
            np.add.at(model.normal, (columns[:, :, None], columns[:, None, :]), products)

    def _linearise_chunk(self, state: State, chunk: Chunk, model: Linearisation) -> _LinearChunk:
        normal = np.zeros((6, chunk.n_points))
        linear = _LinearChunk([], normal)
        for block, part in zip(self.blocks, chunk.blocks, strict=True):
            points = state.points[:, block.point[part.rows]]
            rows = _reweighted(block.loss, *block.linearise(state.parts, points, part.rows))
            for k, product in enumerate(_symmetric_products(rows.by_point)):
                normal[k] += np.bincount(part.local_point, product, minlength=chunk.n_points)
            for group in part.groups:
                columns = chunk.columns[group.targets]
                flat = rows.by_shared[group.used][:, :, group.rows].reshape(len(group.used), -1)
                model.normal[np.ix_(columns, columns)] += flat @ flat.T
            _pull_back(chunk, part, rows, -rows.residual, model.shared_gradient, model.point_gradient)
            linear.rows.append(rows)
        return linear


def _pull_back(
    chunk: Chunk, part: BlockRows, rows: _Rows, vector: FloatArray, shared: FloatArray, points: FloatArray
) -> None:
    """Add J' vector, with vector (m, n) over the rows, to shared (n,) and points (3, F)."""
    by_point = np.einsum("amn,mn->an", rows.by_point, vector)
    for k in range(3):
        points[k, chunk.points] += np.bincount(part.local_point, by_point[k], minlength=chunk.n_points)
    by_shared = rows.by_shared * vector
    for group in part.groups:
        shared[chunk.columns[group.targets]] += by_shared[:, :, group.rows].sum(axis=(1, 2))[group.used]


def _coupling(chunk: Chunk, linear: _LinearChunk) -> FloatArray:
    """(n, 3, P) products J_shared' J_point, dense over the chunk's columns and points."""
    coupling = np.zeros((len(chunk.columns), 3, chunk.n_points))
    for part, rows in zip(chunk.blocks, linear.rows, strict=True):
        # One column of zeros behind the rows stands for the points that a group did not see.
        padded_shared = np.pad(rows.by_shared, ((0, 0), (0, 0), (0, 1)))
        padded_point = np.pad(rows.by_point, ((0, 0), (0, 0), (0, 1)))
        for group in part.groups:
            by_shared, by_point = _at(padded_shared, group), _at(padded_point, group)
            product = by_shared[:, None, 0, :] * by_point[None, :, 0, :]
            for m in range(1, by_shared.shape[1]):
                product += by_shared[:, None, m, :] * by_point[None, :, m, :]
            coupling[group.targets] += product[group.used]
    return coupling


def _at(jacobian: FloatArray, group: GroupRows) -> FloatArray:
    """A group's part of a block's Jacobian (D, m, n + 1), over the chunk's points and contiguous along them."""
    if group.row_of_point is None:
        return jacobian[:, :, group.rows]
    return np.take(jacobian, group.row_of_point, axis=2)


def _reweighted(loss: Loss, residual: FloatArray, by_shared: FloatArray, by_point: FloatArray) -> _Rows:
    weight = loss.weight(_squared_norm(residual))
    if weight is None:
        return _Rows(residual, by_shared, by_point, None)
    root = np.sqrt(weight)
    return _Rows(residual * root, by_shared * root, by_point * root, root)


def _squared_norm(residual: FloatArray) -> FloatArray:
    return np.einsum("mn,mn->n", residual, residual)


def _symmetric_products(by_point: FloatArray) -> list[FloatArray]:
    """Entries 00, 10, 11, 20, 21, 22 of J'J for each measurement, J given as (3, m, n)."""
    return [np.einsum("mn,mn->n", by_point[i], by_point[j]) for i in range(3) for j in range(i + 1)]
