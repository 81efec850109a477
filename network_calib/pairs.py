"""Pairwise epipolar verification and the overlap graph: who shares how much with whom (Svoboda, step 1).

Each pair of cameras with enough shared spots gets a fundamental matrix in nominal rays: a robust search (MAGSAC) on a
subsample, then all pairs refined together with one radial bend for each camera (`epipolar.py`). An observation is then
judged by all pairs of its frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from network_calib.epipolar import SharedRays, refine_fundamentals, sampson, tolerance_at, unbend
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.start import StartProblem

MIN_SHARED = 15
# A random match lies within a tolerance of its epipolar line with a chance of some percent; of honest cameras with 30 %
# false detections each, half the matches agree.
MIN_INLIER_SHARE = 0.3
SEARCH_SPOTS = 300
# The search runs before the bend is known, so wider than the tolerance.
SEARCH_TOLERANCES = 2.0
# What the bend leaves of a lens may widen a pair's tolerance up to this much.
MAX_TOLERANCES = 3.0
# A camera three frames (0.12 s) late still agrees in three to nine of ten spots, where the hand was slow; honest
# cameras differ by the sampling error of some hundred spots, two percent.
DISAGREEING, DISAGREEING_BEST = 0.88, 0.94


class Overlap(StrEnum):
    """How well a pair of cameras is tied together by spots that agree."""

    GOOD = "good"
    MARGINAL = "marginal"
    INSUFFICIENT = "insufficient"


@dataclass(frozen=True, slots=True)
class Pair:
    """Two cameras that share spots: x_b^T fundamental x_a = 0 in unbent nominal rays, a < b.

    Attributes:
        a: first camera.
        b: second camera.
        fundamental: (3, 3), rank 2, Frobenius norm 1.
        n_shared: spots seen by both.
        n_inliers: of them, those that agree with `fundamental`.
        information: (9, 9) inverse covariance of the entries of `fundamental`, row by row.
    """

    a: int
    b: int
    fundamental: FloatArray
    n_shared: int
    n_inliers: int
    information: FloatArray


@dataclass(frozen=True, slots=True)
class Disagreement:
    """A camera that agrees with nobody while the others agree with each other.

    Attributes:
        camera: its index.
        inlier_share: over all its pairs, the share of shared spots that agree.
        others_share: the same over the pairs without it.
        reason: a sentence for the user.
    """

    camera: int
    inlier_share: float
    others_share: float
    reason: str


@dataclass(frozen=True, slots=True)
class PairGraph:
    """The overlap graph of C cameras.

    Attributes:
        names: C camera names.
        pairs: verified pairs, ordered by (a, b).
        is_inlier: (K,) observation agrees with the epipolar geometry of its frame's other views; False also where no
            verified pair can tell.
        shared: (C, C) how many spots two cameras share; the diagonal counts a camera's own.
        inliers: (C, C) how many of them agree with the pair's epipolar geometry, verified or not.
        bend: (C,) radial bend of each camera's nominal rays, see `epipolar.unbend`.
    """

    names: tuple[str, ...]
    pairs: tuple[Pair, ...]
    is_inlier: BoolArray
    shared: IntArray
    inliers: IntArray
    bend: FloatArray

    def islands(self) -> list[tuple[int, ...]]:
        """Groups of cameras joined by verified pairs, the largest first, then by first camera."""
        ends = np.array([(p.a, p.b) for p in self.pairs], dtype=np.int64).reshape(-1, 2)
        n = len(self.names)
        graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(n, n))
        n_islands, label = connected_components(graph, directed=False)
        groups = [tuple(int(c) for c in np.flatnonzero(label == i)) for i in range(n_islands)]
        return sorted(groups, key=lambda group: (-len(group), group))

    def leaves(self) -> tuple[int, ...]:
        """Cameras held by a single verified pair."""
        degree = np.bincount([c for p in self.pairs for c in (p.a, p.b)], minlength=len(self.names))
        return tuple(int(c) for c in np.flatnonzero(degree == 1))

    def bridge(self) -> tuple[int, int] | None:
        """The two cameras of different islands nearest to being tied; None where there is one island.

        Nearest is: most agreeing, then most shared spots, then most spots of their own.
        """
        islands = self.islands()
        if len(islands) < 2:
            return None
        label = np.empty(len(self.names), dtype=np.int64)
        for i, group in enumerate(islands):
            label[list(group)] = i
        a, b = np.nonzero(np.triu(label[:, None] != label[None, :]))
        own = self.shared.diagonal()
        best = np.lexsort((-np.minimum(own[a], own[b]), -self.shared[a, b], -self.inliers[a, b]))[0]
        return int(a[best]), int(b[best])

    def grade(self, a: int, b: int) -> Overlap:
        """Overlap of two cameras by agreeing spots: 200 or more good, 50 or more marginal (caliscope's limits)."""
        if self.inliers[a, b] >= 200:
            return Overlap.GOOD
        return Overlap.MARGINAL if self.inliers[a, b] >= 50 else Overlap.INSUFFICIENT

    def disagreeing_cameras(self) -> tuple[Disagreement, ...]:
        """Cameras that share many spots but agree with nobody, while the others agree with each other.

        A camera out of step with the rest does this; so does one whose detector follows another light. A mirrored
        image does not: epipolar geometry holds in a mirror.
        """
        tried = np.where(self.shared >= 2 * MIN_SHARED, self.shared, 0) * (1 - np.eye(len(self.names), dtype=np.int64))
        agreeing = np.where(tried > 0, self.inliers, 0)
        suspects = []
        for c in range(len(self.names)):
            rest = np.arange(len(self.names)) != c
            n_own, n_rest = tried[c].sum(), tried[np.ix_(rest, rest)].sum()
            if n_own == 0 or n_rest == 0:
                continue
            own, others = agreeing[c].sum() / n_own, agreeing[np.ix_(rest, rest)].sum() / n_rest
            best = (agreeing[c] / np.maximum(tried[c], 1)).max()
            if others > 0.6 and own < DISAGREEING * others and best < DISAGREEING_BEST * others:
                suspects.append(Disagreement(c, float(own), float(others), self._reason(c, own, others)))
        return tuple(suspects)

    def _reason(self, camera: int, own: float, others: float) -> str:
        return (
            f"{self.names[camera]} agrees with the other cameras in {100 * own:.0f} % of its shared spots, they with "
            f"each other in {100 * others:.0f} %: out of step with them, or following another light"
        )


def verify_pairs(problem: StartProblem, *, rng: np.random.Generator) -> PairGraph:
    """Find the epipolar geometry of all pairs with enough shared spots and judge every observation by it.

    Args:
        problem: nominal rays.
        rng: draws the subsamples; the same generator state gives the same graph.

    Returns:
        The overlap graph.
    """
    rows_a, rows_b, first, ends, shared = _shared_rows(problem)
    rays = _subsample(problem, rows_a, rows_b, first, ends, rng)
    matrices, bend, information, is_found = _fit(problem, rays, rng)
    agrees = np.zeros(len(rows_a), dtype=bool)
    for p in np.flatnonzero(is_found):
        rows = slice(first[p], first[p + 1])
        agrees[rows] = _agrees(problem, matrices[p], bend, rows_a[rows], rows_b[rows])
    n_shared = np.diff(first)
    n_inliers = np.diff(np.concatenate([[0], np.cumsum(agrees)])[first])
    is_verified = is_found & (n_inliers >= MIN_SHARED) & (n_inliers >= MIN_INLIER_SHARE * n_shared)
    inliers = np.zeros_like(shared)
    inliers[ends[:, 0], ends[:, 1]] = inliers[ends[:, 1], ends[:, 0]] = n_inliers
    pairs = tuple(
        Pair(int(ends[p, 0]), int(ends[p, 1]), matrices[p], int(n_shared[p]), int(n_inliers[p]), information[p])
        for p in np.flatnonzero(is_verified)
    )
    votes = np.repeat(is_verified, n_shared)
    is_inlier = _majority(len(problem.point), rows_a[votes], rows_b[votes], agrees[votes])
    return PairGraph(problem.names, pairs, is_inlier, shared, inliers, bend)


def _fit(
    problem: StartProblem, rays: SharedRays, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Fundamental matrices (P, 3, 3), bends (C,), informations (P, 9, 9); and whether a matrix was found (P,)."""
    n_pairs = len(rays.a)
    rough = [_search(rays, p, problem.tolerance, int(rng.integers(2**31))) for p in range(n_pairs)]
    found = np.array([p for p, matrix in enumerate(rough) if matrix is not None], dtype=np.int64)
    start = np.array([matrix for matrix in rough if matrix is not None], dtype=np.float64).reshape(-1, 3, 3)
    kept = SharedRays(rays.a[found], rays.b[found], rays.ray_a[found], rays.ray_b[found], rays.is_used[found])
    matrices, information = np.zeros((n_pairs, 3, 3)), np.zeros((n_pairs, 9, 9))
    matrices[found], bend, information[found] = refine_fundamentals(
        start, kept, problem.tolerance, problem.is_focal_known
    )
    is_found = np.zeros(n_pairs, dtype=bool)
    is_found[found] = True
    return matrices, bend, information, is_found


def _shared_rows(problem: StartProblem) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Rows of the spots that each pair shares, where there are enough of them.

    Returns:
        (M,) rows of the first camera, (M,) rows of the second, (P + 1,) where each pair begins, (P, 2) the pairs and
        (C, C) how many spots any two cameras share.
    """
    n = problem.n_cameras
    ones = np.ones(len(problem.camera), dtype=np.int64)
    seen = coo_array((ones, (problem.camera, problem.point)), shape=(n, problem.n_points)).tocsr()
    shared = (seen @ seen.T).toarray()
    order = np.argsort(problem.camera, kind="stable")
    rows_of = np.split(order, np.cumsum(np.bincount(problem.camera, minlength=n))[:-1])
    row_of_point = np.full(problem.n_points, -1, dtype=np.int64)
    ends = np.argwhere(np.triu(shared, 1) >= MIN_SHARED)
    rows_a, rows_b = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for a in np.unique(ends[:, 0]):
        row_of_point[problem.point[rows_of[a]]] = rows_of[a]
        for b in ends[ends[:, 0] == a, 1]:
            candidates = row_of_point[problem.point[rows_of[b]]]
            rows_a.append(candidates[candidates >= 0])
            rows_b.append(rows_of[b][candidates >= 0])
        row_of_point[problem.point[rows_of[a]]] = -1
    first = np.concatenate([[0], np.cumsum(shared[ends[:, 0], ends[:, 1]])]).astype(np.int64)
    return np.concatenate(rows_a), np.concatenate(rows_b), first, ends, shared


def _subsample(
    problem: StartProblem,
    rows_a: IntArray,
    rows_b: IntArray,
    first: IntArray,
    ends: IntArray,
    rng: np.random.Generator,
) -> SharedRays:
    """At most SEARCH_SPOTS shared spots of each pair."""
    counts = np.minimum(np.diff(first), SEARCH_SPOTS)
    chosen = np.zeros((len(ends), SEARCH_SPOTS), dtype=np.int64)
    for p, count in enumerate(counts):
        total = first[p + 1] - first[p]
        chosen[p, :count] = first[p] + (np.arange(total) if count == total else rng.choice(total, count, replace=False))
    is_used = np.arange(SEARCH_SPOTS) < counts[:, None]
    ray_a, ray_b = problem.ray_xy[rows_a[chosen]], problem.ray_xy[rows_b[chosen]]
    return SharedRays(ends[:, 0], ends[:, 1], ray_a, ray_b, is_used)


def _search(rays: SharedRays, p: int, tolerance: FloatArray, seed: int) -> FloatArray | None:
    """One pair's fundamental matrix by MAGSAC, in rays scaled to tolerances; None where the search finds none."""
    tol_a, tol_b = float(tolerance[rays.a[p]]), float(tolerance[rays.b[p]])
    used = rays.is_used[p]
    params = cv2.UsacParams()
    params.threshold = SEARCH_TOLERANCES
    params.confidence = 0.999
    params.maxIterations = 1000
    params.randomGeneratorState = seed
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    try:
        matrix, _ = cv2.findFundamentalMat(rays.ray_a[p, used] / tol_a, rays.ray_b[p, used] / tol_b, params)
    except cv2.error:  # OpenCV asserts where it meets no model at all
        return None
    if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return None
    fundamental = matrix * np.outer([1 / tol_b, 1 / tol_b, 1.0], [1 / tol_a, 1 / tol_a, 1.0])
    return fundamental / np.linalg.norm(fundamental)


def _agrees(
    problem: StartProblem, fundamental: FloatArray, bend: FloatArray, rows_a: IntArray, rows_b: IntArray
) -> BoolArray:
    """Whether each shared spot lies within the pair's tolerance, widened where the bulk of the pair is wider."""
    ray_a, ray_b = problem.ray_xy[rows_a], problem.ray_xy[rows_b]
    a, b = problem.camera[rows_a], problem.camera[rows_b]
    distance = np.abs(
        sampson(
            fundamental,
            unbend(ray_a, bend[a]),
            unbend(ray_b, bend[b]),
            tolerance_at(problem.tolerance[a], ray_a),
            tolerance_at(problem.tolerance[b], ray_b),
        )
    )
    # 1.4826 median = sigma of a normal distribution; 4 sigma keep all but one honest spot in 16,000.
    limit = np.clip(4 * 1.4826 * np.median(distance), 1.0, MAX_TOLERANCES)
    return distance <= limit


def _majority(n_rows: int, rows_a: IntArray, rows_b: IntArray, agrees: BoolArray) -> BoolArray:
    """(K,) whether an observation agrees with the trustworthy part of its frame's other views.

    A view is trusted by the share of the others that agree with it. Then an observation is an inlier when at least
    half of the trust around it agrees: two honest views outvote two false ones, which agree with nobody.
    """
    rows, others = np.concatenate([rows_a, rows_b]), np.concatenate([rows_b, rows_a])
    yes = np.concatenate([agrees, agrees]).astype(np.float64)
    n_votes = np.bincount(rows, minlength=n_rows)
    trust = np.bincount(rows, weights=yes, minlength=n_rows) / np.maximum(n_votes, 1)
    in_favour = np.bincount(rows, weights=yes * trust[others], minlength=n_rows)
    cast = np.bincount(rows, weights=trust[others], minlength=n_rows)
    return (in_favour > 0) & (in_favour >= 0.5 * cast)
