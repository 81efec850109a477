"""The start of Svoboda, Martinec, Pajdla (Presence 14(4), 2005) as a list of its steps.

For rooms where cameras see the same spots three at a time; a thin chain of pairs needs the anchor's start.
"""

from __future__ import annotations

import numpy as np

from network_calib.depths import choose_spots, overlapping_triples, projective_depths
from network_calib.epipolar import tolerance_at, unbend
from network_calib.errors import DegenerateError
from network_calib.factorise import ProjectiveRoom, Views, cauchy_weights, factorise, intersect, reprojection_error
from network_calib.metric_upgrade import upgrade_to_metric
from network_calib.observations import BoolArray
from network_calib.pairs import PairGraph
from network_calib.start import Start, StartProblem

# Observations that the epipolar test rejected hardly pull at a spot, yet can be found to fit it.
DOUBTED_WEIGHT = 1e-4
# What the unbending leaves of a lens may widen a camera's tolerance up to this much.
MAX_TOLERANCES = 3.0


def factorisation_start(problem: StartProblem, graph: PairGraph, *, rng: np.random.Generator) -> Start:
    """Metric cameras from spots alone.

    Args:
        problem: nominal rays.
        graph: its verified pairs.
        rng: draws the spots for the factorisation.

    Raises:
        DegenerateError: fewer than three cameras, overlap too thin, spots in a plane, or no plausible metric frame;
            the message says which.
    """
    if problem.n_cameras < 3:
        raise DegenerateError(
            f"factorisation needs three cameras or more to find focal lengths, got {problem.n_cameras}",
            advice="Give the intrinsics and start from the anchor, or add a camera.",
        )
    table = choose_spots(problem, graph, rng=rng)
    triples = overlapping_triples(table.is_seen, problem.names)
    depths = projective_depths(table, graph.pairs, triples)
    tied_triples = overlapping_triples(np.isfinite(depths), problem.names)
    projective = factorise(table, depths, tied_triples)
    metric = upgrade_to_metric(
        projective.matrices, projective.points, is_focal_known=problem.is_focal_known, names=problem.names
    )
    is_inlier = _agreeing(problem, graph, projective)
    return Start("factorisation", metric.cam_from_world, metric.focal_ratio, is_inlier)


def _agreeing(problem: StartProblem, graph: PairGraph, projective: ProjectiveRoom) -> BoolArray:
    """(K,) observations that fit the projective cameras, spots of all frames intersected robustly.

    Judged before the metric upgrade: there the rays are unbent and the principal points free, so honest observations
    fit by fractions of the tolerance. An observation counts only if another of its spot does.
    """
    views = Views(
        problem.camera,
        problem.point,
        unbend(problem.ray_xy, graph.bend[problem.camera]),
        tolerance_at(problem.tolerance[problem.camera], problem.ray_xy),
    )
    trust = np.where(graph.is_inlier, 1.0, DOUBTED_WEIGHT)
    points = intersect(projective.matrices, views, trust / views.tolerance**2)
    for _ in range(2):
        points = intersect(projective.matrices, views, trust * cauchy_weights(projective.matrices, points, views))
    error = reprojection_error(projective.matrices, points, views)
    typical = np.array([np.median(error[graph.is_inlier & (problem.camera == c)]) for c in range(problem.n_cameras)])
    # 1.18 sigma is the median length of a two-dimensional normal error; 4 sigma keep all but one in 3000.
    limit = np.clip(4 / 1.18 * typical, 1.0, MAX_TOLERANCES)[problem.camera]
    is_inlier = error <= limit
    n_agreeing = np.bincount(problem.point, weights=is_inlier, minlength=problem.n_points)
    return is_inlier & (n_agreeing[problem.point] >= 2)
