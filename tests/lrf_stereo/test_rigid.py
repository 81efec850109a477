"""Equations 7 and 8: exact cases, the determinant fix, weights, wrong pairs, refusals; and pycolmap as the referee."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.rigid import PointNoise, fit_rigid
from lrf_stereo.rigid_ransac import _triples, fit_rigid_robust
from network_calib.errors import ConvergenceError, DegenerateError, InputError
from tests.lrf_stereo.stereo_scene import TILTS, Noise, plane_samples, scanner

SEEDS = st.integers(0, 2**32 - 1)


def random_motion(rng):
    return RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))


def fan(rng, n=22):
    """(n, 3) spots in the scan plane, 1 to 3.5 m away, within 30 degrees of the front."""
    reach, bearing = rng.uniform(1, 3.5, n), rng.uniform(-0.5, 0.5, n)
    return np.column_stack([reach * np.cos(bearing), reach * np.sin(bearing), np.zeros(n)])


def plain_svd(source, target):
    """Arun's rotation without the determinant fix."""
    left, _, right = np.linalg.svd((target - target.mean(axis=0)).T @ (source - source.mean(axis=0)))
    return left @ right


def gap(a, b):
    """Largest difference of two motions' matrices."""
    return float(np.abs(a.as_matrix() - b.as_matrix()).max())


def test_a_quarter_turn_by_hand():
    source = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    # Turned a quarter about z, then moved by (10, 20, 30).
    target = np.array([[10.0, 20, 30], [10, 21, 30], [8, 20, 30]])
    expected = [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]
    assert fit_rigid(source, target).as_matrix() == pytest.approx(np.array(expected), abs=1e-14)


@given(SEEDS, st.integers(4, 50), st.booleans())
def test_exact_points_give_the_motion(seed, n, is_planar):
    rng = np.random.default_rng(seed)
    motion = random_motion(rng)
    source = fan(rng, n) if is_planar else rng.normal(size=(n, 3))
    # Rounding of 1e-15 over a width of at least LINE_RATIO = 0.01 of the length.
    assert gap(fit_rigid(source, motion.apply(source)), motion) < 1e-11
    noise = PointNoise(np.tile(np.diag([1e-6, 4e-6, 1e-2]), (n, 1, 1)))
    assert gap(fit_rigid(source, motion.apply(source), noise=noise), motion) < 1e-9


@given(SEEDS)
def test_a_fit_follows_the_frames(seed):
    rng = np.random.default_rng(seed)
    source = fan(rng)
    target = random_motion(rng).apply(source) + 0.02 * rng.normal(size=source.shape)
    a, b = random_motion(rng), random_motion(rng)
    moved = fit_rigid(a.apply(source), b.apply(target))
    assert gap(moved, b * fit_rigid(source, target) * a.inv()) < 1e-11


def test_without_the_determinant_fix_a_planar_scan_gives_reflections():
    rng = np.random.default_rng(0)
    n_reflections = 0
    for _ in range(300):
        source, motion = fan(rng), random_motion(rng)
        target = motion.apply(source) + 0.005 * rng.normal(size=source.shape)
        n_reflections += np.linalg.det(plain_svd(source, target)) < 0
        # 22 points of 5 mm: the worst turn, about the long side of 2.5 m, is known to 5 mm / (0.5 m sqrt(22)) = 2 mrad.
        error = (fit_rigid(source, target) * motion.inv()).rotation.magnitude()
        assert error < 6 * 0.002 * 2
    # The sign of a singular value that is zero is a coin: 150 with an sd of 9.
    assert 100 < n_reflections < 250


def test_weights_are_counts():
    rng = np.random.default_rng(3)
    source = fan(rng, 8)
    target = source + 0.05 * rng.normal(size=source.shape)
    count = np.array([1, 2, 3, 1, 0, 1, 4, 1])
    twice = fit_rigid(np.repeat(source, count, axis=0), np.repeat(target, count, axis=0))
    assert gap(fit_rigid(source, target, weights=count.astype(float)), twice) < 1e-12


@given(SEEDS)
def test_equal_covariances_give_aruns_answer(seed):
    rng = np.random.default_rng(seed)
    source = fan(rng)
    target = random_motion(rng).apply(source) + 0.02 * rng.normal(size=source.shape)
    noise = PointNoise(np.tile(0.3 * np.eye(3), (len(source), 1, 1)), np.tile(0.1 * np.eye(3), (len(source), 1, 1)))
    assert gap(fit_rigid(source, target, noise=noise), fit_rigid(source, target)) < 1e-9


def test_weighing_by_the_stereo_noise_reaches_the_bound():
    truth, n_runs = scanner(), 300
    plain, weighted, nees = [], [], []
    for seed in range(n_runs):
        rng = np.random.default_rng(seed)
        samples = plane_samples(truth, 22, rng, tilts=TILTS[1:2], noise=Noise())
        expected = truth.world_from_lrf_at(TILTS[1])
        source, noise = samples.point_in_lrf, samples.noise
        assert noise is not None
        for fits, given_noise in ((plain, None), (weighted, noise)):
            fits.append(fit_rigid(source, samples.spot_in_cam, noise=given_noise) * expected.inv())
        nees.append(normalised_error(weighted[-1], expected, source, noise))
    angle = [np.mean([error.rotation.magnitude() ** 2 for error in fits]) ** 0.5 for fits in (plain, weighted)]
    # Depth errs tens of times more than across: unweighted, 16 mrad against 2.4; an rms of 300 runs errs by 4 %.
    assert angle[1] < 0.25 * angle[0]
    # chi2 with 6 degrees of freedom: mean 6, sd of the mean sqrt(12 / 300) = 0.2; four of them. The uniform error of
    # the bearing and 1 mm rounding are taken as Gaussian of equal variance, which changes no mean.
    assert np.mean(nees) == pytest.approx(6, abs=0.8)


def normalised_error(error, expected, source, noise):
    """Squared error of a motion over its covariance, from the normal equations written out."""
    rotation = expected.rotation.as_matrix()
    information = noise.information(rotation)
    at = expected.apply(source)
    # (error * expected) s - expected s = w x at + v for a small turn w and shift v of the whole space.
    turned = np.stack([np.cross(unit, at) for unit in np.eye(3)], axis=2)
    rows = np.concatenate([turned, np.tile(np.eye(3), (len(at), 1, 1))], axis=2)
    hessian = (rows.swapaxes(1, 2) @ information @ rows).sum(axis=0)
    step = np.concatenate([error.rotation.as_rotvec(), error.translation])
    return step @ hessian @ step


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_wrong_pairs_are_found_and_change_nothing(share):
    n, n_same, n_runs = 22, 0, 50
    for seed in range(n_runs):
        rng = np.random.default_rng(seed)
        source, motion = fan(rng, n), random_motion(rng)
        target = motion.apply(source) + 0.005 * rng.normal(size=source.shape)
        is_right = np.ones(n, dtype=bool)
        is_right[rng.choice(n, round(share * n), replace=False)] = False
        source[~is_right] = fan(rng, n)[~is_right]
        found = fit_rigid_robust(source, target, rng=rng, threshold_m=3.37 * 0.005)
        n_same += (found.is_inlier == is_right).mean()
        alone = fit_rigid(source[found.is_inlier], target[found.is_inlier])
        assert gap(found.target_from_source, alone) < 1e-12
    # 1 % of honest pairs lie beyond 3.37 sigma, and a wrong pair lies within 17 mm of its place in a plane of 2.5 m2
    # with a chance of 0.0004: 0.99, and 0.5 % for the spread of 50 x 22 pairs and of refitting.
    assert n_same / n_runs > 0.985


def test_noise_tells_wrong_pairs_better_than_a_distance():
    truth, scores = scanner(), []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        samples = plane_samples(truth, 22, rng, tilts=TILTS[1:2], noise=Noise(), wrong=0.2)
        error = samples.spot_in_cam - truth.points_in_world(samples.range_m, samples.bearing_rad, TILTS[1])
        assert samples.noise is not None
        information = samples.noise.information(truth.world_from_lrf_at(TILTS[1]).rotation.as_matrix())
        is_right = np.einsum("ki,kij,kj->k", error, information, error) < 3.37**2
        given = samples.point_in_lrf, samples.spot_in_cam
        plain = fit_rigid_robust(*given, rng=rng, threshold_m=0.5)
        weighted = fit_rigid_robust(*given, rng=rng, noise=samples.noise)
        scores.append([(fit.is_inlier == is_right).mean() for fit in (plain, weighted)])
    plain_score, weighted_score = np.mean(scores, axis=0)
    # The truth's own verdict, but for honest pairs at the very limit: one in 100, half of which fitting moves across.
    assert weighted_score > 0.985
    assert plain_score < weighted_score - 0.01


def test_six_honest_spots_agree_whatever_triple_starts():
    truth, n_kept = scanner(), 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        samples = plane_samples(truth, 6, rng, tilts=TILTS[1:2], noise=Noise())
        found = fit_rigid_robust(samples.point_in_lrf, samples.spot_in_cam, rng=rng, noise=samples.noise)
        n_kept += found.is_inlier.sum()
    # One pair in 100 lies beyond the limit, fewer after a fit with 6 of 18 numbers free: 356 of 360, sd 2; and the
    # stereo errors are not quite Gaussian.
    assert n_kept >= 345


def test_random_triples_have_distinct_members_drawn_alike():
    triples = _triples(50, 5000, np.random.default_rng(0))
    assert triples.shape == (5000, 3)
    assert (np.diff(np.sort(triples, axis=1), axis=1) > 0).all()
    # 15000 members over 50 points: 300 each, sd 17; five of them, and each place of the triple likewise 100, sd 10.
    assert np.abs(np.bincount(triples.ravel(), minlength=50) - 300).max() < 5 * 17
    for place in triples.T:
        assert np.abs(np.bincount(place, minlength=50) - 100).max() < 5 * 10


def test_same_seed_same_answer():
    rng = np.random.default_rng(0)
    source = fan(rng, 60)
    target = source + 0.01 * rng.normal(size=source.shape)
    runs = [fit_rigid_robust(source, target, rng=np.random.default_rng(9), threshold_m=0.02) for _ in range(2)]
    assert gap(runs[0].target_from_source, runs[1].target_from_source) == 0
    assert (runs[0].is_inlier == runs[1].is_inlier).all()


def test_pycolmap_has_no_answer_in_a_plane_and_agrees_elsewhere():
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(4)
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = 0.02, 1
    motion, planar = random_motion(rng), fan(rng)
    # A scan is always planar, so its robust rigid estimator cannot serve here; ours must.
    assert pycolmap.estimate_rigid3d_robust(planar, motion.apply(planar), options) is None
    assert (
        gap(fit_rigid_robust(planar, motion.apply(planar), rng=rng, threshold_m=0.02).target_from_source, motion)
        < 1e-11
    )
    source = rng.uniform(-1, 1, (40, 3))
    target = motion.apply(source) + 0.003 * rng.normal(size=source.shape)
    target[:10] += 1.0
    theirs = pycolmap.estimate_rigid3d_robust(source, target, options)
    ours = fit_rigid_robust(source, target, rng=rng, threshold_m=0.02)
    assert np.asarray(theirs["inlier_mask"]).tolist() == ours.is_inlier.tolist()
    # Both are the least-squares motion of the same pairs.
    assert ours.target_from_source.as_matrix()[:3] == pytest.approx(theirs["tgt_from_src"].matrix(), abs=1e-9)


def test_too_few_points_and_lines_are_refused():
    rng = np.random.default_rng(1)
    square = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    line = np.outer(np.linspace(0, 2, 10), [1.0, 2.0, 0.0]) + 0.005 * rng.normal(size=(10, 3))
    with pytest.raises(DegenerateError, match="3 pairs of points or more, got 2"):
        fit_rigid(square[:2], square[:2])
    with pytest.raises(DegenerateError, match="3 pairs of points or more, got 2"):
        fit_rigid(square, square, weights=np.array([1.0, 0, 0, 1]))
    with pytest.raises(DegenerateError, match="on one line"):
        fit_rigid(line, line)
    with pytest.raises(DegenerateError, match="on one line"):
        fit_rigid(np.zeros((4, 3)), np.zeros((4, 3)))
    with pytest.raises(DegenerateError, match="3 pairs of points or more, got 2"):
        fit_rigid_robust(square[:2], square[:2], rng=rng, threshold_m=0.1)
    with pytest.raises(DegenerateError, match="on one line"):
        fit_rigid_robust(line, line, rng=rng, threshold_m=0.1)


def test_contradictory_input_is_refused():
    rng, square = np.random.default_rng(1), np.eye(3)
    noise = PointNoise(np.tile(np.eye(3), (3, 1, 1)))
    with pytest.raises(InputError, match="two equal sets"):
        fit_rigid(square, square[:2])
    with pytest.raises(InputError, match="not by both"):
        fit_rigid(square, square, weights=np.ones(3), noise=noise)
    for neither_or_both in ({}, {"threshold_m": 0.1, "noise": noise}):
        with pytest.raises(InputError, match="threshold in metres or the noise"):
            fit_rigid_robust(square, square, rng=rng, **neither_or_both)


def test_pairs_that_agree_on_nothing_are_refused():
    rng = np.random.default_rng(2)
    with pytest.raises(ConvergenceError, match="no rigid motion agrees with a third of the 30 pairs"):
        fit_rigid_robust(fan(rng, 30), fan(rng, 30) + rng.normal(size=(30, 3)), rng=rng, threshold_m=0.01)
