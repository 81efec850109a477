from dataclasses import asdict, replace

import numpy as np
import pytest

from network_calib.errors import InputError
from network_calib.synthetic import room
from nodes.frames import PixelFormat, StampOrigin
from nodes.simulated.rendering.rendered_camera import FrameClock, RenderedCamera
from nodes.simulated.rendering.room_scene import HARD, SCENES, RoomScene, scene_named
from nodes.simulated.rendering.sensor import SensorModel
from nodes.simulated.rendering.spot_image import Ball, SpotColour
from nodes.simulated.rendering.spot_path import SpotPath

# No glare (its skirt is cut off by the image's rim), no fixed pattern, hardly any time to move.
SHARP = SensorModel(glare_part=0.0, response_spread=0.0, exposure_s=1e-6, bits=16)
TINY = RoomScene(ball=Ball(diameter_m=0.004, radiance=2e4))


@pytest.fixture(scope="module")
def smart():
    return room("smart_room", rng=np.random.default_rng(1), n_frames=300)


@pytest.fixture(scope="module")
def path(smart):
    return SpotPath.of(smart)


@pytest.fixture(scope="module")
def hard(smart, path):
    """The room with everything, in a raw mosaic."""
    return camera(smart, path, scene=HARD, sensor=SensorModel(pixel_format=PixelFormat.BAYER_GRBG, blooming=0.5))


def camera(smart, path, *, index=0, scene=TINY, sensor=SHARP, seed=7, clock=None):
    return RenderedCamera(
        smart.cameras, index, path, scene=scene, sensor=sensor, seed=seed, clock=clock or FrameClock()
    )


def centroid(light):
    y, x = np.mgrid[: light.shape[0], : light.shape[1]]
    return np.array([(x * light).sum(), (y * light).sum()], dtype=float) / light.sum(dtype=float)


def project(smart, index, point):
    px, _ = smart.cameras.img_from_world(np.array([index]), np.asarray(point)[None])
    return px[0]


def test_without_noise_the_centroid_of_the_light_is_the_truth(smart, path):
    """At the sub-pixel phases of a whole waved path."""
    cam = camera(smart, path, index=2)
    errors, phases = [], []
    for sequence in range(0, 300, 2):
        light, truth = cam.light(sequence)
        # Light within 8 px of the rim would be cut off.
        if not truth.is_visible or (truth.px < 8).any() or (truth.px > np.array(cam.size_px) - 9).any():
            continue
        errors.append(np.abs(centroid(light) - truth.px).max())
        phases.append(truth.px % 1)
        assert truth.px == pytest.approx(project(smart, 2, path.points_in_world[sequence]), abs=1e-9)
        assert truth.peak == pytest.approx(light.max(), rel=1e-5)
    assert len(errors) > 100
    assert (np.ptp(phases, axis=0) > 0.9).all()
    # Sampling of a Gaussian of 0.75 px: exp(-2 pi^2 0.75^2) / pi = 5e-6 px; perspective of 2 mm at 1 m or more, off the
    # axis by 45 degrees at most: f tan(45) (r / d)^2 = 2e-3 px at 1 m, less by the limb darkening and farther off.
    assert max(errors) < 0.002


def test_smear_of_even_straight_motion_is_centred_at_mid_exposure(smart):
    step = np.array([0.04, 0.03, -0.01])
    path = SpotPath(np.array([2.0, 2.0, 1.2]) + np.arange(30.0)[:, None] * step, 25.0)
    cam = camera(smart, path, sensor=replace(SHARP, exposure_s=0.03), clock=FrameClock(phase_s=0.013, start_ns=10**18))
    for sequence in (3, 11, 20):
        light, truth = cam.light(sequence)
        assert truth.stamp_ns == 10**18 + sequence * 40_000_000 + 13_000_000
        middle = path.points_in_world[0] + step * (truth.stamp_ns - 10**18) / 4e7
        assert truth.px == pytest.approx(project(smart, 0, middle), abs=1e-6)
        ends = [project(smart, 0, middle + side * 0.375 * step) for side in (-1, 1)]
        assert truth.smear_px == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=1e-3)
        assert truth.smear_px > 3
        assert centroid(light) == pytest.approx(truth.centroid_px, abs=1e-3)
        # Perspective bends even motion: the mean of the way lies off its middle by a third of its sagitta-like excess.
        excess = np.abs((ends[0] + ends[1]) / 2 - truth.px).max()
        assert np.abs(truth.centroid_px - truth.px).max() < excess / 3 + 0.002
        y, x = np.nonzero(light > light.max() / 2)
        along = (ends[1] - ends[0]) / truth.smear_px
        assert np.ptp(np.stack([x, y], axis=1) @ along) == pytest.approx(truth.smear_px, abs=2)


def test_the_floor_mirrors_the_spot_where_the_mirrored_point_is(smart, path):
    glossy = replace(TINY, gloss=0.2)
    for sequence in range(0, 300, 25):
        light, truth = camera(smart, path, scene=glossy).light(sequence)
        direct, _ = camera(smart, path).light(sequence)
        mirrored = path.points_in_world[sequence] * [1, 1, -1]
        if truth.reflection_px is None:
            continue
        assert truth.reflection_px == pytest.approx(project(smart, 0, mirrored), abs=1e-9)
        only = light - direct
        if (truth.reflection_px < 16).any() or (truth.reflection_px > np.array([623, 463])).any():
            continue
        assert centroid(only) == pytest.approx(truth.reflection_px, abs=0.005)
        assert 0 < only.max() < 0.5 * direct.max()
        break
    else:
        pytest.fail("no mirror image in the whole path")


def test_frames_do_not_depend_on_what_was_rendered_before(smart, path, hard):
    again = camera(smart, path, scene=HARD, sensor=hard.sensor)
    forth = [hard.render(sequence) for sequence in (0, 57, 58)]
    back = [again.render(sequence) for sequence in (58, 57, 0)][::-1]
    for (frame, truth), (other, other_truth) in zip(forth, back, strict=True):
        assert frame.image.tobytes() == other.image.tobytes()
        np.testing.assert_equal(asdict(truth), asdict(other_truth))
    np.testing.assert_equal(asdict(hard.truth(57)), asdict(forth[1][1]))


def test_seeds_cameras_and_frames_have_noise_of_their_own(smart, path):
    sensor, off = SensorModel(), path.switched(np.zeros(len(path), dtype=bool))
    images = [
        camera(smart, off, scene=RoomScene(), sensor=sensor, seed=seed, index=index).render(sequence)[0].image
        for seed, index, sequence in ((1, 0, 5), (2, 0, 5), (1, 1, 5), (1, 0, 6))
    ]
    for k, one in enumerate(images):
        for other in images[:k]:
            # Independent noise: a correlation of 307200 samples has a sigma of 1 / 554.
            assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 6 / 554


def test_a_hidden_spot_is_said_to_be_hidden_and_gives_no_light(smart, path):
    scene = replace(RoomScene(light=0.2, has_person=True), ball=Ball(diameter_m=0.02, radiance=50.0))
    cam = camera(smart, path, scene=scene, index=2)
    off = camera(smart, path.switched(np.zeros(len(path), dtype=bool)), scene=scene, index=2)
    truths = [cam.truth(sequence) for sequence in range(len(path))]
    in_image = [truth for truth in truths if np.isfinite(truth.px).all() and cam.view.is_in_image(truth.px)]
    hidden = [truth for truth in in_image if truth.visible_part == 0]
    assert 0.01 < len(hidden) / len(in_image) < 0.5
    assert not any(truth.is_visible for truth in hidden)
    seen = [truth for truth in in_image if truth.visible_part == 1]
    assert all(truth.is_visible for truth in seen)
    for truth, is_lit in ((hidden[0], False), (seen[0], True)):
        difference = cam.light(truth.sequence)[0] - off.light(truth.sequence)[0]
        assert (difference.max() > 0.5 * truth.peak > 0) == is_lit
        assert (difference == 0).all() != is_lit


def test_a_pointer_that_is_off_leaves_the_person_and_no_truth(smart, path):
    is_on = np.arange(len(path)) != 60
    scene = replace(HARD, switch_s=None)
    cam = camera(smart, path.switched(is_on), scene=scene)
    truth = cam.truth(60)
    assert np.isnan(truth.px).all()
    assert (truth.is_visible, truth.visible_part, truth.peak, truth.reflection_px) == (False, 0.0, 0.0, None)
    still = replace(scene, mains_flicker=0.0, window_drift=0.0, n_screens=0, n_indicators=0)
    empty = camera(smart, SpotPath.of(smart, n_empty=5), scene=still, index=2)
    assert np.isnan(empty.truth(4).px).all()
    np.testing.assert_array_equal(empty.light(1)[0], empty.light(4)[0])
    person = np.abs(empty.light(40)[0] - empty.light(4)[0]) > 1e-6
    assert 0.005 < person.mean() < 0.6


def test_a_light_is_switched_on_for_good(smart, path):
    scene = RoomScene(light=0.1, switched_light=0.3, switch_s=4.0)
    cam = camera(smart, path, scene=scene, sensor=replace(SHARP, exposure_s=0.01))
    dark, bright = (cam.light(sequence)[0].mean() for sequence in (99, 100))
    assert bright > 2 * dark
    assert cam.light(150)[0].mean() == pytest.approx(bright, rel=0.01)


@pytest.mark.parametrize(
    ("disturbance", "sequences"),
    [({"n_windows": 2, "window_drift": 0.4}, (0, 125)), ({"n_screens": 2}, (0, 1)), ({"n_indicators": 4}, (0, 20))],
)
def test_windows_drift_screens_flicker_and_indicators_blink(smart, path, disturbance, sequences):
    off = path.switched(np.zeros(len(path), dtype=bool))
    sensor = replace(SHARP, exposure_s=0.01)
    cam = camera(smart, off, scene=RoomScene(light=0.2, **disturbance), sensor=sensor, index=2)
    one, other = (cam.light(sequence)[0] for sequence in sequences)
    assert (np.abs(other - one) > 0.01).sum() > 3


def test_the_background_of_the_spot_is_the_rooms_level_there(smart, path):
    scene = RoomScene(light=0.3, n_windows=2, window_radiance=2.0, window_drift=0.2, switched_light=0.3, switch_s=4.0)
    sensor = replace(SHARP, exposure_s=0.01)
    off = camera(smart, path.switched(np.zeros(len(path), dtype=bool)), scene=scene, sensor=sensor)
    cam, seen = camera(smart, path, scene=scene, sensor=sensor), []
    for sequence in range(0, 300, 10):
        truth = cam.truth(sequence)
        if truth.is_visible and (truth.px > 1).all() and (truth.px < np.array([638, 478])).all():
            x, y = np.rint(truth.px).astype(int)
            room_light = off.light(sequence)[0][y - 1 : y + 2, x - 1 : x + 2]
            assert truth.background == pytest.approx(room_light.max(), abs=1e-3)
            seen.append(truth.background)
    assert min(seen) < 0.4
    assert max(seen) > 1.2


def test_a_longer_exposure_and_an_infrared_pointer_are_seen_as_they_should(smart, path):
    still = SpotPath(np.tile(path.points_in_world[10], (5, 1)), 25.0)
    peaks = [
        camera(smart, still, sensor=replace(SHARP, exposure_s=exposure_s)).truth(2).peak
        for exposure_s in (0.005, 0.01, 0.02)
    ]
    assert peaks[1:] == pytest.approx([2 * peaks[0], 4 * peaks[0]])
    bayer = replace(SHARP, pixel_format=PixelFormat.BAYER_RGGB)
    totals = {}
    for colour in SpotColour:
        scene = replace(TINY, ball=replace(TINY.ball, colour=colour, diameter_m=0.1))
        light, _ = camera(smart, still, scene=scene, sensor=bayer).light(2)
        totals[colour] = [light[1::2, 1::2].sum(), light[::2, 1::2].sum(), light[::2, ::2].sum()]
        mono, _ = camera(smart, still, scene=scene).light(2)
        assert mono.sum() == pytest.approx(4 * max(totals[colour]), rel=0.05)
    assert np.argmax(totals[SpotColour.RED]) == 2
    assert np.argmax(totals[SpotColour.GREEN]) == 1
    assert min(totals[SpotColour.INFRARED]) > 0.7 * max(totals[SpotColour.INFRARED])


def test_a_spot_beyond_the_lens_is_not_folded_back_into_the_image(smart):
    """Far off the axis barrel distortion folds; behind the camera nothing is seen."""
    cameras = smart.cameras
    ahead = cameras.rotations[0].T
    centre = cameras.centres_in_world[0]
    ways = [ahead @ [3.0, 0.0, 1.0], ahead @ [0.0, 0.0, -1.0], ahead @ [8.0, 2.0, 1.0]]
    for way in ways:
        path = SpotPath(np.tile(centre + 0.5 * way, (3, 1)), 25.0)
        light, truth = camera(smart, path).light(1)
        assert not truth.is_visible
        assert np.isnan(truth.px).all()
        assert light.max() == 0


@pytest.mark.parametrize("name", list(SCENES))
@pytest.mark.parametrize(("pixel_format", "bits"), [(PixelFormat.MONO, 12), (PixelFormat.BGR, 8)])
def test_every_scene_gives_frames_of_every_kind(smart, path, name, pixel_format, bits):
    sensor = SensorModel(pixel_format=pixel_format, bits=bits, gamma=2.2, streak=1e-4, n_hot_pixels=5, blooming=0.3)
    cam = camera(smart, path, scene=scene_named(name), sensor=sensor)
    frame, truth = cam.render(30)
    assert frame.image.shape == ((480, 640, 3) if pixel_format is PixelFormat.BGR else (480, 640))
    assert frame.image.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert (frame.size_px, frame.bits, frame.pixel_format) == ((640, 480), bits, pixel_format)
    assert (frame.sequence, frame.stamp_ns, frame.origin) == (30, 1_200_000_000, StampOrigin.CAMERA)
    assert frame.settings.exposure_s == sensor.exposure_s
    assert (truth.sequence, truth.stamp_ns) == (30, frame.stamp_ns)
    # A room, not a void and not a white wall.
    level = frame.image / (2**bits - 1)
    assert 0.02 < level.mean() < 0.9
    assert level.std() > 0.01


def test_names_and_numbers_that_cannot_be_are_refused(smart, path):
    with pytest.raises(InputError, match="no scene 'disco'"):
        scene_named("disco")
    with pytest.raises(InputError, match="camera index is 5"):
        camera(smart, path, index=5)
    with pytest.raises(InputError, match="rate_hz"):
        FrameClock(rate_hz=0.0)
