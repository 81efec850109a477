"""Focal ratios from fundamental matrices alone: right where the matrices are, and the prior where there are none."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from network_calib.focal_ratios import focal_ratios
from network_calib.pairs import verify_pairs
from network_calib.start import StartProblem


def exact_graph(ratio, *, known=(), seed=0, n=300):
    """Verified pairs of cameras of the given ratios around a box, their axes missing each other."""
    rng = np.random.default_rng(seed)
    n_cameras = len(ratio)
    spots = rng.uniform(-1.0, 1.0, (n, 3))
    rotations = Rotation.from_rotvec(rng.normal(0, 0.5, (n_cameras, 3))).as_matrix()
    target = rng.uniform(-0.5, 0.5, (n_cameras, 3))
    in_cam = np.einsum("cij,kcj->kci", rotations, spots[:, None] - target) + np.array([0, 0, 5.0])
    ray_xy = np.asarray(ratio)[:, None] * in_cam[..., :2] / in_cam[..., 2:]
    problem = StartProblem(
        camera=np.tile(np.arange(n_cameras), n),
        point=np.repeat(np.arange(n), n_cameras),
        ray_xy=ray_xy.reshape(-1, 2) + 1e-5 * rng.standard_normal((n * n_cameras, 2)),
        tolerance=np.full(n_cameras, 0.004),
        is_focal_known=np.isin(np.arange(n_cameras), known),
        names=tuple(f"C{c}" for c in range(n_cameras)),
    )
    return verify_pairs(problem, rng=rng), problem.is_focal_known


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
@pytest.mark.parametrize("ratio", [(0.7, 0.7, 0.7, 0.7), (0.5, 1.0, 1.6, 2.5)])
def test_clean_pairs_give_the_ratios(ratio, seed):
    graph, is_known = exact_graph(ratio, seed=seed)
    # A lens model good to a hundredth (MODEL_SIGMA) lets each singular value be wrong by as much; six pairs and the
    # prior's pull of (0.01 / 0.5)^2 leave a few hundredths.
    np.testing.assert_allclose(focal_ratios(graph, is_known), ratio, rtol=0.1)


def test_known_ratios_stay_one():
    graph, is_known = exact_graph((1.0, 1.0, 0.6), known=(0, 1))
    found = focal_ratios(graph, is_known)
    np.testing.assert_array_equal(found[:2], 1.0)
    np.testing.assert_allclose(found[2], 0.6, rtol=0.05)


def test_without_pairs_the_prior_speaks():
    graph, is_known = exact_graph((0.7, 0.7, 0.7))
    np.testing.assert_array_equal(focal_ratios(replace(graph, pairs=()), is_known), 1.0)
