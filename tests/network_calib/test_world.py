"""The world frame: where it is, how large it is, and what cannot name one."""

from dataclasses import replace

import numpy as np
import pytest

from network_calib.errors import DegenerateError, InputError
from network_calib.gauge import Similarity, fit_similarity
from network_calib.optimum import optimise
from network_calib.room_setup import KnownCentres, KnownDistance, KnownPoints, Options, UnitScale
from network_calib.spots import SpotViews
from network_calib.synthetic import compare
from network_calib.uncertainty import uncertainty
from network_calib.world import in_world
from tests.network_calib.scenes import setups_of, waved


@pytest.fixture(scope="module")
def solved():
    """The smart room without outliers, its views, and the optimum in a frame of its own."""
    scene, seen = waved("smart_room", n_frames=800)
    views = SpotViews.of(seen.observations)
    network = optimise(setups_of(scene), views, anchor=UnitScale(), options=Options(), seed=0)
    return scene, views, network.refined


def posed(solved, anchor, options=None):
    _, views, refined = solved
    return in_world(refined, views, anchor, options or Options())


def test_unit_scale_is_the_first_cameras_frame(solved):
    frame, refined = posed(solved, UnitScale())
    assert (frame.name, frame.unit, frame.scale_sigma) == ("C0", "unit", 0.0)
    np.testing.assert_allclose(refined.cameras.rotations[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(refined.cameras.centres_in_world[0], 0, atol=1e-12)
    assert np.linalg.norm(refined.cameras.centres_in_world[1]) == pytest.approx(1.0)


def test_known_distance_scales_any_pair(solved):
    scene = solved[0]
    true = float(np.linalg.norm(scene.cameras.centres_in_world[4] - scene.cameras.centres_in_world[2]))
    frame, refined = posed(solved, KnownDistance("C2", "C4", true, sigma_m=0.01))
    assert frame.unit == "m"
    assert "C2-C4" in frame.scale_source
    assert frame.scale_sigma == pytest.approx(0.01 / true)
    found = refined.cameras.centres_in_world
    assert np.linalg.norm(found[4] - found[2]) == pytest.approx(true, rel=1e-12)
    # The rest follows: distances of several metres, off by millimetres.
    assert compare(refined.cameras, scene.cameras, align="rigid").centre_m.max() < 0.01


def test_a_frame_moves_cameras_and_spots_alike(solved):
    _, views, refined = solved
    for anchor in (UnitScale(), KnownDistance("C0", "C1", 5.0)):
        _, moved = posed(solved, anchor)
        before, _ = refined.cameras.img_from_world(views.camera, refined.points[views.point])
        after, _ = moved.cameras.img_from_world(views.camera, moved.points[views.point])
        np.testing.assert_allclose(after, before, atol=1e-7)
        np.testing.assert_array_equal(moved.cameras.intrinsics, refined.cameras.intrinsics)


def test_known_centres_put_the_world_there(solved):
    scene = solved[0]
    names = ("C4", "C0", "C2", "C3")
    centres = scene.cameras.centres_in_world[[4, 0, 2, 3]]
    frame, refined = posed(solved, KnownCentres(names, centres))
    assert frame.name == "given centres"
    errors = compare(refined.cameras, scene.cameras, align="none")
    assert errors.centre_m.max() < 0.01
    assert errors.rotation_deg.max() < 0.3
    # Four centres met within millimetres over some five metres.
    assert 0 < frame.scale_sigma < 2e-3


def test_centres_measured_badly_do_not_bend_the_calibration(solved):
    scene, _, refined = solved
    centres = scene.cameras.centres_in_world + np.random.default_rng(0).normal(0, 0.3, (5, 3))
    frame, moved = posed(solved, KnownCentres(scene.cameras.names, centres))
    # 0.3 m of error in 15 numbers over a spread of 8 m: 4 % of the scale.
    assert frame.scale_sigma == pytest.approx(0.3 / 6.6, rel=0.5)
    shape = compare(moved.cameras, refined.cameras)
    assert shape.centre_m.max() < 1e-9 * np.abs(refined.cameras.centres_in_world).max() + 1e-9


def test_known_points_put_the_world_there(solved):
    scene, views, _ = solved
    frames = tuple(int(frame) for frame in views.frames[::100])
    frame, refined = posed(solved, KnownPoints(frames, scene.trajectory[list(frames)]))
    assert frame.name == "given points"
    assert compare(refined.cameras, scene.cameras, align="none").centre_m.max() < 0.02


def test_floor_frames_level_the_world(solved):
    scene, views, refined = solved
    # Three moments near the floor stand in for a spot that was put down: moved onto it by hand.
    low = np.argsort(scene.trajectory[views.frames][:, 2])[:400:100]
    points = refined.points.copy()
    flat = scene.trajectory[views.frames[low]] * [1, 1, 0]
    motion = _to_solved(scene, refined)
    points[low] = motion.apply(flat)
    frames = tuple(sorted(int(f) for f in views.frames[low]))
    frame, moved = in_world(
        replace(refined, points=points),
        views,
        KnownDistance("C0", "C1", scene.baseline_m),
        Options(floor_frames=frames),
    )
    assert frame.name == "floor"
    # Heights above the floor are the room's own; the frame's directions are found from cameras known to millimetres.
    heights = moved.cameras.centres_in_world[:, 2]
    np.testing.assert_allclose(heights, scene.cameras.centres_in_world[:, 2], atol=0.03)
    np.testing.assert_allclose(moved.cameras.centres_in_world[0, :2], 0, atol=1e-9)


def _to_solved(scene, refined):
    """The similarity from the room into the solve's frame, from the camera centres."""
    return fit_similarity(scene.cameras.centres_in_world, refined.cameras.centres_in_world)


def test_unknown_names_and_frames_are_refused(solved):
    with pytest.raises(InputError, match="'C9'; the room has C0, C1, C2, C3, C4"):
        posed(solved, KnownDistance("C0", "C9", 1.0))
    with pytest.raises(InputError, match="'nobody'"):
        posed(solved, KnownCentres(("C0", "C1", "nobody"), np.eye(3)))
    with pytest.raises(DegenerateError, match="100000"):
        posed(solved, KnownPoints((0, 1, 100000), np.eye(3)))
    with pytest.raises(DegenerateError, match="-3"):
        posed(solved, UnitScale(), Options(floor_frames=(-3, 0, 1)))


def test_centres_on_a_line_name_no_frame(solved):
    with pytest.raises(DegenerateError, match="line"):
        posed(solved, KnownCentres(("C0", "C1", "C2"), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])))


@pytest.mark.parametrize("anchor", [UnitScale(), KnownDistance("C2", "C3", 5.7)])
def test_uncertainty_of_the_frame_itself_is_zero(solved, anchor):
    scene, views, _ = solved
    _, refined = posed(solved, anchor)
    spread = uncertainty(refined, setups_of(scene), views, anchor)
    sigma = np.sqrt(np.maximum(np.diagonal(spread.cameras, 0, 1, 2), 0))
    assert sigma[0, :6].max() < 1e-6 * sigma[1:, :6].max()
    assert (sigma[1:, :6].max(axis=1) > 0).all()
    assert (spread.focal_sigma_px > 0).all()
    assert spread.spots.shape == (len(np.unique(views.point[refined.is_inlier])), 3, 3)
    np.testing.assert_allclose(spread.spot_sigma**2, np.linalg.eigvalsh(spread.spots).max(axis=1))


def test_uncertainty_scales_with_the_world(solved):
    scene, views, _ = solved
    sigmas = []
    for distance_m in (1.0, 7.0):
        anchor = KnownDistance("C0", "C1", distance_m)
        _, refined = posed(solved, anchor)
        spread = uncertainty(refined, setups_of(scene), views, anchor)
        sigmas.append(np.sqrt(np.diagonal(spread.cameras, 0, 1, 2)[1:]))
    np.testing.assert_allclose(sigmas[1][:, 3:6], 7 * sigmas[0][:, 3:6], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(sigmas[1][:, 6], sigmas[0][:, 6], rtol=1e-4)


def test_similarity_between_frames_is_one_motion(solved):
    _, a = posed(solved, UnitScale())
    _, b = posed(solved, KnownDistance("C0", "C1", 2.0))
    np.testing.assert_allclose(b.points, Similarity(2.0, np.eye(3), np.zeros(3)).apply(a.points), rtol=1e-9, atol=1e-9)
