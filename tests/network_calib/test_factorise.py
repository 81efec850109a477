"""Rank-4 factorisation: predicts views that were missing, sees through false ones, refuses a plane."""

import numpy as np
import pytest

from network_calib.depths import SpotTable, overlapping_triples
from network_calib.errors import DegenerateError
from network_calib.factorise import Views, factorise, intersect, reprojection_error
from network_calib.synthetic_rooms import look_at

TOLERANCE = 0.006  # 4 px at a focal length of 640 px
NOISE = 0.0003  # 0.2 px


def ring(n_cameras=6, n_spots=400, *, noise=0.0, seed=0, flatness=1.0):
    """Cameras (C, 3, 4) on a ring, spots (J, 4) in a box, their noisy rays (J, C, 2) and true depths (J, C)."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(n_cameras) / n_cameras
    centres = np.stack([4 * np.cos(angle), 4 * np.sin(angle), rng.uniform(1.5, 2.6, n_cameras)], axis=1)
    rotations = np.stack([look_at(c, np.array([0.0, 0.0, 1.0])) for c in centres])
    matrices = np.concatenate([rotations, -(rotations @ centres[:, :, None])], axis=2)
    spots = rng.uniform([-1.2, -1.2, -0.8], [1.2, 1.2, 0.8], (n_spots, 3)) * [1, 1, flatness] + [0, 0, 1]
    rays = np.einsum("cij,kj->kci", matrices, np.column_stack([spots, np.ones(n_spots)]))
    xy = rays[..., :2] / rays[..., 2:] + noise * rng.standard_normal((n_spots, n_cameras, 2))
    return xy, rays[..., 2], rng


def solve(xy, depths, is_seen):
    """Factorise with depths known up to a factor for each camera and spot, as epipolar geometry leaves them."""
    rng = np.random.default_rng(9)
    factors = np.exp(rng.normal(size=(len(xy), 1)) + rng.normal(size=xy.shape[1]))
    ray = np.concatenate([xy, np.ones((*is_seen.shape, 1))], axis=2) * is_seen[..., None]
    table = SpotTable(np.arange(len(xy)), ray, np.where(is_seen, TOLERANCE, np.inf), is_seen)
    names = tuple(f"C{i}" for i in range(xy.shape[1]))
    return factorise(table, np.where(is_seen, depths * factors, np.nan), overlapping_triples(is_seen, names))


def errors_at(room, xy, where):
    """Reprojection errors in ray units where (J, C) asks."""
    j, c = np.nonzero(where)
    ray = np.einsum("kij,kj->ki", room.matrices[c], room.points[j])
    return np.linalg.norm(ray[:, :2] / ray[:, 2:] - xy[j, c], axis=1)


def holes(rng, shape, *, share):
    """Random holes; every spot keeps three views and none has all."""
    is_seen = rng.random(shape) >= share
    is_seen[is_seen.all(axis=1), 0] = False
    return is_seen & (is_seen.sum(axis=1, keepdims=True) >= 3)


def test_exact_views_predict_the_missing_ones_though_no_spot_is_seen_by_all():
    xy, depths, rng = ring()
    is_seen = holes(rng, depths.shape, share=0.4)
    room = solve(xy, depths, is_seen)
    used = is_seen.any(axis=1, keepdims=True)
    assert (room.is_inlier == is_seen).all()
    # Eigenvectors of moments are good to the root of the rounding of 1e-16 times the spread of eigenvalues (1e4): 1e-6.
    assert errors_at(room, xy, used & ~is_seen).max() < 1e-6


def test_noise_is_not_amplified_in_the_missing_views():
    xy, depths, rng = ring(noise=NOISE)
    is_seen = holes(rng, depths.shape, share=0.3)
    room = solve(xy, depths, is_seen)
    # A spot from three to five views around a ring is known to about the noise of one of them, so it predicts a missing
    # view's own noise with sqrt(2) of it; the median length of a two-dimensional normal error is 1.18 sigma.
    predicted = np.median(errors_at(room, xy, is_seen.any(axis=1, keepdims=True) & ~is_seen))
    assert predicted < 1.5 * 1.18 * np.sqrt(2) * NOISE
    assert room.is_inlier[is_seen].all()


def test_false_views_are_found_and_do_not_harm_the_others():
    xy, depths, rng = ring(noise=NOISE)
    is_seen = holes(rng, depths.shape, share=0.2)
    is_false = is_seen & (np.cumsum(is_seen, axis=1) == 2) & (rng.random((len(xy), 1)) < 0.4)
    is_false &= is_seen.sum(axis=1, keepdims=True) >= 4
    assert 0.06 < is_false.sum() / is_seen.sum() < 0.12
    turned = rng.uniform(0, 2 * np.pi, is_false.sum())
    xy[is_false] += 0.1 * np.stack([np.cos(turned), np.sin(turned)], axis=1)  # 64 px
    room = solve(xy, depths, is_seen)
    assert not room.is_inlier[is_false].any()
    # Where four views hold one false, some triples of it agree nearly as well; the rest must be exact.
    assert room.is_inlier[is_seen & ~is_false].mean() > 0.995


@pytest.mark.parametrize("noise", [NOISE, 5 * NOISE])
def test_spots_in_a_plane_are_refused(noise):
    xy, depths, rng = ring(noise=noise, flatness=0.0)
    with pytest.raises(DegenerateError, match="do not fill space"):
        solve(xy, depths, holes(rng, depths.shape, share=0.2))


def test_depths_that_fit_nothing_are_refused():
    xy, depths, rng = ring(noise=NOISE)
    is_seen = holes(rng, depths.shape, share=0.2)
    with pytest.raises(DegenerateError):
        solve(rng.permuted(xy, axis=0), depths, is_seen)


def test_depths_are_positive():
    xy, depths, rng = ring(noise=NOISE)
    is_seen = holes(rng, depths.shape, share=0.3)
    room = solve(xy, depths, is_seen)
    j, c = np.nonzero(is_seen)
    assert (np.einsum("kj,kj->k", room.matrices[c, 2], room.points[j]) > 0).all()


def test_error_behind_the_camera_is_infinite():
    matrices = np.stack([np.eye(3, 4), np.eye(3, 4) + np.array([0, 0, 0, 1.0])[None] * [[1.0], [0], [0]]])
    views = Views(np.array([0, 1]), np.array([0, 0]), np.array([[0.1, 0.0], [0.6, 0.0]]), np.full(2, TOLERANCE))
    points = intersect(matrices, views, np.ones(2))
    # x / z = 0.1 and (x + 1) / z = 0.6: z = 2, x = 0.2.
    np.testing.assert_allclose(points / points[:, 3:], [[0.2, 0.0, 2.0, 1.0]], atol=1e-12)
    assert reprojection_error(matrices, points, views).max() < 1e-9
    assert np.isinf(reprojection_error(matrices, -points, views)).all()
