"""One camera from its spots: exact on exact views, with false ones among them, from a wrong expected focal length."""

import numpy as np
import pytest

from network_calib.resection import resect
from network_calib.synthetic_rooms import look_at

CENTRE = np.array([4.0, 1.0, 2.5])


def seen_by_one(ratio, *, n=300, false_share=0.0, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -2, 0.2], [2, 2, 2.2], (n, 3))
    rotation = look_at(CENTRE, np.array([0.0, 0.0, 1.0]))
    in_cam = (points - CENTRE) @ rotation.T
    ray_xy = ratio * in_cam[:, :2] / in_cam[:, 2:] + noise * rng.standard_normal((n, 2))
    is_false = rng.random(n) < false_share
    ray_xy[is_false] = rng.uniform(-0.5, 0.5, (is_false.sum(), 2))
    return ray_xy, points, rotation, is_false


@pytest.mark.parametrize("expected", [0.65, 0.9, 1.0, 1.5])
@pytest.mark.parametrize("ratio", [0.6, 1.0, 2.0])
def test_the_camera_is_found_from_a_wrong_expected_ratio(ratio, expected):
    ray_xy, points, rotation, is_false = seen_by_one(ratio, false_share=0.2, noise=0.0003)
    found = resect(ray_xy, points, np.full(len(points), 0.004), ratio=ratio * expected, is_ratio_fixed=False)
    assert found is not None
    # Noise of 0.0003 in 240 spots at 4 m: a ratio to about 0.0003 / 0.3 / sqrt(240) = 6e-5, the centre to a few mm with
    # the trade between ratio and distance; five times that, and the prior's pull of (0.001 / 0.3)^2.
    assert abs(found.ratio / ratio - 1) < 0.003
    assert np.linalg.norm(found.centre - CENTRE) < 0.02
    assert np.abs(found.rotation - rotation).max() < 0.003
    assert found.is_inlier[~is_false].all()
    # A false one falls within 0.004 of its spot with a chance of pi 0.004^2.
    assert found.is_inlier[is_false].sum() <= 1


def test_a_fixed_ratio_stays():
    ray_xy, points, _, _ = seen_by_one(1.0, noise=0.0003)
    found = resect(ray_xy, points, np.full(len(points), 0.004), ratio=1.0, is_ratio_fixed=True)
    assert found is not None
    assert found.ratio == 1.0


def test_too_few_spots_and_spots_without_a_camera_are_refused():
    ray_xy, points, _, _ = seen_by_one(1.0)
    tolerance = np.full(len(points), 0.004)
    assert resect(ray_xy[:11], points[:11], tolerance[:11], ratio=1.0, is_ratio_fixed=False) is None
    shuffled = np.random.default_rng(0).permutation(points)
    assert resect(ray_xy, shuffled, tolerance, ratio=1.0, is_ratio_fixed=False) is None
