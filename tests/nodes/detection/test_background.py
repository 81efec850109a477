import numpy as np
import pytest

from nodes.detection.background import HURRIED_STRIPES, STRIPE_ROWS, WINDOW_VISITS, Background
from nodes.detection.background_learner import N_HELD, BackgroundLearner
from nodes.detection.channel import channel_of
from nodes.detection.spots import Channel
from tests.nodes.detection.small_scene import HEIGHT, NOISE, WIDTH, Scene, light

# Frames in which every row learns once when there is a hurry.
N_ROUND = -(-HEIGHT // (STRIPE_ROWS * HURRIED_STRIPES))


def plane_of(frame):
    return channel_of(frame, Channel.LUMA)


def learnt(frames, *, is_empty=True):
    learner = BackgroundLearner(Channel.LUMA, is_empty=is_empty)
    for frame in frames:
        learner.add(plane_of(frame))
    return learner.background()


@pytest.fixture
def scene():
    return Scene()


@pytest.fixture
def background(scene):
    return learnt([scene.frame() for _ in range(50)])


def is_new(background, frame):
    return plane_of(frame).samples > background.threshold


def test_mean_and_spread_are_those_of_the_scene(scene, background):
    # Of 24 frames, the mean of the middle half has a standard deviation below 0.3 noise; 6 of them never in 77,000.
    assert np.abs(background.mean - scene.background).max() < 6 * 0.3 * NOISE
    # Of two sides the larger: above the noise by a fifth or so, never below it in the mean.
    assert 1.0 < background.spread.mean() / NOISE < 1.4


def test_noise_alone_is_hardly_ever_new(scene, background):
    # 5.5 standard deviations of Gaussian noise: 2e-8 of 77,000 samples; uncertain spreads make some more of it.
    n_new = sum(np.count_nonzero(is_new(background, scene.frame())) for _ in range(50))
    assert n_new <= 5


def test_a_spot_of_ten_noises_is_new(scene, background):
    assert is_new(background, scene.frame(light(100, 80, peak=10 * NOISE + 3)))[80, 100]


def test_flicker_is_covered_by_the_maximum(scene):
    screen = (200, 50, 240, 80)
    frames = [scene.frame((screen, 160.0 if k % 7 == 0 else 60.0)) for k in range(50)]
    assert not is_new(learnt(frames), scene.frame((screen, 160.0)))[52:78, 202:238].any()


def test_flicker_is_forgotten_after_two_windows(scene):
    screen = (200, 50, 240, 80)
    background = learnt([scene.frame((screen, 160.0 if k % 7 == 0 else 60.0)) for k in range(50)])
    for _ in range((2 * WINDOW_VISITS + 12) * N_ROUND):
        background.learn(plane_of(scene.frame((screen, 60.0))).samples, is_hurried=True)
    assert is_new(background, scene.frame((screen, 160.0)))[52:78, 202:238].all()


def test_flicker_in_step_with_the_visits_is_covered_too(scene):
    # A row is visited in every 30th frame, if that were all, and would see the dark phase only.
    screen = (200, 50, 240, 80)
    background = learnt([scene.frame((screen, 160.0 if k % 3 == 0 else 60.0)) for k in range(50)])
    for k in range(30 * 4 * WINDOW_VISITS):
        background.learn(plane_of(scene.frame((screen, 160.0 if k % 3 == 0 else 60.0))).samples)
    assert is_new(background, scene.frame((screen, 160.0)))[52:78, 202:238].mean() < 0.01


def test_lamps_at_full_scale_are_never_new(scene):
    lamp = light(60, 60, width=4, peak=400.0)
    background = learnt([scene.frame(lamp) for _ in range(50)])
    assert not is_new(background, scene.frame(lamp)).any()


def test_the_spot_is_not_learnt_where_it_is_spared(scene, background):
    spot = light(150, 120, peak=120.0)
    for _ in range(60 * N_ROUND):
        background.learn(plane_of(scene.frame(spot)).samples, without=[(140, 110, 161, 131)], is_hurried=True)
    assert is_new(background, scene.frame(spot))[120, 150]
    assert abs(background.mean[120, 150] - scene.background[120, 150]) < 2


def test_without_sparing_it_would_be_learnt(scene, background):
    spot = light(150, 120, peak=120.0)
    for _ in range(60 * N_ROUND):
        background.learn(plane_of(scene.frame(spot)).samples, is_hurried=True)
    assert not is_new(background, scene.frame(spot))[120, 150]


def test_slow_drift_is_followed(scene, background):
    # To 1.2 times the light in 300 frames, a stripe in every second: each is visited every 30 frames, a drift of 2 %.
    n_new = 0
    for k in range(300):
        plane = plane_of(scene.frame(scale=1 + 0.2 * k / 300))
        n_new += np.count_nonzero(plane.samples > background.threshold)
        background.learn(plane.samples)
    assert n_new / (300 * HEIGHT * WIDTH) < 1e-4
    assert np.abs(background.mean - 1.2 * scene.background).max() < 0.12 * 1.2 * scene.background.max()


def test_changed_share_tells_a_switched_light_from_a_passer_by(scene, background):
    assert background.survey(plane_of(scene.frame()).samples).changed_share < 0.01
    person = background.survey(plane_of(scene.frame(((100, 60, 140, 240), 20.0))).samples)
    # 40 x 180 of 320 x 240 pixels are 9 %.
    assert 0.05 < person.changed_share < 0.15
    assert person.is_darker.sum() == pytest.approx(0.094 * person.is_darker.size, rel=0.3)
    assert background.survey(plane_of(scene.frame(scale=1.6)).samples).changed_share > 0.9
    assert background.survey(plane_of(scene.frame(scale=0.5)).samples).changed_share > 0.9


def test_nothing_is_new_outside_of_the_mask(scene, background):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :160] = True
    background.watch_only(mask)
    new = is_new(background, scene.frame(light(100, 80), light(200, 80)))
    assert new[80, 100]
    assert not new[:, 160:].any()
    survey = background.survey(plane_of(scene.frame(scale=0.5)).samples)
    assert survey.changed_share == pytest.approx(0.5, abs=0.05)
    assert not survey.is_darker[:, 10:].any()
    background.watch_only(None)
    assert is_new(background, scene.frame(light(200, 80)))[80, 200]


def test_a_whole_recording_teaches_the_background_without_the_spot(scene):
    # The spot moves two of its widths a frame and comes back to a place at most a few times in 400 frames.
    way = [(160 + 120 * np.cos(0.11 * k), 120 + 90 * np.sin(0.17 * k)) for k in range(400)]
    background = learnt([scene.frame(light(*px)) for px in way], is_empty=False)
    assert np.abs(background.mean - scene.background).max() < 6 * 0.3 * NOISE
    assert all(is_new(background, scene.frame(light(*px)))[round(px[1]), round(px[0])] for px in way[::7])


def test_memory_of_the_learner_does_not_grow(scene):
    learner = BackgroundLearner(Channel.LUMA, is_empty=False)
    most = 0
    for _ in range(5 * N_HELD):
        learner.add(plane_of(scene.frame()))
        most = max(most, len(learner._held))
    assert most == N_HELD


def test_a_copy_learns_for_itself(scene, background):
    other = background.copy()
    for _ in range(20 * N_ROUND):
        other.learn(plane_of(scene.frame(scale=2.0)).samples, is_hurried=True)
    assert is_new(background, scene.frame(scale=2.0)).mean() > 0.9
    assert is_new(other, scene.frame(scale=2.0)).mean() < 0.01


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_deep_samples_are_learnt_in_their_own_scale(bits):
    rng = np.random.default_rng(5)
    full = 2**bits - 1
    planes = [
        channel_of(
            Scene().of(np.rint(rng.normal(0.2 * full, 0.01 * full, (64, 70))).astype(np.uint16), bits=bits),
            Channel.LUMA,
        )
        for _ in range(40)
    ]
    learner = BackgroundLearner(Channel.LUMA, is_empty=True)
    for plane in planes[:30]:
        learner.add(plane)
    background = learner.background()
    assert background.mean.mean() / full == pytest.approx(0.2, abs=0.001)
    # 5.5 spreads and some above the mean, on the scale of the samples.
    assert 0.25 < background.threshold.mean() / full < 0.30
    assert not any((plane.samples > background.threshold).any() for plane in planes[30:])


def test_packed_threshold_is_out_of_reach_in_other_channels():
    mean = np.full((32, 40), 50, np.float32)
    maximum = np.full((32, 40), 60, np.uint8)
    background = Background(
        Channel.RED, mean=mean, spread=np.ones_like(mean), maximum=maximum, full_scale=255.0, lane=2, n_lanes=3
    )
    packed = background.packed_threshold.reshape(32, 40, 3)
    assert (packed[:, :, :2] == 255).all()
    np.testing.assert_array_equal(packed[:, :, 2], background.threshold)
    assert (background.threshold < 100).all()
