from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network_calib.errors import InputError
from nodes.detection.candidates import Candidate
from nodes.detection.spots import AdviceKind, Channel, DetectorOptions, DetectorState
from nodes.frames import FrameSettings, PixelFormat
from nodes.spot_detector import N_RELEARNING_FRAMES, SpotDetector, learn_from
from tests.nodes.detection.small_scene import HEIGHT, WIDTH, Scene, light

N_LEARNING = 30


def way(k):
    """A place for the spot in frame k: 4 px a frame, all over the picture."""
    return 160 + 130 * np.cos(0.031 * k), 120 + 90 * np.sin(0.043 * k)


def taught(scene, **options):
    """A detector that knows the empty scene."""
    detector = SpotDetector(DetectorOptions(n_learning_frames=N_LEARNING, **options))
    for _ in range(N_LEARNING):
        assert detector.process(scene.frame()).state is DetectorState.LEARNING
    return detector


def is_at(seen, px, within=0.3):
    return bool(seen.spots) and np.hypot(*(seen.spots[0].px - px)) < within


@pytest.fixture
def scene():
    return Scene()


def test_the_moving_spot_is_found_in_every_frame_with_its_uncertainty(scene):
    detector = taught(scene)
    pulls = []
    for k in range(200):
        frame = scene.frame(light(*way(k)))
        seen = detector.process(frame)
        assert (seen.sequence, seen.stamp_ns) == (frame.sequence, frame.stamp_ns)
        assert seen.state is DetectorState.WATCHING
        assert len(seen.spots) == 1
        difference = seen.spots[0].px - way(k)
        pulls.append(difference @ np.linalg.solve(seen.spots[0].covariance_px2, difference))
    # chi² with two degrees of freedom has the mean 2; over 200 frames its mean has a deviation of 0.14. The sampled
    # Gaussian is no integrated one, and noise is estimated: 0.7 to 1.5 times that.
    assert 1.4 < np.mean(pulls) < 3.0


def test_spots_stand_in_full_scales_and_pixels(scene):
    (spot,) = taught(scene).process(scene.frame(light(100, 80, width=2.0, peak=102.0))).spots
    # Pixels blur by 1/12 px²: the fit sees the profile without.
    assert spot.peak == pytest.approx(0.4, rel=0.1)
    assert spot.width_px == pytest.approx(2.0, rel=0.1)
    assert spot.smear_px == 0
    assert not spot.is_saturated
    assert 0.5 < spot.score <= 1


def test_the_spot_is_not_learnt_though_it_stays(scene):
    detector = taught(scene)
    for _ in range(400):
        assert is_at(detector.process(scene.frame(light(150, 120, peak=60.0))), (150, 120))
    # And the place is clean when it moves on.
    assert detector.process(scene.frame()).spots == ()


def test_lamps_screens_people_drift_and_the_spot(scene):
    detector = SpotDetector(DetectorOptions(n_learning_frames=N_LEARNING))
    lamp, screen = light(60, 50, width=4, peak=500.0), (260, 180, 300, 210)
    for k in range(N_LEARNING):
        detector.process(scene.frame(lamp, (screen, 100.0 if k % 3 else 180.0)))
    n_looked = n_found = n_other = 0
    for k in range(300):
        person = ((2 * k % 260, 90, 2 * k % 260 + 45, 240), 110.0)
        seen = detector.process(
            scene.frame(person, (screen, 100.0 if k % 3 else 180.0), lamp, light(*way(k)), scale=1 + 0.2 * k / 300)
        )
        if np.hypot(way(k)[0] - 60, way(k)[1] - 50) < 25 or (abs(way(k)[0] - 280) < 25 and way(k)[1] > 170):
            continue
        n_looked += 1
        n_found += is_at(seen, way(k), within=1.0)
        n_other += any(one.score > 0.2 and np.hypot(*(one.px - way(k))) > 3 for one in seen.spots)
    # On the very edge of the person, half of the spot's light is before another level: a few frames are worse.
    assert n_looked > 200
    assert n_found >= 0.97 * n_looked
    assert n_other <= 0.04 * n_looked


def test_a_light_switched_on_costs_less_than_a_second(scene):
    detector = taught(scene)
    for k in range(20):
        detector.process(scene.frame(light(*way(k))))
    states = []
    for k in range(20, 120):
        seen = detector.process(scene.frame(light(*way(k)), scale=2.0))
        states.append(seen.state)
        # None of the first frames tells of spots that are the light.
        assert len(seen.spots) <= 1
        if k > 20 + N_RELEARNING_FRAMES + 2:
            assert is_at(seen, way(k))
    # One frame of doubt, then half a second of learning at 25 Hz.
    assert states.count(DetectorState.RELEARNING) == N_RELEARNING_FRAMES
    assert states[1] is DetectorState.RELEARNING
    assert states[-1] is DetectorState.WATCHING


def test_where_the_spot_rested_while_the_light_changed_it_is_found_again_soon(scene):
    detector = taught(scene)
    for _ in range(N_RELEARNING_FRAMES + 2):
        detector.process(scene.frame(light(100, 100), scale=2.0))
    # Twice as many as a second holds; without any haste, each row would have been visited twice.
    for k in range(60):
        detector.process(scene.frame(light(*way(k)), scale=2.0))
    assert is_at(detector.process(scene.frame(light(100, 100), scale=2.0)), (100, 100))


def test_one_flash_is_no_new_light(scene):
    detector = taught(scene)
    assert detector.process(scene.frame(light(*way(2)), scale=2.5)).spots == ()
    seen = detector.process(scene.frame(light(*way(3))))
    assert seen.state is DetectorState.WATCHING
    assert is_at(seen, way(3))


def test_nothing_is_found_outside_of_the_mask(scene):
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, :160] = False
    detector = taught(scene, mask=mask)
    both = scene.frame(light(100, 80, peak=180.0), light(200, 80, peak=60.0))
    assert [round(one.px[0]) for one in detector.process(both).spots] == [200]


def test_a_mask_of_another_size_is_refused(scene):
    with pytest.raises(InputError, match="320 x 100"):
        taught(scene, mask=np.ones((100, WIDTH), bool))


def test_one_spot_behind_a_wire_is_one(scene):
    spot = light(150, 120, width=5.0, peak=120.0)
    spot[120] = 0
    assert len(taught(scene).process(scene.frame(spot)).spots) == 1


def test_at_most_so_many_candidates_best_first(scene):
    frame = scene.frame(*[light(40 + 50 * k, 100, peak=60 + 20 * k) for k in range(5)])
    seen = taught(scene, max_candidates=3).process(frame)
    assert len(seen.spots) == 3
    scores = [one.score for one in seen.spots]
    assert scores == sorted(scores, reverse=True)


@pytest.mark.parametrize("pixel_format", [PixelFormat.BAYER_RGGB, PixelFormat.BAYER_GBRG])
@pytest.mark.parametrize("channel", [Channel.RED, Channel.GREEN, Channel.LUMA])
def test_spots_of_a_bayer_mosaic_are_in_pixels_of_the_image(scene, pixel_format, channel):
    detector = SpotDetector(DetectorOptions(channel=channel, n_learning_frames=N_LEARNING))
    for _ in range(N_LEARNING):
        detector.process(replace(scene.frame(), pixel_format=pixel_format))
    for px in ((100.3, 80.6), (201.0, 121.0)):
        (spot,) = detector.process(replace(scene.frame(light(*px, width=3.0)), pixel_format=pixel_format)).spots
        # Half of the samples, or their sums: some hundredths of a pixel of noise; a wrong origin is off by 0.5.
        assert np.abs(spot.px - px).max() < 0.2
        assert spot.width_px == pytest.approx(3.0, rel=0.1)


def test_deep_samples_and_decoded_video_are_read_as_they_come(scene):
    def deep(spot):
        return scene.of(16 * scene.frame(spot).image.astype(np.uint16), bits=12)

    def video(spot):
        # Grey chroma: every channel is luma.
        luma = scene.frame(spot).image
        return scene.of(np.vstack([luma, np.full((HEIGHT // 2, WIDTH), 128, np.uint8)]), PixelFormat.YUV420)

    for make, channel in ((deep, Channel.LUMA), (video, Channel.LUMA), (video, Channel.RED)):
        detector = SpotDetector(DetectorOptions(channel=channel, n_learning_frames=N_LEARNING))
        for _ in range(N_LEARNING):
            detector.process(make(np.zeros((HEIGHT, WIDTH))))
        for k in range(10):
            seen = detector.process(make(light(*way(k), peak=102.0)))
            assert is_at(seen, way(k))
            # 102 counts of 255; video's full scale is 235 in luma, and red is stretched from 219 to 255.
            assert 0.35 < seen.spots[0].peak < 0.55


@pytest.mark.parametrize(("colour", "channel"), [((30, 30, 150), Channel.RED), ((40, 150, 30), Channel.GREEN)])
def test_auto_takes_the_colour_of_the_spot(scene, colour, channel):
    def coloured(spot):
        image = np.dstack([scene.frame(spot * share / 150).image for share in colour])
        return scene.of(image, PixelFormat.BGR)

    detector = SpotDetector(DetectorOptions(n_learning_frames=N_LEARNING))
    for _ in range(N_LEARNING):
        detector.process(coloured(np.zeros((HEIGHT, WIDTH))))
    assert len(detector.channels) == 3
    for k in range(200):
        assert is_at(detector.process(coloured(light(*way(k)))), way(k))
    assert detector.channels == (channel,)


def test_a_whole_recording_is_learnt_first_and_then_watched_from_its_begin(scene):
    frames = [scene.frame(light(*way(7 * k))) for k in range(200)]
    backgrounds = learn_from(frames, DetectorOptions(channel=Channel.LUMA))
    detector = SpotDetector(DetectorOptions(channel=Channel.LUMA, n_learning_frames=0), backgrounds=backgrounds)
    seen = [detector.process(frame) for frame in frames]
    assert all(one.state is DetectorState.WATCHING for one in seen)
    n_found = sum(is_at(one, way(7 * k)) for k, one in enumerate(seen))
    assert n_found == 200
    with pytest.raises(InputError, match="no frame"):
        learn_from([])


def test_what_one_detector_learnt_serves_another_and_is_not_changed_by_it(scene):
    first = taught(scene)
    learnt = first.learnt()
    threshold = learnt[0].threshold.copy()
    second = SpotDetector(backgrounds=learnt)
    for k in range(120):
        assert is_at(second.process(scene.frame(light(*way(k)), scale=1 + 0.001 * k)), way(k))
    assert (second.learnt()[0].threshold != threshold).mean() > 0.5
    np.testing.assert_array_equal(learnt[0].threshold, threshold)
    with pytest.raises(InputError, match="320 x 240"):
        SpotDetector(backgrounds=learnt).process(scene.of(np.zeros((100, 200), np.uint8)))


def test_no_background_and_no_frames_to_learn_it_is_refused():
    with pytest.raises(InputError, match="n_learning_frames"):
        SpotDetector(DetectorOptions(n_learning_frames=0))


def test_relearning_on_demand(scene):
    detector = taught(scene)
    lamp = light(250, 60, width=3.0, peak=150.0)
    for _ in range(5):
        assert is_at(detector.process(scene.frame(lamp)), (250, 60))
    detector.relearn()
    states = [detector.process(scene.frame(lamp, light(*way(k)))).state for k in range(N_LEARNING)]
    assert set(states) == {DetectorState.LEARNING}
    for k in range(N_LEARNING, N_LEARNING + 20):
        assert is_at(detector.process(scene.frame(lamp, light(*way(k)))), way(k))


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH + 2), (HEIGHT, WIDTH, 3)])
def test_another_size_or_format_is_refused_with_both(scene, shape):
    detector = taught(scene)
    pixel_format = PixelFormat.MONO if len(shape) == 2 else PixelFormat.BGR
    with pytest.raises(InputError, match="320 x 240 px mono with 8 bits") as refusal:
        detector.process(scene.of(np.zeros(shape, np.uint8), pixel_format))
    assert f"{shape[1]} x {shape[0]} px {pixel_format}" in refusal.value.message


def test_same_frames_give_the_same_spots():
    def run():
        scene = Scene(seed=4)
        detector = taught(scene)
        frames = [scene.frame(light(*way(k)), ((50, 90, 90, 240), 100.0)) for k in range(60)]
        return [detector.process(frame) for frame in frames]

    for first, second in zip(run(), run(), strict=True):
        assert len(first.spots) == len(second.spots)
        for one, other in zip(first.spots, second.spots, strict=True):
            assert (one.score, one.peak, one.width_px) == (other.score, other.peak, other.width_px)
            np.testing.assert_array_equal(one.px, other.px)
            np.testing.assert_array_equal(one.covariance_px2, other.covariance_px2)


def test_advice_comes_from_the_frames(scene):
    detector = taught(scene)
    for k in range(60):
        frame = replace(scene.frame(light(*way(k), peak=600.0)), settings=FrameSettings(exposure_s=0.01))
        detector.process(frame)
    assert [one.kind for one in detector.advice()] == [AdviceKind.SATURATED]
    for _ in range(130):
        detector.process(scene.frame())
    assert AdviceKind.NOTHING_SEEN in [one.kind for one in detector.advice()]


@pytest.fixture(scope="module")
def watching():
    scene = Scene(seed=9)
    return scene, taught(scene).learnt()


@settings(max_examples=40)
@given(st.floats(0, WIDTH - 1), st.floats(0, HEIGHT - 1), st.floats(0.7, 4.0), st.floats(30, 160))
def test_any_spot_is_found_where_it_is(watching, x, y, width, peak):
    scene, learnt = watching
    seen = SpotDetector(backgrounds=learnt).process(scene.frame(light(x, y, width=width, peak=peak)))
    assert seen.spots
    # Six of its own standard deviations, and what sampling instead of integrating a narrow Gaussian shifts.
    assert np.hypot(*(seen.spots[0].px - [x, y])) < 0.1 + 6 * seen.spots[0].sigma_px


def test_before_a_plain_person_the_pattern_behind_does_not_pull_the_spot(scene):
    # Every 6 px a step of 60: learnt, and hidden now.
    scene.background = 60.0 + 60.0 * (np.arange(WIDTH) // 6 % 2) + np.zeros((HEIGHT, 1))
    detector = taught(scene)
    for k in range(12):
        px = 150.3 + k, 130.2
        assert is_at(detector.process(scene.frame(((110, 60, 200, 240), 70.0), light(*px, peak=170.0))), px, within=0.1)


def test_a_fit_that_strays_to_something_else_is_not_taken(scene):
    detector = taught(scene)
    (watch,) = detector._watches
    plane = watch.read(scene.frame(light(105, 80)))
    elsewhere = Candidate(np.array([100.0, 80.0]), (99, 79, 102, 82), 1.5, 1.5, 50.0, 300.0, 50.0, 0.5)
    spot = watch.spot(plane, elsewhere, 0.5)
    np.testing.assert_array_equal(spot.px, [100, 80])
    # Vague and less of a spot than it was before the fit.
    assert spot.sigma_px > 0.3
    assert spot.score < 0.5


def test_spots_of_a_mosaic_are_as_uncertain_as_they_say(scene):
    detector = SpotDetector(DetectorOptions(channel=Channel.RED, n_learning_frames=N_LEARNING))
    for _ in range(N_LEARNING):
        detector.process(replace(scene.frame(), pixel_format=PixelFormat.BAYER_RGGB))
    pulls = []
    for k in range(100):
        frame = scene.frame(light(*way(k), width=3.0, peak=60.0))
        (spot,) = detector.process(replace(frame, pixel_format=PixelFormat.BAYER_RGGB)).spots
        pulls.append((spot.px - way(k)) @ np.linalg.solve(spot.covariance_px2, spot.px - way(k)))
    # As above, of half as many frames; a covariance in samples instead of pixels would give 8.
    assert 1.2 < np.mean(pulls) < 3.5
