import numpy as np
import pytest

from network_calib.synthetic import ROOM_NAMES, room
from nodes.simulated.rendering.camera_view import CameraView
from nodes.simulated.rendering.person import Person, person_at
from nodes.simulated.rendering.room_background import background_of, mirrored_part
from nodes.simulated.rendering.room_layout import layout_of
from nodes.simulated.rendering.room_scene import HARD, RoomScene
from nodes.simulated.rendering.spot_path import SpotPath


@pytest.fixture(scope="module")
def smart():
    return room("smart_room", rng=np.random.default_rng(1), n_frames=400)


@pytest.fixture(scope="module")
def layout(smart):
    return layout_of(HARD, smart.cameras, SpotPath.of(smart), seed=3)


@pytest.mark.parametrize("name", ROOM_NAMES)
def test_every_room_holds_its_cameras_and_path_and_nothing_stands_in_the_way(name):
    built = room(name, rng=np.random.default_rng(4), n_frames=60)
    layout = layout_of(HARD, built.cameras, SpotPath.of(built), seed=2)
    inside = np.vstack([built.cameras.centres_in_world, built.trajectory])
    assert ((inside > layout.low) & (inside < layout.high)).all()
    assert layout.low[2] == 0
    assert len(layout.boxes) >= 2
    for box in layout.boxes:
        assert ((inside < box.low) | (inside > box.high)).any(axis=1).all()


def test_the_same_seed_gives_the_same_room(smart, layout):
    again = layout_of(HARD, smart.cameras, SpotPath.of(smart), seed=3)
    other = layout_of(HARD, smart.cameras, SpotPath.of(smart), seed=4)
    assert [box.low.tolist() for box in again.boxes] == [box.low.tolist() for box in layout.boxes]
    assert again.windows == layout.windows
    assert other.windows != layout.windows
    assert other.texture_seed != layout.texture_seed


def test_furniture_hides_what_is_behind_it_and_nothing_before_it(layout):
    box = layout.boxes[0]
    middle, size = (box.low + box.high) / 2, box.high - box.low
    for axis in range(3):
        way = np.eye(3)[axis]
        origin = middle - 2 * size[axis] * way
        targets = np.array([middle + 2 * size[axis] * way, middle, middle - 0.6 * size[axis] * way])
        assert layout.hides(origin, targets).tolist() == [True, True, False]
        aside = np.eye(3)[(axis + 1) % 3] * 50.0
        assert not layout.hides(origin, (origin + aside)[None])[0]


def test_rays_meet_the_walls_and_furniture_that_hide(smart, layout):
    """The range of a pixel's ray and `hides` are two ways to the same surface."""
    view = CameraView.of(smart.cameras, 0)
    background = background_of(view, HARD, layout)
    rays = view.rays_in_world()
    for row, column in ((100, 100), (240, 320), (400, 500), (300, 60), (200, 600)):
        range_m, ray = float(background.range_m[row, column]), rays[row, column].astype(float)
        surface = view.centre_in_world + range_m * ray
        assert (surface > layout.low - 1e-3).all()
        assert (surface < layout.high + 1e-3).all()
        assert not layout.hides(view.centre_in_world, (surface - 0.01 * ray)[None])[0]
        is_on_room = (np.minimum(np.abs(surface - layout.low), np.abs(surface - layout.high)) < 1e-3).any()
        is_on_lamp = any(np.linalg.norm(surface - lamp.centre) < lamp.radius_m + 1e-3 for lamp in layout.lamps)
        assert is_on_room or is_on_lamp or layout.hides(view.centre_in_world, (surface + 0.01 * ray)[None])[0]


def test_pixels_rays_go_back_to_their_pixels(smart):
    for name, index in (("smart_room", 2), ("wide_fisheye", 1)):
        cameras = (
            smart.cameras if name == "smart_room" else room(name, rng=np.random.default_rng(1), n_frames=2).cameras
        )
        view = CameraView.of(cameras, index)
        rays = view.rays_in_world()
        for row, column in ((0, 0), (13, 277), (400, 601)):
            px, is_seen = view.project(view.centre_in_world + 3 * rays[row, column].astype(float))
            assert is_seen
            # Linear between every fourth pixel: an eighth of 16 px^2 times the lens's curvature, below 1e-3 a px.
            assert px == pytest.approx([column, row], abs=0.02)


def test_lamps_are_brighter_than_full_scale_and_a_void_is_black(smart, layout):
    view = CameraView.of(smart.cameras, 2)
    assert background_of(view, HARD, layout).lit.max() == pytest.approx(HARD.lamp_radiance)
    void = background_of(view, RoomScene(), layout)
    assert not void.lit.any()
    assert np.isinf(void.range_m).all()


def test_the_floor_mirrors_more_at_flat_angles():
    part = mirrored_part(0.1, np.array([1.0, 0.5, 0.1, 0.0]))
    assert part[0] == pytest.approx(0.1)
    assert part[-1] == pytest.approx(1.0)
    assert (np.diff(part) > 0).all()
    assert not mirrored_part(0.0, np.array([0.3])).any()


def limb(radius_m):
    """One upright limb of a metre at the origin."""
    return Person(
        np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.array([radius_m]), np.zeros((1, 3)), np.array([True])
    )


def test_a_limb_hides_what_is_behind_it():
    origin = np.array([-2.0, 0.0, 0.5])
    behind, before, beside, above = [2.0, 0.0, 0.5], [-0.5, 0.0, 0.5], [2.0, 1.0, 0.5], [2.0, 0.0, 2.2]
    # Beside: the sight passes the axis at 2 sin(atan(1 / 4)) = 0.485 m; above: over the end at 1.35 m.
    targets = np.array([behind, before, beside, above])
    assert limb(0.2).hides(origin, targets).tolist() == [True, False, False, False]
    assert limb(0.49).hides(origin, targets).tolist() == [True, False, True, True]
    assert limb(0.48).hides(origin, targets)[2] == np.False_


def test_the_person_holds_the_ball_and_stands_on_the_floor(smart):
    path = SpotPath.of(smart, n_empty=3)
    assert person_at(path, 0.0, clothes=0.3, phase_rad=1.0) is None
    for sequence in range(3, 400, 20):
        time_s = sequence / 25
        person = person_at(path, time_s, clothes=0.3, phase_rad=1.0)
        assert person is not None
        ball = path.at(np.array([time_s]))[0]
        ends = np.vstack([person.start, person.end])
        assert 0.0 < np.linalg.norm(ends - ball, axis=1).min() < 0.05
        assert ends[:, 2].min() == pytest.approx(0.0, abs=0.05)
        assert 0.9 < ends[:, 2].max() < 1.9 or ball[2] > 1.6
        # Nothing but the stick is at the ball itself.
        middle = (person.start[-1] + person.end[-1]) / 2
        assert not person.hides(ball + 0.02 * (ball - middle), (ball + (ball - middle))[None])[0]
