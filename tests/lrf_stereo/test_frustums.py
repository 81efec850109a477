"""Frusta: a visible pixel is never dropped, whatever the lens; what is left out is most of a large site."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.camera_array import CameraArray
from lrf_stereo.frustums import FrustumIndex
from lrf_stereo.view_bounds import SIDES_RAD, side_bounds
from network_calib.cameras import Cameras, LensModel, cam_from_img, poses_from_centres
from network_calib.synthetic_rooms import look_at


def a_rig(rng, n=12):
    """Cameras of any kind, place and attitude: strong distortion, principal points outside the image, fisheyes."""
    kinds = list(LensModel)
    lenses = tuple(kinds[k] for k in rng.integers(len(kinds), size=n))
    intrinsics = np.zeros((n, 8))
    intrinsics[:, 0] = 10 ** rng.uniform(1.8, 3.2, n)
    intrinsics[:, 1] = intrinsics[:, 0] * rng.uniform(0.8, 1.2, n)
    intrinsics[:, 2:4] = [320, 240] + rng.choice([20, 500], (n, 1)) * rng.standard_normal((n, 2))
    radial = rng.choice([0.05, 0.5, 3.0], (n, 1)) * rng.standard_normal((n, 4))
    tangential = rng.choice([0.0, 0.003, 0.1], (n, 1)) * rng.standard_normal((n, 2))
    for i, lens in enumerate(lenses):
        terms = radial[i] if lens.is_fisheye else np.array([*radial[i, :2], *tangential[i]])
        intrinsics[i, 4 : 4 + lens.n_distortion] = terms[: lens.n_distortion]
    turns = Rotation.from_quat(rng.standard_normal((n, 4))).as_matrix()
    poses = poses_from_centres(turns, rng.uniform(-4, 4, (n, 3)))
    return Cameras(tuple(f"C{i}" for i in range(n)), np.tile([640, 480], (n, 1)), lenses, intrinsics, poses)


def valid_pixels(cameras, points):
    with np.errstate(all="ignore"):
        return CameraArray(cameras).project(points.T, None).is_valid


def a_curve(rng, n):
    """Points one after the other as in a scan, of which some are far and some have no range."""
    angle = np.cumsum(rng.uniform(0, 0.02, n))
    points = rng.uniform(0.5, 5, n)[:, None] * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    points = Rotation.from_quat(rng.standard_normal(4)).apply(points) + rng.uniform(-3, 3, 3)
    points[rng.random(n) < 0.1] = np.nan
    return points


@settings(max_examples=150)
@given(seed=st.integers(0, 2**32), n_points=st.sampled_from([1, 2, 30, 700]))
def test_no_camera_with_a_valid_pixel_is_left_out(seed, n_points):
    rng = np.random.default_rng(seed)
    cameras, points = a_rig(rng), a_curve(rng, n_points)
    is_valid = valid_pixels(cameras, points)
    assert set(np.flatnonzero(is_valid.any(axis=1))) <= set(FrustumIndex.of(cameras).seeing(points))


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32))
def test_nor_with_a_largest_distance_nor_around_a_ball(seed):
    rng = np.random.default_rng(seed)
    cameras, points = a_rig(rng), a_curve(rng, 300)
    distance = np.linalg.norm(points - cameras.centres_in_world[:, None], axis=2)
    with np.errstate(invalid="ignore"):
        counts = valid_pixels(cameras, points) & (distance <= 3.0)
    index = FrustumIndex.of(cameras, max_distance_m=3.0)
    expected = set(np.flatnonzero(counts.any(axis=1)))
    assert expected <= set(index.seeing(points))
    finite = points[np.isfinite(points[:, 0])]
    centre = finite.mean(axis=0)
    near = index.around(centre, float(np.linalg.norm(finite - centre, axis=1).max()))
    assert expected <= set(near.cameras)
    np.testing.assert_array_equal(near.seeing(points), index.seeing(points))


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32))
def test_no_valid_ray_is_beyond_the_bounds(seed):
    rng = np.random.default_rng(seed)
    cameras = a_rig(rng, 6)
    bounds = side_bounds(cameras)
    # Rays of every direction in front, many of them near 90 degrees.
    angle, azimuth = np.pi / 2 - 10 ** rng.uniform(-9, 0.19, 4000), rng.uniform(-np.pi, np.pi, 4000)
    radius = np.tan(angle)
    rays = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.ones(4000)])
    at_origin = Cameras(
        cameras.names, cameras.size_px, cameras.lenses, cameras.intrinsics, RigidTransform.identity(len(cameras))
    )
    is_valid = valid_pixels(at_origin, rays)
    for side, to_side in enumerate(SIDES_RAD):
        reach = np.arctan(radius * np.cos(azimuth - to_side))
        for i in range(len(cameras)):
            assert reach[is_valid[i]].max(initial=-np.inf) <= bounds[i, side] + 1e-9


@pytest.mark.parametrize("lens", LensModel)
def test_bounds_are_near_the_rays_of_the_corners(lens):
    terms = {"fisheye": (-0.02, 0.004, -0.002, 0.0002), "k1": (-0.15, 0, 0, 0), "k1_k2": (-0.26, 0.07, 0, 0)}
    terms["k1_k2_p1_p2"] = (-0.26, 0.07, 0.001, -0.001)
    row = np.array([450, 450, 319.5, 239.5, *terms.get(lens.value, (0, 0, 0, 0))], dtype=np.float64)
    cameras = Cameras(("C0",), np.array([[640, 480]]), (lens,), row[None], RigidTransform.identity(1))
    xs, ys = np.meshgrid(np.linspace(-0.5, 639.5, 200), np.linspace(-0.5, 479.5, 200))
    rays, is_valid = cam_from_img(row, np.array(lens.is_fisheye), np.column_stack([xs.ravel(), ys.ravel()]))
    assert is_valid.all()
    exact = np.arctan([rays[:, 0].max(), rays[:, 1].max(), -rays[:, 0].min(), -rays[:, 1].min()])
    excess = np.degrees(side_bounds(cameras)[0] - exact)
    assert (excess >= -1e-9).all()
    # A ring is 0.35 degrees, a piece of the border as much or less; p1, p2 of 0.001 move it by 0.3.
    assert excess.max() < 1.2


def test_points_that_are_not_there_are_seen_by_nobody():
    index = FrustumIndex.of(a_rig(np.random.default_rng(1)))
    assert len(index.seeing(np.empty((0, 3)))) == 0
    assert len(index.seeing(np.full((5, 3), np.nan))) == 0
    assert len(index.around(np.zeros(3), np.inf)) == len(index)


def test_of_a_large_site_only_the_cameras_around_the_scan_are_left():
    rng = np.random.default_rng(3)
    # 250 rooms of 8 m x 8 m with four cameras each, in the corners and looking at the middle; the scan in the first.
    rooms = 8.0 * np.array([(x, y) for y in range(10) for x in range(25)], dtype=np.float64)
    corners = np.array([[-3.5, -3.5], [3.5, -3.5], [3.5, 3.5], [-3.5, 3.5]])
    centres = np.asarray(np.column_stack([(rooms[:, None] + corners).reshape(-1, 2), np.full(1000, 2.6)]), np.float64)
    targets = np.column_stack([np.repeat(rooms, 4, axis=0), np.full(1000, 1.0)])
    intrinsics = np.tile([450.0, 450, 319.5, 239.5, -0.26, 0.07, 0, 0], (1000, 1))
    cameras = Cameras(
        tuple(f"C{i}" for i in range(1000)),
        np.tile([640, 480], (1000, 1)),
        (LensModel.K1_K2,) * 1000,
        intrinsics,
        poses_from_centres(look_at(centres, targets), centres),
    )
    bearing = np.linspace(-2.35, 2.35, 1081)
    range_m = rng.uniform(2.8, 3.0, 1081)
    scan = np.column_stack([range_m * np.cos(bearing), range_m * np.sin(bearing), np.full(1081, 1.0)])
    seeing = FrustumIndex.of(cameras, max_distance_m=10.0).seeing(scan)
    is_valid = valid_pixels(cameras, scan) & (np.linalg.norm(scan - centres[:, None], axis=2) <= 10.0)
    truly = np.flatnonzero(is_valid.any(axis=1))
    assert set(truly) <= set(seeing)
    assert set(range(4)) <= set(seeing)
    # Boxes and rounded-up views take in a few more, never a large part of the site.
    assert len(seeing) <= 1.5 * len(truly) + 2
