"""Start by growth: two cameras first, then one camera after another by resection (step 4 of the method).

Every camera that shares triangulated spots with the part already placed can be added, so a chain of rooms works as
well as one room that everybody sees. Focal ratios come from all fundamental matrices at once before anything is placed
(`focal_ratios.py`); the joint engine pulls the growing network straight in between (`rough_bundle.py`).
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from network_calib.epipolar import tolerance_at, unbend
from network_calib.errors import ConvergenceError, DegenerateError
from network_calib.focal_ratios import focal_ratios
from network_calib.growth import Growth
from network_calib.observations import FloatArray, IntArray
from network_calib.pairs import MAX_TOLERANCES, Pair, PairGraph
from network_calib.rough_bundle import RoughNetwork
from network_calib.seed_pair import MAX_CANDIDATES, SPOTS, Seed, find_seed
from network_calib.start import Start, StartProblem

# Rays without their bend still miss by more than a tolerance at the rim.
GROWTH_TOLERANCES = 2.0
SPOTS_PER_CAMERA = 400
MIN_SPOTS_PER_PAIR = 40
# The whole network is refined again once it has grown by this factor.
REFINE_GROWTH = 1.25
ENOUGH_INLIERS = 0.85
MAX_SEEDS = 3
LOOSE_SLACK = 5.0
# The common scale of the focal ratios is the weakest thing that pairs know; tried in this order with each seed.
RATIO_FACTORS = (1.0, 0.75, 1.33)


def anchor_start(
    problem: StartProblem, graph: PairGraph, *, rng: np.random.Generator, seed_pair: tuple[int, int] | None = None
) -> Start:
    """Grow the network from two cameras.

    Args:
        problem: nominal rays.
        graph: its verified pairs.
        rng: draws the spots that take part; the same generator state gives the same start.
        seed_pair: the two cameras to begin with, such as the metric stereo pair; None to choose them.

    Returns:
        All cameras, the first of the seed at the origin, the seed's baseline about one.

    Raises:
        DegenerateError: the cameras fall into islands, two cameras alone have unknown focal lengths, or spots that
            three cameras see together are too few to carry the scale from one camera to the next.
    """
    _refuse_islands(graph)
    if problem.n_cameras == 2 and not problem.is_focal_known.all():
        raise DegenerateError(
            f"{problem.names[0]} and {problem.names[1]} alone do not determine their focal lengths",
            advice="Give the intrinsics of both cameras, or add a third camera that sees the same spots.",
        )
    ratio = focal_ratios(graph, problem.is_focal_known)
    rows = _chosen_rows(problem, graph, rng)
    growth = _grow_from_best_seed(problem, graph, ratio, rows, seed_pair)
    return _finish(problem, graph, growth)


def _grow_from_best_seed(
    problem: StartProblem, graph: PairGraph, ratio: FloatArray, rows: IntArray, seed_pair: tuple[int, int] | None
) -> Growth:
    """Grow from one seed after another until a network explains nearly all rows; the best where none does."""
    best, best_share, stuck = None, -1.0, None
    factors = (1.0,) if problem.is_focal_known.all() else RATIO_FACTORS
    for rank, factor in itertools.product(range(MAX_SEEDS), factors):
        scaled = np.where(problem.is_focal_known, 1.0, factor * ratio)
        seeds = _seeds(problem, graph, scaled, rows, seed_pair)
        if rank >= len(seeds):
            continue
        growth = _begin(problem, graph, scaled, rows, seeds[rank])
        try:
            _grow(growth, problem.names)
        except (DegenerateError, ConvergenceError) as error:
            stuck = stuck or error
            continue
        share = float(growth.agreeing().mean())
        if share >= ENOUGH_INLIERS:
            return growth
        if share > best_share:
            best, best_share = growth, share
    if best is None:
        raise stuck or DegenerateError(
            "no two cameras see enough spots from different sides to begin with",
            advice="Wave where two cameras look at the spot from directions at least some degrees apart.",
        )
    return best


def _refuse_islands(graph: PairGraph) -> None:
    islands, bridge = graph.islands(), graph.bridge()
    if bridge is None:
        return
    groups = "; ".join("{" + ", ".join(graph.names[c] for c in group) + "}" for group in islands)
    a, b = bridge
    raise DegenerateError(
        f"the cameras are not connected: {groups}",
        advice=(
            f"Wave where {graph.names[a]} and {graph.names[b]} both see the spot: they share {graph.shared[a, b]} "
            f"spots, of which {graph.inliers[a, b]} agree."
        ),
    )


def _chosen_rows(problem: StartProblem, graph: PairGraph, rng: np.random.Generator) -> IntArray:
    """Inlier rows of a subset of the spots in which every verified pair has its share.

    All pairs take the spots first in one common order, so that they take the same ones; spots of three views or more
    come first, because they alone carry the scale from camera to camera.
    """
    rows = np.flatnonzero(graph.is_inlier)
    n_views = np.bincount(problem.point[rows], minlength=problem.n_points)
    rank = np.empty(problem.n_points, dtype=np.int64)
    rank[np.lexsort((rng.random(problem.n_points), n_views < 3))] = np.arange(problem.n_points)
    by_camera = rows[np.lexsort((rank[problem.point[rows]], problem.camera[rows]))]
    edges = np.searchsorted(problem.camera[by_camera], np.arange(problem.n_cameras + 1))
    ranks = [rank[problem.point[by_camera[edges[c] : edges[c + 1]]]] for c in range(problem.n_cameras)]
    degree = np.bincount([c for pair in graph.pairs for c in (pair.a, pair.b)], minlength=problem.n_cameras)
    is_chosen = np.zeros(problem.n_points, dtype=bool)
    for pair in graph.pairs:
        quota = max(MIN_SPOTS_PER_PAIR, SPOTS_PER_CAMERA // min(degree[pair.a], degree[pair.b]))
        is_chosen[np.intersect1d(ranks[pair.a], ranks[pair.b], assume_unique=True)[:quota]] = True
    return rows[is_chosen[rank[problem.point[rows]]]]


def _true_rays(problem: StartProblem, graph: PairGraph, ratio: FloatArray, rows: IntArray) -> FloatArray:
    camera = problem.camera[rows]
    return unbend(problem.ray_xy[rows], graph.bend[camera]) / ratio[camera, None]


def _seeds(
    problem: StartProblem, graph: PairGraph, ratio: FloatArray, rows: IntArray, given: tuple[int, int] | None
) -> list[Seed]:
    """Seeds in the order in which to try them: the given pair first, then the best scores."""
    pairs = sorted(graph.pairs, key=lambda pair: -pair.n_inliers)[:MAX_CANDIDATES]
    first = [pair for pair in graph.pairs if given is not None and {pair.a, pair.b} == set(given)]
    found = [_seed_of(problem, graph, ratio, rows, pair) for pair in first + [p for p in pairs if p not in first]]
    is_given = [True] * len(first) + [False] * len(found)
    ranked = sorted(
        zip(found, is_given, strict=False), key=lambda item: (not item[1], -item[0].score if item[0] else 0)
    )
    return [seed for seed, _ in ranked if seed is not None][:MAX_SEEDS]


def _seed_of(problem: StartProblem, graph: PairGraph, ratio: FloatArray, rows: IntArray, pair: Pair) -> Seed | None:
    of_a, of_b = (rows[problem.camera[rows] == c] for c in (pair.a, pair.b))
    _, in_a, in_b = np.intersect1d(problem.point[of_a], problem.point[of_b], assume_unique=True, return_indices=True)
    take = np.linspace(0, len(in_a) - 1, min(SPOTS, len(in_a))).astype(np.int64)
    ray_a = _true_rays(problem, graph, ratio, of_a[in_a[take]])
    ray_b = _true_rays(problem, graph, ratio, of_b[in_b[take]])
    ends = [pair.a, pair.b]
    return find_seed(pair, ray_a, ray_b, float(GROWTH_TOLERANCES * (problem.tolerance[ends] / ratio[ends]).mean()))


def _begin(problem: StartProblem, graph: PairGraph, ratio: FloatArray, rows: IntArray, seed: Seed) -> Growth:
    """Two cameras and the spots that they see."""
    chosen, local = np.unique(problem.point[rows], return_inverse=True)
    camera, n = problem.camera[rows], problem.n_cameras
    network = RoughNetwork(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 4)))
    network.lens[:, 0] = ratio
    network.rotations[seed.b], network.centres[seed.b] = seed.b_from_a, seed.centre_b
    growth = Growth(
        camera=camera,
        point=local,
        ray_xy=unbend(problem.ray_xy[rows], graph.bend[camera]),
        tolerance=GROWTH_TOLERANCES * tolerance_at(problem.tolerance[camera], problem.ray_xy[rows]),
        is_lens_fixed=problem.is_focal_known,
        network=network,
        order=[seed.a, seed.b],
        points=np.full((len(chosen), 3), np.nan),
        is_valid=np.zeros(len(chosen), dtype=bool),
    )
    growth.place_spots()
    return growth


def _grow(growth: Growth, names: tuple[str, ...]) -> None:
    """Add camera after camera until none is left, refining in between."""
    n_refined = 2
    while len(growth.order) < len(names):
        is_added = growth.add_next()
        if not is_added:
            # While few cameras are placed, wrong focal lengths bend the world by many tolerances: let them be wrong,
            # add the camera that can right them, and refine.
            growth.slack = LOOSE_SLACK
            growth.place_spots()
            if not growth.add_next():
                raise _stuck(growth, names)
            growth.refine(max_iterations=15)
            growth.slack = 1.0
        if not is_added or len(growth.order) >= REFINE_GROWTH * n_refined:
            growth.refine(max_iterations=8)
            n_refined = len(growth.order)
    growth.refine(max_iterations=20)


def _stuck(growth: Growth, names: tuple[str, ...]) -> DegenerateError:
    n_seen = growth.n_seen
    placed = ", ".join(names[c] for c in growth.order)
    nearest = int(np.argmax(np.where(growth.is_placed, -1, n_seen)))
    return DegenerateError(
        f"{names[nearest]} cannot be placed: it sees {n_seen[nearest]} spots that two of the placed cameras ({placed}) "
        f"also see, and they do not determine where it is",
        advice=f"Wave where {names[nearest]} sees the spot together with two of them, at many depths and heights.",
    )


def _finish(problem: StartProblem, graph: PairGraph, growth: Growth) -> Start:
    """Judge all observations by the grown cameras."""
    everything = replace(
        growth,
        camera=problem.camera,
        point=problem.point,
        ray_xy=unbend(problem.ray_xy, graph.bend[problem.camera]),
        tolerance=tolerance_at(problem.tolerance[problem.camera], problem.ray_xy),
    )
    distance = everything.distances(np.where(graph.is_inlier, 1.0, 1e-3))
    # As between pairs: what the bend leaves of a lens may widen the tolerance.
    limit = float(np.clip(4 * 1.4826 * np.median(distance[graph.is_inlier]), 1.0, MAX_TOLERANCES))
    agrees = distance <= limit
    is_inlier = agrees & (np.bincount(problem.point[agrees], minlength=problem.n_points)[problem.point] >= 2)
    return Start("anchor", growth.network.poses_for_central_lenses(), growth.network.lens[:, 0], is_inlier)
