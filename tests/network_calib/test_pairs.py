"""Epipolar verification: exact on exact views, blind to false detections, deterministic; the overlap graph speaks."""

from pathlib import Path

import numpy as np
import pytest

from network_calib.epipolar import homogeneous, unbend
from network_calib.observations import Observations
from network_calib.pairs import Overlap, PairGraph, verify_pairs
from network_calib.start import StartProblem
from network_calib.synthetic import observe, room

DATA = Path(__file__).parents[2].parent / "shared" / "data"


def problem_of(observations, size_px):
    """Nominal rays: focal length the longer image side, principal point the image centre, 4 px of tolerance."""
    views = observations.in_frames_with_views(2)
    nominal = size_px.max(axis=1).astype(np.float64)
    ray_xy = (views.px - (size_px[views.camera] - 1) / 2) / nominal[views.camera, None]
    _, point = np.unique(views.frame, return_inverse=True)
    known = np.zeros(views.n_cameras, dtype=bool)
    return StartProblem(views.camera, point, ray_xy, 4 / nominal, known, views.camera_names)


def sighted(name, *, seed=0, late_camera=None, n_frames_late=0, **observing):
    """Start problem of a named room, and which of its rows are honest."""
    rng = np.random.default_rng(seed)
    scene = room(name, rng=rng)
    seen = observe(scene, rng=rng, **observing)
    table = seen.observations
    delay = np.where(table.camera == late_camera, n_frames_late, 0)
    shifted = Observations.from_columns(
        table.camera_names, camera=table.camera, frame=table.frame + delay, px=table.px, sigma_px=None
    )
    problem = problem_of(shifted, scene.cameras.size_px)
    return problem, seen.is_true[table.n_views() >= 2]


def exact_problem(bend=(0.0, 0.0, 0.0), *, seed=0, n=400):
    """Three cameras of known matrices around a box of spots, rays bent so that `unbend` undoes it exactly."""
    rng = np.random.default_rng(seed)
    spots = rng.uniform([-1.5, -1.0, 3.0], [1.5, 1.0, 6.0], (n, 3))
    matrices = []
    for turn, shift in ((0.0, 0.0), (0.3, -1.2), (-0.25, 1.1)):
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        matrices.append(np.column_stack([rotation, [shift, 0.1 * shift, 0.2]]))
    in_cam = np.einsum("cij,kj->kci", np.array(matrices), np.column_stack([spots, np.ones(n)]))
    straight = 0.8 * in_cam[..., :2] / in_cam[..., 2:]
    ray_xy = straight.copy()
    for _ in range(100):
        ray_xy = straight * ray_xy / np.where(ray_xy == 0, 1.0, unbend(ray_xy, np.array(bend)))
    problem = StartProblem(
        camera=np.tile(np.arange(3), n),
        point=np.repeat(np.arange(n), 3),
        ray_xy=ray_xy.reshape(-1, 2),
        tolerance=np.full(3, 0.004),
        is_focal_known=np.zeros(3, dtype=bool),
        names=("A", "B", "C"),
    )
    return problem, straight


@pytest.mark.parametrize("bend", [(0.0, 0.0, 0.0), (0.3, 0.5, 0.2)])
def test_exact_views_give_exact_matrices_and_bends(bend):
    problem, straight = exact_problem(bend)
    graph = verify_pairs(problem, rng=np.random.default_rng(1))
    assert [(pair.a, pair.b) for pair in graph.pairs] == [(0, 1), (0, 2), (1, 2)]
    # Without noise only the prior of the bend pulls, (0.2 / 0.7)^2 = 0.08 against an information of about 20 (900
    # spots, 0.004 of tolerance, all but a seventieth of a bend's effect taken up by F): 0.4 % of 0.5, twice that.
    np.testing.assert_allclose(graph.bend, bend, atol=4e-3)
    for pair in graph.pairs:
        error = np.einsum(
            "ki,ij,kj->k", homogeneous(straight[:, pair.b]), pair.fundamental, homogeneous(straight[:, pair.a])
        )
        # |F| = 1 and r^2 < 0.2: what F does not take up of a bend wrong by 4e-3 is a seventieth of 4e-3 * 0.2.
        assert np.abs(error).max() < 2e-5
        assert np.linalg.svd(pair.fundamental, compute_uv=False)[2] < 1e-12
        assert pair.n_inliers == pair.n_shared == 400
    assert graph.is_inlier.all()


@pytest.mark.parametrize("name", ["smart_room", "ring_room", "tele_beside_wide", "corridor_chain"])
def test_honest_detections_stay_and_false_ones_go(name):
    problem, is_true = sighted(name, missing=0.3, false_detections=0.1)
    graph = verify_pairs(problem, rng=np.random.default_rng(1))
    n_true = np.bincount(problem.point, weights=is_true)[problem.point]
    # An honest view can be known only beside another; one in a frame with as many false ones may lose the vote, which
    # befalls less than a hundredth of them at a tenth of false detections.
    assert graph.is_inlier[is_true & (n_true >= 2)].mean() > 0.99
    # A false detection agrees by chance with an honest view when it falls within 4 px (12 px in a badly bent pair) of
    # the epipolar line, at most 24 / 480 of the image; in a chain many frames hold no second honest view to say no, and
    # thin pairs fit some of theirs: twice that.
    assert graph.is_inlier[~is_true].mean() < (0.1 if name == "corridor_chain" else 0.05)


def test_same_generator_state_gives_the_same_graph():
    problem, _ = sighted("smart_room", missing=0.3, false_detections=0.1)
    first, second = (verify_pairs(problem, rng=np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first.is_inlier, second.is_inlier)
    np.testing.assert_array_equal(first.bend, second.bend)
    for one, other in zip(first.pairs, second.pairs, strict=True):
        np.testing.assert_array_equal(one.fundamental, other.fundamental)


def test_rooms_that_share_nothing_are_islands():
    problem, _ = sighted("two_islands")
    graph = verify_pairs(problem, rng=np.random.default_rng(0))
    assert graph.islands() == [(0, 1, 2), (3, 4, 5)]
    bridge = graph.bridge()
    assert bridge is not None
    assert bridge[0] in (0, 1, 2)
    assert bridge[1] in (3, 4, 5)


def test_a_pair_with_few_shared_spots_is_not_tried():
    problem, _ = exact_problem(n=14)
    graph = verify_pairs(problem, rng=np.random.default_rng(0))
    assert graph.pairs == ()
    assert not graph.is_inlier.any()
    assert graph.shared[0, 1] == 14
    assert graph.islands() == [(0,), (1,), (2,)]


def test_no_observations_give_an_empty_graph():
    empty = np.zeros(0, dtype=np.int64)
    problem = StartProblem(empty, empty, np.zeros((0, 2)), np.full(2, 0.004), np.zeros(2, dtype=bool), ("A", "B"))
    graph = verify_pairs(problem, rng=np.random.default_rng(0))
    assert graph.islands() == [(0,), (1,)]
    assert graph.bridge() == (0, 1)


def hand_made(ends, shared, inliers):
    problem, _ = exact_problem()
    pair = verify_pairs(problem, rng=np.random.default_rng(0)).pairs[0]
    counts = np.array(inliers)
    pairs = tuple(
        type(pair)(a, b, pair.fundamental, int(shared[a][b]), int(inliers[a][b]), pair.information) for a, b in ends
    )
    names = tuple(f"C{c}" for c in range(len(counts)))
    return PairGraph(names, pairs, np.zeros(0, dtype=bool), np.array(shared), counts, np.zeros(len(counts)))


def test_leaves_bridge_and_grades_of_a_hand_made_graph():
    shared = [[900, 300, 0, 8], [300, 900, 120, 11], [0, 120, 400, 0], [8, 11, 0, 60]]
    inliers = [[0, 250, 0, 0], [250, 0, 49, 0], [0, 49, 0, 0], [0, 0, 0, 0]]
    graph = hand_made([(0, 1), (1, 2)], shared, inliers)
    assert graph.leaves() == (0, 2)
    assert graph.islands() == [(0, 1, 2), (3,)]
    assert graph.bridge() == (1, 3)
    assert graph.grade(0, 1) is Overlap.GOOD
    assert graph.grade(1, 2) is Overlap.INSUFFICIENT
    assert hand_made([], shared, [[0, 50], [50, 0]]).grade(0, 1) is Overlap.MARGINAL


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("n_frames_late", [3, 10])
def test_a_camera_out_of_step_is_named(seed, n_frames_late):
    problem, _ = sighted("smart_room", seed=seed, late_camera=2, n_frames_late=n_frames_late, missing=0.1)
    suspects = verify_pairs(problem, rng=np.random.default_rng(0)).disagreeing_cameras()
    assert [suspect.camera for suspect in suspects] == [2]
    assert "C2" in suspects[0].reason


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cameras_in_step_are_not_suspected(seed):
    problem, _ = sighted("smart_room", seed=seed, missing=0.3, false_detections=0.1)
    assert verify_pairs(problem, rng=np.random.default_rng(0)).disagreeing_cameras() == ()


def recorded(name):
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"the recording {name} is not in ../shared/data")
    is_seen = np.loadtxt(folder / "IdMat.dat") > 0
    px = np.loadtxt(folder / "points.dat").reshape(*is_seen.shape[:1], 3, -1)[:, :2]
    camera, frame = np.nonzero(is_seen)
    names = tuple(f"C{c}" for c in range(len(is_seen)))
    table = Observations.from_columns(names, camera=camera, frame=frame, px=px[camera, :, frame])
    return problem_of(table, np.loadtxt(folder / "Res.dat").astype(np.int64).reshape(-1, 2))


@pytest.mark.parametrize("name", ["caldata20130726_122220", "DATA20100906_134124", "DATA20090709_111010"])
def test_real_recordings_agree_in_every_pair(name):
    problem = recorded(name)
    graph = verify_pairs(problem, rng=np.random.default_rng(0))
    assert len(graph.islands()) == 1
    # 5 % of the observations may be false or too bent for the joint solve, half of it is generous here.
    assert graph.is_inlier.mean() > 0.975
