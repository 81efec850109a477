"""Triangulation of many spots at once, from posed cameras and undistorted rays; no loop over spots.

Conventions: `rotations` (C, 3, 3) are cam_from_world, `centres` (C, 3) lie in world, a ray is x/z, y/z in the camera.
Rows are observations in any order, except where a function asks for rows sorted by point.
"""

from __future__ import annotations

import numpy as np

from network_calib.observations import BoolArray, FloatArray, IntArray

N_STEPS = 8
N_MEDIAN_STEPS = 8


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
    max_removed: int = 3,
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Triangulate, and find the views that do not belong: leave one out, again and again.

    Where a robust fit has more than two thirds of three views or more within tolerance, those are the spot's.
    Otherwise a spot of three views or more whose worst residual exceeds its tolerance loses the view without which the
    others agree best; up to `max_removed` times. A spot that stays in disagreement is invalid, and so are its rows.

    Args:
        camera: (K,) rows sorted by point.
        point: (K,).
        ray_xy: (K, 2) undistorted rays.
        rotations: (C, 3, 3).
        centres: (C, 3).
        n_points: F.
        tolerance: (K,) largest residual of an honest row, ray units.
        max_removed: views that one spot may lose.

    Returns:
        (F, 3) points, (F,) validity, (K,) rows that agree with their valid spot.
    """
    points, is_valid = triangulate(camera, point, ray_xy, rotations, centres, n_points, scale=tolerance)
    relative = _relative_residuals(camera, point, ray_xy, rotations, centres, points, tolerance)
    # The down-weighted fit settles the spots that most views agree on; a search is left for the few others.
    n_views = np.bincount(point, minlength=n_points)
    n_agreeing = np.bincount(point[relative <= 1], minlength=n_points)
    is_settled = (n_agreeing >= 3) & (3 * n_agreeing > 2 * n_views)
    is_kept = ~is_settled[point] | (relative <= 1)
    for _ in range(max_removed):
        worst = _maximum(point, np.where(is_kept, relative, 0.0), n_points)
        n_views = np.bincount(point[is_kept], minlength=n_points)
        is_bad = (n_views >= 3) & ~(worst <= 1)
        rows = np.flatnonzero(is_kept & is_bad[point])
        if not len(rows):
            break
        wrong, rest = _leave_one_out(camera, point, ray_xy, rotations, centres, tolerance, rows)
        is_kept[wrong] = False
        points[point[wrong]] = rest
        is_valid[point[wrong]] = np.isfinite(rest).all(axis=1)
        relative = _relative_residuals(camera, point, ray_xy, rotations, centres, points, tolerance)
    worst = _maximum(point, np.where(is_kept, relative, 0.0), n_points)
    is_valid &= worst <= 1
    is_inlier = is_valid[point] & (relative <= 1)
    return np.where(is_valid[:, None], points, np.nan), is_valid, is_inlier


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


def _maximum(point: IntArray, values: FloatArray, n_points: int) -> FloatArray:
    """(F,) largest value of each point; 0 where a point has no row."""
    out = np.zeros(n_points)
    np.maximum.at(out, point, values)
    return out


def _relative_residuals(
    camera: IntArray,
    point: IntArray,
    ray_xy: FloatArray,
    rotations: FloatArray,
    centres: FloatArray,
    points: FloatArray,
    tolerance: FloatArray,
) -> FloatArray:
    return residuals(camera, point, ray_xy, rotations, centres, points) / tolerance


def _leave_one_out(
    camera: IntArray,
    point: IntArray,
    ray_xy: FloatArray,
    rotations: FloatArray,
    centres: FloatArray,
    tolerance: FloatArray,
    rows: IntArray,
) -> tuple[IntArray, FloatArray]:
    """For each spot of `rows` (sorted by point), the row without which the others agree best.

    Returns:
        (G,) one row for each spot, and (G, 3) the spots triangulated without it, NaN where that is invalid.
    """
    left_out, member = _others_of_each(point[rows])
    group, other = left_out, rows[member]
    points, is_valid = triangulate(camera[other], group, ray_xy[other], rotations, centres, len(rows))
    relative = residuals(camera[other], group, ray_xy[other], rotations, centres, points) / tolerance[other]
    truncated = np.bincount(group, weights=np.minimum(relative**2, 1.0), minlength=len(rows))
    # Ties between truncated costs are broken by the finite part of the plain cost.
    plain = np.bincount(group, weights=np.minimum(relative, 1e6), minlength=len(rows))
    order = np.lexsort((plain, np.where(is_valid, truncated, np.inf), point[rows]))
    best = order[np.r_[True, np.diff(point[rows][order]) > 0]]
    return rows[best], points[best]


def _others_of_each(group: IntArray) -> tuple[IntArray, IntArray]:
    """All ordered pairs (i, j), i != j, of positions within the same run of the sorted `group`."""
    _, first, count = np.unique(group, return_index=True, return_counts=True)
    per_row = np.repeat(count, count)
    i = np.repeat(np.arange(len(group)), per_row)
    within = np.arange(len(i)) - np.repeat(np.cumsum(per_row) - per_row, per_row)
    j = np.repeat(np.repeat(first, count), per_row) + within
    return i[i != j], j[i != j]
