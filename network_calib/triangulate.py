"""Triangulation of many spots at once, from posed cameras and undistorted rays; no loop over spots.

Conventions: `rotations` (C, 3, 3) are cam_from_world, `centres` (C, 3) lie in world, a ray is x/z, y/z in the camera.
Rows are observations in any order, except where a function asks for rows sorted by point.
"""

from __future__ import annotations

import numpy as np

from network_calib.observations import BoolArray, FloatArray, IntArray

N_STEPS = 8
N_MEDIAN_STEPS = 8
# Views of one spot that propose a position together: all pairs of up to nine views.
MAX_LAG = 8


def triangulate(
    camera: IntArray,
    point: IntArray,
    ray_xy: FloatArray,
    rotations: FloatArray,
    centres: FloatArray,
    n_points: int,
    *,
    weights: FloatArray | None = None,
    scale: FloatArray | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Spots nearest to their rays: the midpoint method, then Gauss-Newton steps on the rays' residuals.

    Args:
        camera: (K,) camera index.
        point: (K,) spot index.
        ray_xy: (K, 2) undistorted rays.
        rotations: (C, 3, 3).
        centres: (C, 3).
        n_points: F.
        weights: (K,) of the squared residuals, 0 to leave a row out; 1 by default.
        scale: (K,) ray units; residuals beyond are down-weighted (Cauchy). None for plain least squares.

    Returns:
        (F, 3) points, NaN where invalid, and (F,) validity: two rows or more with weight that are not parallel, and in
        front of all their cameras.
    """
    weight = np.ones(len(camera)) if weights is None else weights
    is_kept = weight > 0
    cam, pnt, ray, weight = camera[is_kept], point[is_kept], ray_xy[is_kept], weight[is_kept]
    inverse_scale = None if scale is None else 1 / scale[is_kept]
    direction = world_directions(cam, ray, rotations)
    points, is_valid = _midpoints(cam, pnt, direction, weight, centres, n_points)
    if scale is not None:
        points = _medians(cam, pnt, direction, weight, centres, points, scale[is_kept])
    cost, hessian, gradient = _normal_equations(pnt, ray, rotations[cam], centres[cam], points, weight, inverse_scale)
    rows, is_moving = np.arange(len(cam)), np.ones(n_points, dtype=bool)
    for _ in range(N_STEPS):
        trial = points - solve_symmetric3(hessian, gradient)
        trial_cost, trial_hessian, trial_gradient = _normal_equations(
            pnt[rows],
            ray[rows],
            rotations[cam[rows]],
            centres[cam[rows]],
            trial,
            weight[rows],
            None if inverse_scale is None else inverse_scale[rows],
        )
        is_moving &= trial_cost < cost * (1 - 1e-6)
        points[is_moving], cost[is_moving] = trial[is_moving], trial_cost[is_moving]
        hessian[is_moving], gradient[is_moving] = trial_hessian[is_moving], trial_gradient[is_moving]
        rows = rows[is_moving[pnt[rows]]]
        if not len(rows):
            break
    is_valid &= np.isfinite(cost) & (np.bincount(pnt, minlength=n_points) >= 2)
    return np.where(is_valid[:, None], points, np.nan), is_valid


def triangulate_robust(
    camera: IntArray,
    point: IntArray,
    ray_xy: FloatArray,
    rotations: FloatArray,
    centres: FloatArray,
    n_points: int,
    *,
    tolerance: FloatArray,
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Triangulate, and find the views that do not belong.

    Where a robust fit has more than two thirds of three views or more within tolerance, those are the spot's. Elsewhere
    every pair of views proposes a spot, and the one that most views agree with is taken; when two proposals that share
    no agreeing set tie on two views each, nobody can tell which is right and the spot is invalid.

    Args:
        camera: (K,) rows sorted by point.
        point: (K,).
        ray_xy: (K, 2) undistorted rays.
        rotations: (C, 3, 3).
        centres: (C, 3).
        n_points: F.
        tolerance: (K,) largest residual of an honest row, ray units.

    Returns:
        (F, 3) points, (F,) validity, (K,) rows that agree with their valid spot.
    """
    points, is_valid = triangulate(camera, point, ray_xy, rotations, centres, n_points, scale=tolerance)
    relative = residuals(camera, point, ray_xy, rotations, centres, points) / tolerance
    n_views = np.bincount(point, minlength=n_points)
    n_agreeing = np.bincount(point[relative <= 1], minlength=n_points)
    is_settled = (n_agreeing == n_views) | ((n_agreeing >= 3) & (3 * n_agreeing > 2 * n_views))
    is_settled &= is_valid
    agrees = relative <= 1
    rows = np.flatnonzero(~is_settled[point])
    if len(rows):
        agrees[rows] = _consensus(camera[rows], point[rows], ray_xy[rows], rotations, centres, tolerance[rows])
        kept = rows[agrees[rows]]
        open_points, local = np.unique(point[kept], return_inverse=True)
        is_valid[point[rows]] = False
        points[open_points], is_valid[open_points] = triangulate(
            camera[kept], local, ray_xy[kept], rotations, centres, len(open_points)
        )
        relative = residuals(camera, point, ray_xy, rotations, centres, points) / tolerance
        agrees &= relative <= 1
        is_valid &= np.bincount(point[agrees], minlength=n_points) >= 2
    return np.where(is_valid[:, None], points, np.nan), is_valid, agrees & is_valid[point]


def residuals(
    camera: IntArray,
    point: IntArray,
    ray_xy: FloatArray,
    rotations: FloatArray,
    centres: FloatArray,
    points: FloatArray,
) -> FloatArray:
    """(K,) distance between each ray and its spot's projection, ray units; infinite behind the camera or at NaN."""
    in_cam = np.einsum("kij,kj->ki", rotations[camera], points[point] - centres[camera])
    is_in_front = in_cam[:, 2] > 0
    error = in_cam[:, :2] / np.where(is_in_front, in_cam[:, 2], np.nan)[:, None] - ray_xy
    return np.nan_to_num(np.hypot(error[:, 0], error[:, 1]), nan=np.inf)


def largest_parallax_rad(
    camera: IntArray, point: IntArray, ray_xy: FloatArray, rotations: FloatArray, n_points: int
) -> FloatArray:
    """(F,) largest angle between two rays of each spot, rad; 0 for a single ray. Rows sorted by point."""
    direction = world_directions(camera, ray_xy, rotations)
    smallest = np.ones(n_points)
    for lag in range(1, int(np.bincount(point, minlength=1).max())):
        first = np.flatnonzero(point[lag:] == point[:-lag])
        cosine = (direction[first] * direction[first + lag]).sum(axis=1)
        np.minimum.at(smallest, point[first], cosine)
    return np.arccos(np.clip(smallest, -1.0, 1.0))


def world_directions(camera: IntArray, ray_xy: FloatArray, rotations: FloatArray) -> FloatArray:
    """(K, 3) unit vectors of the rays in world."""
    ray = np.column_stack([ray_xy, np.ones(len(ray_xy))])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return np.einsum("kji,kj->ki", rotations[camera], ray)


def solve_symmetric3(upper: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve (..., 3, 3) symmetric systems given as (..., 6) = xx, xy, xz, yy, yz, zz, by the adjugate.

    A system that is singular to working precision gives NaN.
    """
    a, b, c, d, e, f = np.moveaxis(upper, -1, 0)
    adjugate = np.stack([d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b], -1)
    determinant = a * adjugate[..., 0] + b * adjugate[..., 1] + c * adjugate[..., 2]
    size = np.maximum(np.abs(a) + np.abs(d) + np.abs(f), 1e-300)
    determinant = np.where(np.abs(determinant) > 1e-14 * size**3, determinant, np.nan)
    x, y, z = np.moveaxis(rhs, -1, 0)
    p, q, r, s, t, u = np.moveaxis(adjugate, -1, 0)
    return np.stack([p * x + q * y + r * z, q * x + s * y + t * z, r * x + t * y + u * z], -1) / determinant[..., None]


def _midpoints(
    camera: IntArray, point: IntArray, direction: FloatArray, weight: FloatArray, centres: FloatArray, n_points: int
) -> tuple[FloatArray, BoolArray]:
    """Point with the least squared distance to its rays: sum (I - d d^T) (x - c) = 0."""
    x, y, z = direction.T
    upper = np.stack([1 - x * x, -x * y, -x * z, 1 - y * y, -y * z, 1 - z * z], axis=1)
    # Around the mean of a spot's camera centres the right-hand side keeps its digits far from the world's origin.
    total = np.maximum(_sum(point, weight[:, None], n_points), 1e-300)
    origin = _sum(point, weight[:, None] * centres[camera], n_points) / total
    offset = centres[camera] - origin[point]
    rhs = offset - direction * (direction * offset).sum(axis=1, keepdims=True)
    hessian = _sum(point, weight[:, None] * upper, n_points) / total
    points = origin + solve_symmetric3(hessian, _sum(point, weight[:, None] * rhs, n_points) / total)
    return points, ~np.isnan(points.sum(axis=1))


def _medians(
    camera: IntArray,
    point: IntArray,
    direction: FloatArray,
    weight: FloatArray,
    centres: FloatArray,
    points: FloatArray,
    scale: FloatArray,
) -> FloatArray:
    """From the midpoints towards the least sum of distances to the rays (Weiszfeld's weights).

    That sum is convex, so a few wrong rays cannot hold the point far away as they do with squares; spots whose rays
    all pass within their scale stay.
    """
    offset, depth = _along_rays(camera, point, direction, centres, points)
    is_wide = np.zeros(len(points), dtype=bool)
    is_wide[point[np.linalg.norm(offset, axis=1) > scale * np.abs(depth)]] = True
    moving = np.flatnonzero(is_wide & (np.bincount(point, minlength=len(points)) >= 3))
    rows = np.flatnonzero(np.isin(point, moving))
    camera, local, direction = camera[rows], np.searchsorted(moving, point[rows]), direction[rows]
    weight, scale, medians = weight[rows], scale[rows], points[moving]
    for _ in range(N_MEDIAN_STEPS if len(rows) else 0):
        offset, depth = _along_rays(camera, local, direction, centres, medians)
        distance = np.maximum(np.linalg.norm(offset, axis=1), scale * np.maximum(np.abs(depth), 1e-12))
        medians, _ = _midpoints(camera, local, direction, weight / distance, centres, len(moving))
    points = points.copy()
    points[moving] = medians
    return points


def _along_rays(
    camera: IntArray, point: IntArray, direction: FloatArray, centres: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Offset (K, 3) of each spot from its ray, and the depth (K,) of its foot on the ray."""
    offset = points[point] - centres[camera]
    depth = np.einsum("ki,ki->k", offset, direction)
    return offset - depth[:, None] * direction, depth


def _normal_equations(
    point: IntArray,
    ray_xy: FloatArray,
    rotation: FloatArray,
    centre: FloatArray,
    points: FloatArray,
    weight: FloatArray,
    inverse_scale: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(F,) cost, infinite behind a camera, (F, 6) Gauss-Newton matrix and (F, 3) gradient of each spot."""
    n_points = len(points)
    in_cam = np.einsum("kij,kj->ki", rotation, points[point] - centre)
    is_in_front = in_cam[:, 2] > 1e-9
    inverse_z = 1 / np.where(is_in_front, in_cam[:, 2], np.nan)
    xy = in_cam[:, :2] * inverse_z[:, None]
    error = xy - ray_xy
    jacobian = (rotation[:, :2] - xy[:, :, None] * rotation[:, 2:]) * inverse_z[:, None, None]
    square = (error**2).sum(axis=1)
    loss = square
    if inverse_scale is not None:
        relative = square * inverse_scale**2
        loss = np.log1p(relative) / inverse_scale**2
        weight = weight / (1 + relative)
    cost = np.bincount(point, weights=np.where(is_in_front, weight * loss, np.inf), minlength=n_points)
    (ux, uy, uz), (vx, vy, vz) = np.moveaxis(jacobian, 0, -1)
    products = [ux * ux + vx * vx, ux * uy + vx * vy, ux * uz + vx * vz]
    products += [uy * uy + vy * vy, uy * uz + vy * vz, uz * uz + vz * vz]
    slope = (jacobian * error[:, :, None]).sum(axis=1)
    columns = weight[:, None] * np.column_stack([*products, slope])
    summed = _sum(point, columns, n_points)
    return cost.astype(np.float64), summed[:, :6], summed[:, 6:]


def _sum(point: IntArray, values: FloatArray, n_points: int) -> FloatArray:
    """(F, m) sums of the rows (K, m) of each point."""
    out = np.empty((n_points, values.shape[1]))
    for k in range(values.shape[1]):
        out[:, k] = np.bincount(point, weights=values[:, k], minlength=n_points)
    return out


def _consensus(
    camera: IntArray,
    point: IntArray,
    ray_xy: FloatArray,
    rotations: FloatArray,
    centres: FloatArray,
    tolerance: FloatArray,
) -> BoolArray:
    """(K,) rows that agree with their spot's best proposal; rows sorted by point.

    Every two views of a spot, up to MAX_LAG apart in the list of its views, propose a position.
    """
    first, second = _pairs_within(point)
    n_proposals = len(first)
    proposals, is_valid = triangulate(
        np.concatenate([camera[first], camera[second]]),
        np.tile(np.arange(n_proposals), 2),
        np.concatenate([ray_xy[first], ray_xy[second]]),
        rotations,
        centres,
        n_proposals,
    )
    _, start, count = np.unique(point, return_index=True, return_counts=True)
    spot = np.repeat(np.arange(len(start)), count)
    # Every proposal is held against every view of its spot.
    proposal = np.repeat(np.arange(n_proposals), count[spot[first]])
    within = np.arange(len(proposal)) - np.searchsorted(proposal, proposal)
    row = start[spot[first]][proposal] + within
    relative = residuals(camera[row], proposal, ray_xy[row], rotations, centres, proposals) / tolerance[row]
    agrees = (relative <= 1) & is_valid[proposal]
    n_agreeing = np.bincount(proposal, agrees, minlength=n_proposals)
    score = n_agreeing + np.bincount(proposal, np.where(agrees, 1 - relative**2, 0.0), minlength=n_proposals) / 1e3
    order = np.lexsort((-score, spot[first]))
    is_best = np.r_[True, np.diff(spot[first][order]) > 0]
    best, runner_up = order[is_best], np.r_[order[1:], -1][is_best]
    is_tied = np.zeros(len(best), dtype=bool)
    has_rival = (runner_up >= 0) & (spot[first][runner_up] == spot[first][best])
    is_tied[has_rival] = n_agreeing[runner_up[has_rival]] == 2
    is_clear = (n_agreeing[best] > 2) | ((n_agreeing[best] == 2) & ~is_tied)
    is_chosen = np.zeros(n_proposals, dtype=bool)
    is_chosen[best[is_clear]] = True
    out = np.zeros(len(point), dtype=bool)
    out[row[agrees & is_chosen[proposal]]] = True
    return out


def _pairs_within(group: IntArray) -> tuple[IntArray, IntArray]:
    """All pairs (i, j), i < j, at most MAX_LAG apart, of positions within the same run of the sorted `group`."""
    firsts, seconds = [], []
    for lag in range(1, min(MAX_LAG, int(np.bincount(group).max(initial=1)) - 1) + 1):
        first = np.flatnonzero(group[lag:] == group[:-lag])
        firsts.append(first)
        seconds.append(first + lag)
    return np.concatenate(firsts or [group[:0]]), np.concatenate(seconds or [group[:0]])
