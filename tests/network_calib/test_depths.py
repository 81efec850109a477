"""Projective depths: exact views give true depths, whichever pairs speak; thin overlap is refused by name."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from network_calib.depths import SpotTable, choose_spots, overlapping_triples, projective_depths
from network_calib.errors import DegenerateError
from network_calib.pairs import Pair, PairGraph
from network_calib.start import StartProblem
from network_calib.synthetic_rooms import look_at

NAMES = tuple("ABCDEFGH")


def arc(n_cameras=5, n_spots=200, *, seed=0):
    """Cameras (C, 3, 4) of focal ratio 0.8 to 1.4 on an arc around spots that fill a box, and the spots (J, 4)."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.4, n_cameras)
    centres = np.stack([4 * np.cos(angle), 4 * np.sin(angle), rng.uniform(1.5, 2.6, n_cameras)], axis=1)
    ratio = rng.uniform(0.8, 1.4, n_cameras)
    rotations = np.stack([look_at(c, np.array([0.0, 0.0, 1.0])) for c in centres])
    poses = np.concatenate([rotations, -(rotations @ centres[:, :, None])], axis=2)
    matrices = np.stack([ratio, ratio, np.ones(n_cameras)], axis=1)[:, :, None] * poses
    spots = rng.uniform([-1.2, -1.2, 0.2], [1.2, 1.2, 2.0], (n_spots, 3))
    return matrices, np.column_stack([spots, np.ones(n_spots)])


def table_of(matrices, spots, is_seen):
    """The exact views as a table, and the true depths (J, C)."""
    depth_times_ray = np.einsum("cij,kj->kci", matrices, spots)
    depths = depth_times_ray[..., 2]
    ray = np.where(is_seen[..., None], depth_times_ray / depths[..., None], 0.0)
    return SpotTable(np.arange(len(spots)), ray, np.where(is_seen, 0.005, np.inf), is_seen), depths


def true_pair(matrices, a, b, *, scale=1.0):
    """F of two projective cameras: [e]x P_b P_a^+, e the image in b of the centre of a."""
    centre = np.linalg.svd(matrices[a])[2][3]
    epipole = matrices[b] @ centre
    fundamental = np.cross(epipole, matrices[b] @ np.linalg.pinv(matrices[a]), axisa=0, axisb=0, axisc=0)
    return Pair(a, b, scale * fundamental / np.linalg.norm(fundamental), 0, 0, np.eye(9))


def true_pairs(matrices, ends, *, seed=0):
    """Pairs with factors of either sign, as an estimate of F may have."""
    factors = np.random.default_rng(seed).choice([-3.0, -0.5, 1.0, 2.0], len(ends))
    return tuple(true_pair(matrices, a, b, scale=s) for (a, b), s in zip(ends, factors, strict=True))


def disagreement(depths, truth):
    """How far log(depths / truth), where known, is from a factor for each camera plus one for each spot."""
    j, c = np.nonzero(np.isfinite(depths))
    n_spots, n_cameras = depths.shape
    design = np.zeros((len(j), n_spots + n_cameras))
    design[np.arange(len(j)), j] = design[np.arange(len(j)), n_spots + c] = 1.0
    log_ratio = np.log(depths[j, c] / truth[j, c])
    return np.abs(log_ratio - design @ np.linalg.lstsq(design, log_ratio, rcond=None)[0]).max()


def test_all_pairs_give_the_true_depths_with_half_of_the_views_missing():
    matrices, spots = arc()
    is_seen = np.random.default_rng(1).random((200, 5)) < 0.5
    is_seen &= is_seen.sum(axis=1, keepdims=True) >= 3
    is_seen &= ~is_seen.all(axis=1, keepdims=True)
    table, truth = table_of(matrices, spots, is_seen)
    pairs = true_pairs(matrices, list(combinations(range(5), 2)))
    depths = projective_depths(table, pairs, overlapping_triples(is_seen, NAMES[:5]))
    assert (np.isfinite(depths) == is_seen).all()
    assert (depths[is_seen] > 0).all()
    # The ridge of 1e-6 beside weights of twenty and more leaves 1e-7 of the logarithms, which are of order one.
    assert disagreement(depths, truth) < 1e-6


def test_a_pair_whose_factor_no_loop_finds_is_not_used():
    matrices, spots = arc(4, 60)
    is_seen = np.ones((60, 4), dtype=bool)
    is_seen[30:, 0] = is_seen[:30, 3] = False  # A and D share no spot
    is_seen[:3, [0, 3]] = True  # but for three, so pair A-D closes no ring by itself
    table, truth = table_of(matrices, spots, is_seen)
    pairs = true_pairs(matrices, list(combinations(range(4), 2)))
    depths = projective_depths(table, pairs, overlapping_triples(is_seen, NAMES[:4]))
    assert disagreement(depths, truth) < 1e-6


def test_a_star_of_pairs_gives_the_depths_of_sturm_and_triggs():
    matrices, spots = arc(4, 60)
    is_seen = np.ones((60, 4), dtype=bool)
    table, _ = table_of(matrices, spots, is_seen)
    pairs = true_pairs(matrices, [(0, 1), (0, 2), (0, 3)])
    depths = projective_depths(table, pairs, np.array([[0, 1, 2], [0, 1, 3]]))
    for pair in pairs:
        epipole = np.linalg.svd(pair.fundamental)[0][:, 2]
        x_a, x_b = table.ray[:, 0], table.ray[:, pair.b]
        line = np.cross(epipole, x_b)
        expected = np.abs((line * (x_a @ pair.fundamental.T)).sum(axis=1) / (line**2).sum(axis=1))
        # No triple closes, so the factors stay one and only rounding is left.
        np.testing.assert_allclose(depths[:, pair.b] / depths[:, 0], expected, rtol=1e-9)


def test_views_that_no_chain_of_pairs_joins_keep_their_largest_part():
    matrices, spots = arc(5, 30)
    is_seen = np.ones((30, 5), dtype=bool)
    is_seen[0] = [True, False, False, True, True]
    table, _ = table_of(matrices, spots, is_seen)
    pairs = true_pairs(matrices, [(0, 1), (1, 2), (0, 2), (3, 4)])
    known = np.isfinite(projective_depths(table, pairs, np.array([[0, 1, 2]])))
    assert (known[0] == [False, False, False, True, True]).all()
    assert (known[1:] == [True, True, True, False, False]).all()


def test_a_ratio_of_the_wrong_sign_is_dropped():
    matrices, spots = arc(3, 40)
    spots[0, :3] = [9.0, 2.0, 3.0]  # behind A, in front of C
    is_seen = np.zeros((40, 3), dtype=bool)
    is_seen[:, [0, 2]] = True
    table, truth = table_of(matrices, spots, is_seen)
    assert truth[0, 0] < 0 < truth[0, 2]
    depths = projective_depths(table, true_pairs(matrices, [(0, 2)]), np.array([[0, 1, 2]]))
    assert np.isnan(depths[0]).all()
    assert np.isfinite(depths[1:, [0, 2]]).all()


def test_triples_tie_a_chain_in_which_each_three_neighbours_overlap():
    is_seen = np.zeros((6 * 20, 8), dtype=bool)
    for i in range(6):
        is_seen[20 * i : 20 * i + 20, i : i + 3] = True
    assert overlapping_triples(is_seen, NAMES).tolist() == [[i, i + 1, i + 2] for i in range(6)]


def test_cameras_outside_the_overlap_are_named():
    is_seen = np.zeros((100, 5), dtype=bool)
    is_seen[:50, :3] = True
    is_seen[50:, 2:] = True  # D and E share a single camera with the rest
    is_seen[50, 0] = True
    with pytest.raises(DegenerateError, match=r"cannot tie .*D, E"):
        overlapping_triples(is_seen | (np.arange(5) < 2) & (np.arange(100) < 55)[:, None], NAMES[:5])


def test_a_chain_of_pairs_is_refused():
    is_seen = np.zeros((400, 5), dtype=bool)
    for i in range(4):
        is_seen[100 * i : 100 * i + 100, i : i + 2] = True
    with pytest.raises(DegenerateError, match="three cameras that see 18 spots together, found none"):
        overlapping_triples(is_seen, NAMES[:5])


def lingering_problem():
    """Four cameras, 6000 spots; nine of ten in one tenth of every image. The first 100 are false, by the graph."""
    rng = np.random.default_rng(0)
    n = 6000
    xy = rng.uniform(-0.5, 0.5, (n, 4, 2))
    is_lingering = rng.random(n) < 0.9
    xy[is_lingering] = xy[is_lingering] * 0.1 + 0.45
    problem = StartProblem(
        camera=np.tile(np.arange(4), n),
        point=np.repeat(np.arange(n), 4),
        ray_xy=xy.reshape(-1, 2),
        tolerance=np.full(4, 0.005),
        is_focal_known=np.zeros(4, dtype=bool),
        names=NAMES[:4],
    )
    none = np.zeros((4, 4), dtype=np.int64)
    graph = PairGraph(NAMES[:4], (), problem.point >= 100, none, none, np.zeros(4))
    return problem, graph, is_lingering


def test_chosen_spots_are_inliers_spread_over_the_image_and_repeatable():
    problem, graph, is_lingering = lingering_problem()
    table = choose_spots(problem, graph, rng=np.random.default_rng(1))
    assert len(table.spot) == 1500  # 6000 observations at four views each
    assert table.spot.min() >= 100
    # Drawn evenly, a tenth (150 +- 12) would lie outside the corner; the cells outside are some 30 x as thinly filled.
    assert (~is_lingering[table.spot]).sum() > 300
    again = choose_spots(problem, graph, rng=np.random.default_rng(1))
    np.testing.assert_array_equal(again.spot, table.spot)
    rays = problem.ray_xy.reshape(-1, 4, 2)[table.spot]
    np.testing.assert_array_equal(table.ray[..., :2], rays)


def test_without_inliers_nothing_is_chosen():
    problem, graph, _ = lingering_problem()
    nothing = replace(graph, is_inlier=np.zeros(len(problem.camera), dtype=bool))
    assert not len(choose_spots(problem, nothing, rng=np.random.default_rng(0)).spot)
