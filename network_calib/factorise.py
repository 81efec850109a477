"""Rank-4 factorisation with missing points: step 2 of Svoboda, Martinec, Pajdla, and its outlier loop (step 3).

The depths times the rays fill a matrix of three rows for each camera and one column for each spot, with holes; its
columns span a space of four dimensions, the projective cameras stacked.

Deviations from the paper, with their reasons:

- Martinec and Pajdla draw tuples of four columns and intersect the spaces that their common views allow. Here the
  tuples are of *cameras*: three cameras and all the spots that they have in common. The left null space of such a 9-row
  part (five dimensions) constrains the cameras exactly as theirs does, but averages the noise of hundreds of spots
  instead of interpolating four, and needs no random draws. Any three cameras with enough common spots serve, so no spot
  has to be seen by all.
- The paper rejects by reprojection error, factorises again, and so on. Here the same loop runs as resection and
  intersection in turn with Cauchy weights of the reprojection error, which is that loop with soft decisions, and which
  also undoes the bias of the algebraic error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.depths import SpotTable
from network_calib.errors import DegenerateError
from network_calib.observations import BoolArray, FloatArray, IntArray

N_BALANCINGS = 5
N_ALTERNATIONS = 4
# How far the fourth dimension of the columns must stand above their noise, the fifth: a ratio of standard deviations.
MIN_DEPTH_SIGNAL = 8.0


@dataclass(frozen=True, slots=True)
class ProjectiveRoom:
    """Cameras and spots up to one projective transformation of space; depths of inliers are positive.

    Attributes:
        matrices: (C, 3, 4) cameras, ray ~ matrices @ points.
        points: (J, 4) homogeneous spots.
        is_inlier: (J, C) seen, and reprojected within the tolerance.
        median_error: median reprojection error of all that was seen, in tolerances.
    """

    matrices: FloatArray
    points: FloatArray
    is_inlier: BoolArray
    median_error: float


@dataclass(frozen=True, slots=True)
class Views:
    """K views as rows, sorted by spot: what resection and intersection work on.

    Attributes:
        camera: (K,) camera index.
        spot: (K,) spot index, 0..J-1, each at least once.
        ray_xy: (K, 2) unbent rays.
        tolerance: (K,) in ray units.
    """

    camera: IntArray
    spot: IntArray
    ray_xy: FloatArray
    tolerance: FloatArray


def factorise(table: SpotTable, depths: FloatArray, triples: IntArray) -> ProjectiveRoom:
    """Projective cameras and spots from rays and depths.

    Args:
        table: the chosen spots.
        depths: (J, C) projective depths, NaN where unknown.
        triples: (T, 3) cameras that have enough of these spots in common.

    Raises:
        DegenerateError: the columns span fewer than four dimensions (spots in a plane), or the cameras found do not
            explain the rays.
    """
    is_tied = np.isfinite(depths)
    scaled = _balanced(table.ray * np.where(is_tied, depths, 0.0)[..., None], is_tied)
    matrices = _column_space(scaled, is_tied, triples)
    spots, cameras = np.nonzero(is_tied)
    kept, spots = np.unique(spots, return_inverse=True)
    views = Views(cameras, spots, table.ray[is_tied][:, :2], table.tolerance[is_tied])
    weight = np.ones(len(spots))
    points = intersect(matrices, views, weight)
    for _ in range(N_ALTERNATIONS):
        weight = cauchy_weights(matrices, points, views)
        points = intersect(matrices, views, weight)
        weight = cauchy_weights(matrices, points, views)
        matrices = _resect(points, views, weight, matrices)
    error = reprojection_error(matrices, points, views)
    median = float(np.median(error))
    if not median < 1:
        raise DegenerateError(
            f"factorisation does not explain the observations: median reprojection error {median:.1f} tolerances",
            advice="Cameras may be out of step, or their overlap too thin; start from the anchor.",
        )
    is_inlier = np.zeros_like(is_tied)
    is_inlier[is_tied] = error <= 1
    all_points = np.full((len(table.spot), 4), np.nan)
    all_points[kept] = points
    return ProjectiveRoom(matrices, all_points, is_inlier, median)


def intersect(matrices: FloatArray, views: Views, weight: FloatArray) -> FloatArray:
    """(J, 4) unit spots that minimise the weighted algebraic error; signs such that most of their depths are positive.

    Args:
        matrices: (C, 3, 4).
        views: the rays.
        weight: (K,) for the algebraic residual P_xy X - x P_z X; over the squared depth it counts ray units.
    """
    first = np.searchsorted(views.spot, np.arange(views.spot[-1] + 1))
    own = matrices[views.camera]
    rows = own[:, :2] - views.ray_xy[:, :, None] * own[:, 2:]
    moments = np.add.reduceat(np.matmul(rows.swapaxes(1, 2) * weight[:, None, None], rows), first)
    points = np.linalg.eigh(moments)[1][:, :, 0]
    depth = (own[:, 2] * points[views.spot]).sum(axis=1)
    sign = np.sign(np.add.reduceat(weight * np.sign(depth), first))
    return points * np.where(sign == 0, 1.0, sign)[:, None]


def reprojection_error(matrices: FloatArray, points: FloatArray, views: Views) -> FloatArray:
    """(K,) distance of ray and reprojection in tolerances; infinite where the spot is not in front of the camera."""
    ray = np.einsum("kij,kj->ki", matrices[views.camera], points[views.spot])
    is_in_front = ray[:, 2] > 1e-12
    error = np.linalg.norm(ray[:, :2] / np.where(is_in_front, ray[:, 2], np.nan)[:, None] - views.ray_xy, axis=1)
    return np.where(is_in_front, error / views.tolerance, np.inf)


def cauchy_weights(matrices: FloatArray, points: FloatArray, views: Views) -> FloatArray:
    """(K,) weights of the algebraic residuals that make them robust reprojection errors, by the last depths.

    Behind its camera a view weighs nothing but a trace, so that no spot or camera is left without an equation.
    """
    depth = np.einsum("kj,kj->k", matrices[views.camera, 2], points[views.spot])
    error = reprojection_error(matrices, points, views)
    return 1 / ((1 + np.minimum(error, 1e6) ** 2) * (np.maximum(np.abs(depth), 1e-9) * views.tolerance) ** 2)


def _balanced(scaled: FloatArray, is_tied: BoolArray) -> FloatArray:
    """Columns and cameras of (J, C, 3) scaled in turn to a geometric mean norm of one (Sturm-Triggs balancing)."""
    norm = np.linalg.norm(scaled, axis=2)
    start = np.log(np.where(is_tied, norm, 1.0))
    rest = start.copy()
    for _ in range(N_BALANCINGS):
        rest -= np.where(is_tied, (rest.sum(axis=1) / np.maximum(is_tied.sum(axis=1), 1))[:, None], 0.0)
        rest -= np.where(is_tied, rest.sum(axis=0) / np.maximum(is_tied.sum(axis=0), 1), 0.0)
    return scaled * np.exp(rest - start)[..., None]


def _column_space(scaled: FloatArray, is_tied: BoolArray, triples: IntArray) -> FloatArray:
    """(C, 3, 4) stacked cameras: the space that the null spaces of all triples leave over."""
    n_cameras = is_tied.shape[1]
    parts = [_columns_of_triple(scaled, is_tied, triple) for triple in triples]
    n_columns = np.array([len(part) for part in parts])
    values, vectors = np.linalg.eigh(np.stack([part.T @ part for part in parts]))
    signal = np.sqrt(np.maximum(values[:, 5], 0) / np.maximum(values[:, 4], 1e-300))
    if np.median(signal) < MIN_DEPTH_SIGNAL:
        raise DegenerateError(
            f"the spots do not fill space: their fourth projective dimension stands {np.median(signal):.1f} x above "
            f"the noise, expected at least {MIN_DEPTH_SIGNAL:.0f} x",
            advice="They lie nearly in a plane or on a line. Wave at different heights and distances.",
        )
    # The null space of a triple is as uncertain as its noise against the weakest of its four dimensions.
    weight = n_columns / (1 / signal**2 + 1e-6)
    null = vectors[:, :, :5] * np.sqrt(weight / weight.max())[:, None, None]
    rows = (3 * triples[:, :, None] + np.arange(3)).reshape(-1, 9)
    constraints = np.zeros((3 * n_cameras, 3 * n_cameras))
    np.add.at(constraints, (rows[:, :, None], rows[:, None, :]), null @ null.swapaxes(1, 2))
    return np.linalg.eigh(constraints)[1][:, :4].reshape(n_cameras, 3, 4)


def _columns_of_triple(scaled: FloatArray, is_tied: BoolArray, triple: IntArray) -> FloatArray:
    """(n, 9) columns common to three cameras, without those far from the rank-4 space of the rest.

    The distance from that space has five normal components, hence a median of 2.1 sigma: three medians keep all but
    one honest column in a million.
    """
    columns = scaled[is_tied[:, triple].all(axis=1)][:, triple].reshape(-1, 9)
    for _ in range(2):
        null = np.linalg.eigh(columns.T @ columns)[1][:, :5]
        off = np.linalg.norm(columns @ null, axis=1)
        columns = columns[off <= 3 * np.median(off)]
    return columns


def _resect(points: FloatArray, views: Views, weight: FloatArray, previous: FloatArray) -> FloatArray:
    """(C, 3, 4) cameras of unit norm that minimise the weighted algebraic error; signs as before."""
    order = np.argsort(views.camera, kind="stable")
    first = np.searchsorted(views.camera[order], np.arange(len(previous)))
    x = points[views.spot[order]]
    outer = (x[:, :, None] * x[:, None, :]) * weight[order, None, None]
    ray = views.ray_xy[order][:, :, None, None]
    moments = np.zeros((len(previous), 3, 4, 3, 4))
    moments[:, 0, :, 0] = moments[:, 1, :, 1] = np.add.reduceat(outer, first)
    for axis in (0, 1):
        cross = -np.add.reduceat(outer * ray[:, axis], first)
        moments[:, axis, :, 2] = moments[:, 2, :, axis] = cross
    moments[:, 2, :, 2] = np.add.reduceat(outer * (ray**2).sum(axis=1), first)
    matrices = np.linalg.eigh(moments.reshape(-1, 12, 12))[1][:, :, 0].reshape(-1, 3, 4)
    return matrices * np.sign((matrices * previous).sum(axis=(1, 2)))[:, None, None]
