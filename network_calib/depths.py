"""Projective depths of spots from epipolar geometry: step 2 of Svoboda, Martinec, Pajdla (Sturm-Triggs).

A spot j seen by camera c as the homogeneous ray x has a depth lambda with lambda x = P_c X_j. Two cameras a, b with the
fundamental matrix F and the epipole e of a in b tie their depths (Sturm and Triggs 1996, eq. 7):

    lambda_b (e x x_b) = s lambda_a F x_a    =>    lambda_b / lambda_a = s (e x x_b) . (F x_a) / |e x x_b|^2

with one unknown factor s for each pair, because F has no scale.

Deviations from the paper, both for the sake of missing detections:

- Martinec and Pajdla carry depths along one star or sequence of views, and split the columns of spots that the central
  view missed. Here every verified pair speaks: the factors s are made consistent first (around three cameras that see
  the same spots the depth ratios must close), and each spot's depths are the weighted least squares of the logarithms
  of all its ratios. No view is central, so none has to see everything; a ratio near an epipole, which is noise, weighs
  little. With one star of pairs it reduces to the paper's formula.
- Depths are kept positive. A spot whose ratio has the other sign than its pair's was not in front of both cameras,
  hence false there, and that ratio is dropped (oriented projective geometry).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from network_calib.epipolar import homogeneous, tolerance_at, unbend
from network_calib.errors import DegenerateError
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.pairs import Pair, PairGraph
from network_calib.start import StartProblem

# Enough for focal lengths within a percent at 0.2 px, and a few hundredths of a second.
MAX_OBSERVATIONS = 6000
# Three cameras are solved together from a 9 x 9 moment matrix of rank 4; twice its size keeps it away from exact fits.
MIN_COMMON_SPOTS = 18
# How many third cameras speak for each pair: redundancy without the cubic number of all triples.
THIRDS_PER_PAIR = 3
IMAGE_CELLS = 8


@dataclass(frozen=True, slots=True)
class SpotTable:
    """J chosen spots against all C cameras.

    Attributes:
        spot: (J,) index of each spot in the problem.
        ray: (J, C, 3) homogeneous unbent rays [x, y, 1]; zeros where the camera did not see the spot.
        tolerance: (J, C) in ray units; infinite where the camera did not see the spot.
        is_seen: (J, C).
    """

    spot: IntArray
    ray: FloatArray
    tolerance: FloatArray
    is_seen: BoolArray


def choose_spots(problem: StartProblem, graph: PairGraph, *, rng: np.random.Generator) -> SpotTable:
    """Draw the spots for the factorisation: epipolar inliers with three views or more, spread over the images.

    A spot's chance grows with its number of views and with the rarity of the image cells it falls in, so a person who
    lingers in one corner does not outvote the rest of the walk (weighted draw of Efraimidis and Spirakis).
    """
    kept = np.flatnonzero(graph.is_inlier)
    camera, point = problem.camera[kept], problem.point[kept]
    ray = unbend(problem.ray_xy[kept], graph.bend[camera])
    n_views = np.bincount(point, minlength=problem.n_points)
    rarity = np.bincount(point, weights=_rarity(camera, ray), minlength=problem.n_points)
    chosen = np.flatnonzero(n_views >= 3)
    max_spots = int(MAX_OBSERVATIONS / max(n_views[chosen].mean(), 3)) if len(chosen) else 0
    if len(chosen) > max_spots:
        keys = np.log(rng.random(len(chosen))) / rarity[chosen]
        chosen = np.sort(chosen[np.argpartition(-keys, max_spots)[:max_spots]])
    place = np.full(problem.n_points, -1)
    place[chosen] = np.arange(len(chosen))
    is_used = place[point] >= 0
    rows, columns = place[point[is_used]], camera[is_used]
    table = np.zeros((len(chosen), problem.n_cameras, 3))
    table[rows, columns] = homogeneous(ray[is_used])
    tolerance = np.full(table.shape[:2], np.inf)
    tolerance[rows, columns] = tolerance_at(problem.tolerance[columns], problem.ray_xy[kept][is_used])
    return SpotTable(chosen, table, tolerance, table[..., 2] > 0)


def overlapping_triples(is_seen: BoolArray, names: tuple[str, ...]) -> IntArray:
    """(T, 3) cameras a < b < c that see enough spots together, the strongest few for each pair.

    Args:
        is_seen: (J, C).
        names: C camera names, for the message.

    Raises:
        DegenerateError: the triples do not hang together. A projective frame passes from one triple to the next only
            through two cameras that both contain.
    """
    seen = is_seen.astype(np.float64)
    common = np.stack([seen.T @ (seen * seen[:, [c]]) for c in range(len(names))])
    c = np.arange(len(names))
    common[c, c] = common[:, c, c] = common[c, :, c] = 0
    n_best = min(THIRDS_PER_PAIR, len(names))
    best = np.argsort(-common, axis=2, kind="stable")[:, :, :n_best]
    a, b, rank = np.nonzero(np.take_along_axis(common, best, axis=2) >= MIN_COMMON_SPOTS)
    triples = np.unique(np.sort(np.column_stack([a, b, best[a, b, rank]]), axis=1), axis=0)
    placed = _grown_from_strongest(triples, common)
    if not placed.any():
        raise DegenerateError(
            f"factorisation needs three cameras that see {MIN_COMMON_SPOTS} spots together, found none",
            advice="Wave where three cameras see the spot at once, or start from the anchor.",
        )
    if not placed.all():
        lone = ", ".join(name for name, is_placed in zip(names, placed, strict=True) if not is_placed)
        raise DegenerateError(
            f"factorisation cannot tie {lone} to the others: each needs {MIN_COMMON_SPOTS} spots in common with two "
            f"cameras that are tied already",
            advice="Wave where three cameras see the spot at once, or start from the anchor.",
        )
    return triples


def projective_depths(table: SpotTable, pairs: tuple[Pair, ...], triples: IntArray) -> FloatArray:
    """(J, C) positive depths, consistent up to a factor for each camera and each spot; NaN where undetermined.

    A spot's views that fall apart (no chain of verified pairs joins them) keep only their largest part.
    """
    log_ratio, weight = _pair_log_ratios(table, pairs)
    log_scale, is_in_loop = _pair_log_scales(log_ratio, pairs, triples)
    log_ratio -= log_scale[:, None]
    weight[~_consistent(pairs, is_in_loop, table.is_seen.shape[1])] = 0.0
    n_spots, n_cameras = table.is_seen.shape
    laplacian = np.zeros((n_spots, n_cameras, n_cameras))
    rhs = np.zeros((n_spots, n_cameras))
    for p, pair in enumerate(pairs):
        flow = weight[p] * np.where(weight[p] > 0, log_ratio[p], 0.0)
        rhs[:, pair.b] += flow
        rhs[:, pair.a] -= flow
        laplacian[:, pair.a, pair.b] = laplacian[:, pair.b, pair.a] = -weight[p]
    is_tied = _largest_parts(laplacian < 0)
    both_tied = is_tied[:, :, None] & is_tied[:, None, :]
    laplacian *= both_tied
    degree = -laplacian.sum(axis=2)
    diagonal = np.arange(n_cameras)
    laplacian[:, diagonal, diagonal] = np.where(is_tied, degree, 1.0)
    # The mean log depth of a spot is free; adding a constant to its tied block fixes it at zero.
    laplacian += degree.max(axis=1, initial=0.0)[:, None, None] / n_cameras * both_tied
    log_depth = np.linalg.solve(laplacian, np.where(is_tied, rhs, 0.0)[..., None])[..., 0]
    return np.where(is_tied, np.exp(np.clip(log_depth, -20, 20)), np.nan)


def _rarity(camera: IntArray, ray_xy: FloatArray) -> FloatArray:
    """(K,) one over the root of how many observations share the cell of the camera's image."""
    low, high = ray_xy.min(axis=0, initial=np.inf), ray_xy.max(axis=0, initial=-np.inf)
    scaled = IMAGE_CELLS * (ray_xy - low) / np.maximum(high - low, 1e-12)
    column, row = np.minimum(scaled.astype(np.int64), IMAGE_CELLS - 1).T
    cell = (camera * IMAGE_CELLS + row) * IMAGE_CELLS + column
    return 1 / np.sqrt(np.bincount(cell)[cell].astype(np.float64))


def _grown_from_strongest(triples: IntArray, common: FloatArray) -> BoolArray:
    """(C,) cameras that join when triples are added that share two cameras with those already in."""
    placed = np.zeros(len(common), dtype=bool)
    if not len(triples):
        return placed
    placed[triples[common[tuple(triples.T)].argmax()]] = True
    for _ in range(len(common)):
        joining = triples[placed[triples].sum(axis=1) == 2]
        if not len(joining):
            break
        placed[joining] = True
    return placed


def _pair_log_ratios(table: SpotTable, pairs: tuple[Pair, ...]) -> tuple[FloatArray, FloatArray]:
    """(P, J) log(lambda_b / lambda_a) up to each pair's scale, NaN where not both saw it, and (P, J) weights.

    The ratio is a quotient of the distances of x_a and x_b to their epipoles; equal ray noise gives it a relative
    variance proportional to 1 / |e_a x x_a|^2 + 1 / |e_b x x_b|^2, of unit epipoles.
    """
    log_ratio = np.full((len(pairs), len(table.spot)), np.nan)
    weight = np.zeros_like(log_ratio)
    for p, pair in enumerate(pairs):
        j = np.flatnonzero(table.is_seen[:, pair.a] & table.is_seen[:, pair.b])
        if not len(j):
            continue
        x_a, x_b = table.ray[j, pair.a], table.ray[j, pair.b]
        u, _, vt = np.linalg.svd(pair.fundamental)
        line_b, line_a = np.cross(u[:, 2], x_b), np.cross(vt[2], x_a)
        spread_b, spread_a = np.maximum((line_b**2).sum(axis=1), 1e-12), np.maximum((line_a**2).sum(axis=1), 1e-12)
        ratio = (line_b * (x_a @ pair.fundamental.T)).sum(axis=1) / spread_b
        ratio *= np.sign(np.median(ratio))
        is_in_front = ratio > 1e-12
        log_ratio[p, j[is_in_front]] = np.log(ratio[is_in_front])
        weight[p, j[is_in_front]] = (1 / (1 / spread_a + 1 / spread_b))[is_in_front]
    return log_ratio, weight


def _pair_log_scales(log_ratio: FloatArray, pairs: tuple[Pair, ...], triples: IntArray) -> tuple[FloatArray, BoolArray]:
    """Logarithms (P,) of the factors s that make the depth ratios close around every three cameras.

    For a < b < c and each common spot, ratio_ab + ratio_bc - ratio_ac (logarithms) equals the same sum of the factors;
    its median over the spots is one equation. A factor for each camera stays free (it is the camera's own scale); the
    ridge picks the smallest solution. Also returns (P,) whether a pair stands in any equation.
    """
    index = {(pair.a, pair.b): p for p, pair in enumerate(pairs)}
    normal, rhs = 1e-6 * np.eye(len(pairs)), np.zeros(len(pairs))
    is_in_loop = np.zeros(len(pairs), dtype=bool)
    signs = np.array([1.0, 1.0, -1.0])
    for a, b, c in triples.tolist():
        if not ((a, b) in index and (b, c) in index and (a, c) in index):
            continue
        loop = [index[a, b], index[b, c], index[a, c]]
        closure = signs @ log_ratio[loop]
        closure = closure[np.isfinite(closure)]
        if len(closure) < MIN_COMMON_SPOTS // 2:
            continue
        median = np.median(closure)
        spread = np.median(np.abs(closure - median))
        weight = len(closure) / (1 + (spread / 0.02) ** 2)  # below 2 % the medians are equally good
        normal[np.ix_(loop, loop)] += weight * np.outer(signs, signs)
        rhs[loop] += weight * median * signs
        is_in_loop[loop] = True
    return np.asarray(np.linalg.solve(normal, rhs), dtype=np.float64), is_in_loop


def _consistent(pairs: tuple[Pair, ...], is_in_loop: BoolArray, n_cameras: int) -> BoolArray:
    """(P,) pairs whose factor is known, or is free because the pair closes no ring of cameras with the others."""
    is_kept = is_in_loop.copy()
    group = np.arange(n_cameras)
    strongest_first = sorted(range(len(pairs)), key=lambda p: (not is_in_loop[p], -pairs[p].n_inliers))
    for p in strongest_first:
        a, b = group[pairs[p].a], group[pairs[p].b]
        is_kept[p] |= a != b
        group[group == b] = a
    return is_kept


def _largest_parts(is_linked: BoolArray) -> BoolArray:
    """(J, C) the views of each spot that belong to its largest linked part, given links (J, C, C)."""
    n_spots, n_cameras, _ = is_linked.shape
    j, a, b = np.nonzero(is_linked)
    n_nodes = n_spots * n_cameras
    links = coo_array((np.ones(len(j), dtype=np.int8), (j * n_cameras + a, j * n_cameras + b)), (n_nodes, n_nodes))
    _, part = connected_components(links, directed=False)
    size = np.bincount(part)[part].reshape(n_spots, n_cameras)
    part = part.reshape(n_spots, n_cameras)
    biggest = part[np.arange(n_spots), size.argmax(axis=1)]
    return (part == biggest[:, None]) & (size > 1)
