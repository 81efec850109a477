import numpy as np
import pytest

from nodes.detection.background_learner import BackgroundLearner
from nodes.detection.candidates import Candidate, CandidateFinder
from nodes.detection.channel import channel_of
from nodes.detection.channel_choice import N_VOTES, ChannelChoice
from nodes.detection.dwelling import Dwelling
from nodes.detection.fixtures import N_FRAMES, Fixtures
from nodes.detection.peaks import PeakFinder
from nodes.detection.ranking import DWELLING_FACTOR, ranked
from nodes.detection.spots import Channel
from nodes.frames import PixelFormat
from tests.nodes.detection.small_scene import HEIGHT, WIDTH, Scene, light

MAX_RADIUS = 24.0


class Watched:
    """A scene whose background is known."""

    def __init__(self, level=60.0):
        self.scene = Scene(level=level)
        learner = BackgroundLearner(Channel.LUMA, is_empty=True)
        for _ in range(30):
            learner.add(channel_of(self.scene.frame(), Channel.LUMA))
        self.background = learner.background()

    def find(self, *lights, scale=1.0):
        plane = channel_of(self.scene.frame(*lights, scale=scale), Channel.LUMA)
        finder = CandidateFinder(plane, max_radius=MAX_RADIUS)
        return finder.find(plane, self.background, self.background.survey(plane.samples))


@pytest.fixture(scope="module")
def watched():
    return Watched()


def near(candidate, x, y, within=1.0):
    return np.hypot(*(candidate.px - [x, y])) < within


def streak(x, *, width=1.2, peak=40.0):
    columns = np.arange(WIDTH)
    return np.tile(peak * np.exp(-((columns - x) ** 2) / (2 * width**2)), (HEIGHT, 1))


def smear(start, end, **options):
    return np.mean([light(*px, **options) for px in np.linspace(start, end, 40)], axis=0)


@pytest.mark.parametrize("px", [(100.3, 80.7), (0.4, 100.0), (319.0, 239.0), (159.5, 127.5), (8.0, 8.0)])
@pytest.mark.parametrize("width", [0.8, 1.6, 6.0])
def test_a_spot_is_the_only_candidate_wherever_it_is(watched, px, width):
    found = watched.find(light(*px, width=width))
    assert len([one for one in found if one.score > 0.1]) == 1
    assert near(found[0], *px, within=0.5 + 0.75 * width)
    # Half the width at half height is 1.18 standard deviations; pixels add to small ones, the border cuts.
    if 20 < px[0] < 300:
        assert found[0].radius == pytest.approx(1.18 * np.hypot(width, 0.3), rel=0.25)


def test_nothing_is_found_in_the_empty_scene(watched):
    assert [watched.find() for _ in range(20)] == [[]] * 20


def test_dim_and_saturated_spots_are_found(watched):
    dim, bright = watched.find(light(50, 50, peak=18.0)), watched.find(light(50, 50, width=3.0, peak=900.0))
    assert near(dim[0], 50, 50)
    assert near(bright[0], 50, 50)
    assert dim[0].score < bright[0].score


def test_a_moving_person_is_no_candidate_but_the_spot_in_front_is(watched):
    person = ((100, 60, 170, 240), 130.0)
    assert not any(one.score > 0.1 for one in watched.find(person))
    found = watched.find(person, light(150, 130, peak=110.0))
    assert near(found[0], 150, 130)


def test_a_dim_spot_before_a_dark_person_before_a_bright_wall_is_found():
    # Darker than the wall was: no threshold that was learnt on the wall can tell.
    watched = Watched(level=150.0)
    person = ((100, 40, 180, 240), 30.0)
    found = watched.find(person, light(150, 130, peak=90.0))
    assert near(found[0], 150, 130)
    assert not any(one.score > 0.1 for one in watched.find(person))


@pytest.mark.parametrize("shape", [(HEIGHT - 8, WIDTH - 8), (HEIGHT - 7, WIDTH - 3), (HEIGHT - 15, WIDTH - 11)])
def test_any_size_will_do(shape):
    scene = Scene(level=150.0)

    def plane_of(*lights):
        return channel_of(scene.of(scene.frame(*lights).image[: shape[0], : shape[1]]), Channel.LUMA)

    learner = BackgroundLearner(Channel.LUMA, is_empty=True)
    for _ in range(30):
        learner.add(plane_of())
    background = learner.background()
    person = ((200, 100, WIDTH, HEIGHT), 30.0)
    x, y = shape[1] - 20, shape[0] - 12
    plane = plane_of(person, light(x, y, peak=90.0))
    found = CandidateFinder(plane, max_radius=MAX_RADIUS).find(plane, background, background.survey(plane.samples))
    assert near(found[0], x, y)
    background.learn(plane.samples)


def test_a_reflection_is_kept_behind_the_spot(watched):
    found = watched.find(light(150, 80, peak=150.0), light(155, 180, width=3.0, peak=30.0))
    assert near(found[0], 150, 80)
    assert near(found[1], 155, 180, within=1.5)
    scores = [score for score, _ in ranked(found, Dwelling((HEIGHT, WIDTH)))]
    assert 0 < scores[1] < 0.5 * scores[0]


@pytest.mark.parametrize("peak", [40.0, 150.0])
def test_a_blooming_streak_is_no_candidate_but_its_spot_is(watched, peak):
    found = watched.find(light(150, 100, width=2.0, peak=400.0) + streak(150, peak=peak))
    assert near(found[0], 150, 100)
    assert not any(one.score > 0.1 for one in found[1:])


@pytest.mark.parametrize("end", [(190, 80), (150, 120), (178, 108)])
def test_a_smeared_spot_is_found_with_its_length(watched, end):
    found = watched.find(smear((150, 80), end, peak=250.0))
    assert near(found[0], *(np.add((150, 80), end) / 2), within=2.0)
    # Second moments of a line of length L are those of an ellipse of half length L / sqrt(3), and of its ends' blur.
    assert found[0].length == pytest.approx(40 / np.sqrt(3), rel=0.2)
    assert found[0].radius < 3
    # A still spot is more of a spot.
    assert found[0].score < 0.8 * watched.find(light(150, 80))[0].score


def test_a_single_hot_pixel_has_a_low_score(watched):
    hot = np.zeros((HEIGHT, WIDTH))
    hot[70, 90] = 120.0
    found = watched.find(hot, light(200, 150, peak=60.0))
    assert near(found[0], 200, 150)
    assert all(one.score < 0.1 for one in found[1:])


def test_what_is_larger_than_a_spot_may_be_is_no_candidate(watched):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for radius, is_found in ((18, True), (40, False)):
        disc = 120.0 * (np.hypot(x - 160, y - 120) < radius)
        assert any(one.score > 0.1 for one in watched.find(disc)) is is_found
    assert watched.find(120.0 * (np.hypot(x - 160, y - 120) < 18))[0].score < 0.5


def test_two_spots_side_by_side_are_two(watched):
    found = watched.find(light(100, 100), light(112, 100))
    assert sorted(round(one.px[0]) for one in found) == [100, 112]


def test_peaks_are_found_in_a_packed_channel_of_odd_width():
    scene = Scene()
    image = np.zeros((100, 101, 3), np.uint8)
    image[37, 83] = [10, 20, 200]
    image[99, 100] = [10, 20, 150]
    image[50, 50] = [255, 255, 90]
    plane = channel_of(scene.of(image, PixelFormat.BGR), Channel.RED)
    threshold = np.full((100, 101, 3), 255, np.uint8)
    threshold[:, :, 2] = 100
    finder = PeakFinder(plane, max_width=10)
    assert list(finder.peaks(plane, threshold.reshape(100, -1))) == [(83, 37), (100, 99)]


def test_a_small_peak_goes_before_a_wide_plateau():
    image = np.zeros((200, 200), np.uint8)
    image[40:180, 40:180] = 150
    image[10, 190] = 60
    plane = channel_of(Scene().of(image), Channel.LUMA)
    peaks = list(PeakFinder(plane, max_width=48).peaks(plane, np.full_like(image, 20)))
    assert peaks[0] == (190, 10)
    assert len(peaks) < 10


def test_what_stands_perfectly_still_for_long_is_a_fixture_and_what_a_hand_holds_is_not():
    rng = np.random.default_rng(2)
    fixtures = Fixtures()
    lamp, hand = np.array([50.0, 60.0]), np.array([90.0, 20.0])
    for k in range(N_FRAMES + 20):
        hand = hand + rng.normal(0, 0.1, 2)
        is_fixture = fixtures.note([hand, lamp + rng.normal(0, 0.05, 2)])
        assert is_fixture == (frozenset({1}) if k >= N_FRAMES else frozenset())
    for _ in range(2 * N_FRAMES):
        fixtures.note([])
    assert fixtures.note([lamp]) == frozenset()


def test_a_place_that_is_always_bright_loses_rank_but_is_kept():
    still, moving = _candidate(50.0, 50.0), _candidate(20.0, 20.0)
    dwelling = Dwelling((100, 3000))
    assert ranked([still], dwelling)[0][0] == pytest.approx(still.score)
    for k in range(1000):
        dwelling.note([still.px, np.array([20.0 + 2.5 * k, 20.0])])
    order = ranked([still, moving], dwelling)
    assert [one.px[0] for _, one in order] == [20.0, 50.0]
    assert order[1][0] == pytest.approx(DWELLING_FACTOR * still.score)
    assert order[0][0] == pytest.approx(moving.score)


def test_a_place_is_fresh_again_after_a_while():
    dwelling = Dwelling((100, 100))
    for _ in range(500):
        dwelling.note([np.array([50.0, 50.0])])
    before = dwelling.share(np.array([50.0, 50.0]))
    for _ in range(750):
        dwelling.note([])
    # Three time constants: a twentieth is left.
    assert before > 0.8
    assert dwelling.share(np.array([50.0, 50.0])) == pytest.approx(before * np.exp(-3), rel=1e-9)


def test_the_channel_is_chosen_by_the_spot_not_by_people_or_one_screen():
    choice = ChannelChoice(3)
    screen = _candidate(200.0, 50.0, snr=60.0)
    for k in range(40):
        person = [_candidate(30.0 * k, 30.0, snr=snr) for snr in (1000.0, 900.0, 850.0)]
        assert choice.vote([[one] for one in person]) is None
        assert choice.vote([[screen], [], []]) is None
    chosen = [
        choice.vote([[_candidate(40.0 * k, 100.0, snr=30.0)], [_candidate(40.0 * k, 100.0, snr=100.0)], []])
        for k in range(N_VOTES)
    ]
    assert chosen[0] is None
    assert chosen[-1] == 1


def test_a_handicapped_channel_must_be_that_much_better():
    def vote(times):
        choice = ChannelChoice(2, advantage=2.0)
        votes = [
            choice.vote([[_candidate(40.0 * k, 9.0, snr=50.0)], [_candidate(40.0 * k, 9.0, snr=50.0 * times)]])
            for k in range(2 * N_VOTES)
        ]
        return next(one for one in votes if one is not None)

    assert vote(1.2) == 0
    assert vote(4.0) == 1


def _candidate(x, y, *, snr=100.0):
    return Candidate(
        px=np.array([x, y]),
        box=(int(x) - 2, int(y) - 2, int(x) + 3, int(y) + 3),
        radius=2.0,
        length=2.0,
        height=100.0,
        flux=1000.0,
        snr=snr,
        score=0.8,
    )
