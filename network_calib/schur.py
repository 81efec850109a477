"""The linear algebra of the joint engine: eliminate the latent points, solve for the shared parameters, go back.

With the normal equations split into shared (U, g) and point parts (V block-diagonal 3x3, h) and their coupling W,
    [U  W] [d_shared]   [g]
    [W' V] [d_points] = [h]
and V = L L', the reduced system is (U - B B') d_shared = g - B L^-1 h with B = W L^-T, and the points follow from
d_points = L^-T (L^-1 h - B' d_shared). B is kept in chunks of points, dense over the shared columns that the chunk
touches, so that the product B B' runs as one BLAS call a chunk and the memory stays proportional to the observations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded, get_lapack_funcs
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from network_calib.observations import FloatArray, IntArray

# Below this size a dense factorisation is always the quickest.
MIN_BANDED_SIZE = 500


def factor_3x3(normal: FloatArray) -> FloatArray:
    """Cholesky factors (6, P) of P symmetric 3x3 matrices given as (6, P): 00, 10, 11, 20, 21, 22."""
    a00, a10, a11, a20, a21, a22 = normal
    l00 = np.sqrt(a00)
    l10 = a10 / l00
    l20 = a20 / l00
    l11 = np.sqrt(np.maximum(a11 - l10 * l10, 1e-14 * a11))
    l21 = (a21 - l20 * l10) / l11
    l22 = np.sqrt(np.maximum(a22 - l20 * l20 - l21 * l21, 1e-14 * a22))
    return np.stack([l00, l10, l11, l20, l21, l22])


def solve_lower(factor: FloatArray, rhs: FloatArray) -> FloatArray:
    """L^-1 rhs for P points; rhs is (..., 3, P) and is overwritten."""
    l00, l10, l11, l20, l21, l22 = factor
    first, second, third = rhs[..., 0, :], rhs[..., 1, :], rhs[..., 2, :]
    first *= 1.0 / l00
    second -= first * l10
    second *= 1.0 / l11
    third -= first * l20
    third -= second * l21
    third *= 1.0 / l22
    return rhs


def solve_upper(factor: FloatArray, rhs: FloatArray) -> FloatArray:
    """L^-T rhs for P points, rhs (3, P)."""
    l00, l10, l11, l20, l21, l22 = factor
    third = rhs[2] / l22
    second = (rhs[1] - l21 * third) / l11
    first = (rhs[0] - l10 * second - l20 * third) / l00
    return np.stack([first, second, third])


@dataclass(frozen=True, slots=True)
class EliminatedChunk:
    """One chunk of points after elimination.

    Attributes:
        points: which points.
        columns: (n,) shared columns that the chunk touches.
        coupling: (n, 3 P) the matrix B above.
        factor: (6, P) the factors L.
    """

    points: slice
    columns: IntArray
    coupling: FloatArray
    factor: FloatArray

    def point_covariance(self, shared_covariance: FloatArray) -> FloatArray:
        """(P, 3, 3) covariance of the points: L^-T (1 + B' C B) L^-1 with C the shared covariance."""
        n_points = self.factor.shape[1]
        spread = shared_covariance[np.ix_(self.columns, self.columns)] @ self.coupling
        shape = (len(self.columns), 3, n_points)
        inner = np.einsum("cap,cbp->abp", self.coupling.reshape(shape), spread.reshape(shape)) + np.eye(3)[:, :, None]
        inverse = np.stack([solve_upper(self.factor, np.repeat(e[:, None], n_points, 1)) for e in np.eye(3)], axis=1)
        return np.einsum("iap,abp,jbp->pij", inverse, inner, inverse)


class EliminatedSystem:
    """The damped normal equations with the points eliminated and the reduced matrix factorised."""

    def __init__(self, chunks: Sequence[EliminatedChunk], solve_reduced: Callable[[FloatArray], FloatArray]) -> None:
        self._chunks = chunks
        self._solve_reduced = solve_reduced

    def solve(self, shared_rhs: FloatArray, point_rhs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Steps (n,) and (3, F) for right-hand sides of the same shapes."""
        reduced_rhs = shared_rhs.copy()
        halves = []
        for chunk in self._chunks:
            half = solve_lower(chunk.factor, point_rhs[:, chunk.points].copy())
            reduced_rhs[chunk.columns] -= chunk.coupling @ half.reshape(-1)
            halves.append(half)
        shared_step = self._solve_reduced(reduced_rhs)
        point_step = np.empty_like(point_rhs)
        for chunk, half in zip(self._chunks, halves, strict=True):
            back = (shared_step[chunk.columns] @ chunk.coupling).reshape(half.shape)
            point_step[:, chunk.points] = solve_upper(chunk.factor, half - back)
        return shared_step, point_step


class ReducedFactoriser:
    """Factorises the reduced system; banded after a reverse Cuthill-McKee ordering where the camera graph is a chain.

    The ordering is found once, from the first matrix, since the pattern does not change.
    """

    def __init__(self) -> None:
        self._order: IntArray | None = None
        self._bandwidth = 0

    def factor(self, matrix: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """A solver for the symmetric positive definite matrix (n, n), of which both triangles are filled.

        Raises:
            LinAlgError: the matrix is not positive definite.
        """
        n = len(matrix)
        if n >= MIN_BANDED_SIZE and self._order is None:
            self._find_order(matrix)
        if n < MIN_BANDED_SIZE or self._bandwidth > n // 5:
            dense = cho_factor(matrix, lower=True, check_finite=False)
            return lambda rhs: cho_solve(dense, rhs, check_finite=False)
        return self._factor_banded(matrix)

    def _factor_banded(self, matrix: FloatArray) -> Callable[[FloatArray], FloatArray]:
        order = self._order
        assert order is not None
        n = len(matrix)
        band = np.zeros((self._bandwidth + 1, n))
        for k in range(self._bandwidth + 1):
            band[k, : n - k] = matrix[order[k:], order[: n - k]]
        factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)

        def solve(rhs: FloatArray) -> FloatArray:
            solution = np.empty(n)
            solution[order] = cho_solve_banded((factor, True), rhs[order], check_finite=False)
            return solution

        return solve

    def _find_order(self, matrix: FloatArray) -> None:
        pattern = csr_array(matrix != 0)
        order = np.asarray(reverse_cuthill_mckee(pattern, symmetric_mode=True), dtype=np.int64)
        position = np.empty(len(order), dtype=np.int64)
        position[order] = np.arange(len(order))
        rows, columns = pattern.nonzero()
        self._order = order
        self._bandwidth = int(np.abs(position[rows] - position[columns]).max(initial=0))


def inverse_spd(matrix: FloatArray) -> FloatArray:
    """Inverse of a symmetric positive definite matrix.

    Raises:
        LinAlgError: not positive definite to working precision.
    """
    diagonal = np.diag(matrix)
    if not (diagonal > 0).all():
        raise LinAlgError("matrix has a non-positive diagonal")
    # Rows and columns are scaled alike: parameters are in radians, metres and pixels.
    scale = 1.0 / np.sqrt(diagonal)
    potrf, potri = get_lapack_funcs(("potrf", "potri"), dtype=np.float64)
    factor, info = potrf(matrix * scale[:, None] * scale, lower=1, clean=1)
    if info == 0:
        inverse, info = potri(factor, lower=1)
        if info == 0:
            return (np.tril(inverse) + np.tril(inverse, -1).T) * scale[:, None] * scale
    raise LinAlgError("matrix is not positive definite")
