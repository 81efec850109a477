"""Equation 9 on simulated scans: the ball is found, nothing else is, and range and bearing err as their sigmas say."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from lrf_stereo.noise import LrfNoise
from lrf_stereo.scan_spot import (
    AdaptiveThreshold,
    Background,
    ConstantThreshold,
    SpotCandidates,
    find_spots,
    ranges_m,
)
from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import LrfScene, paper_scene, spots_on_plane
from lrf_stereo.synthetic_scans import Capsule, ScannedRoom
from network_calib.errors import InputError
from network_calib.observations import FloatArray

STEPS = ScanSteps()
TILT = float(np.radians(23.2))
N_BALLS = 600


@dataclass(frozen=True, slots=True)
class Setup:
    """A scanned room and its background, learnt from thirty scans."""

    scene: LrfScene
    room: ScannedRoom
    background: Background

    def scan(self, bodies=(), *, rng) -> FloatArray:
        return ranges_m(self.room.readings_mm(TILT, bodies, rng=rng), steps=STEPS)


@pytest.fixture(scope="module")
def setup() -> Setup:
    rng = np.random.default_rng(1)
    scene = paper_scene(rng=rng)
    room = ScannedRoom.of(scene, rng=rng)
    empty = np.stack([ranges_m(room.readings_mm(TILT, rng=rng), steps=STEPS) for _ in range(30)])
    return Setup(scene, room, Background.learn(empty))


@dataclass(frozen=True, slots=True)
class Found:
    """The best candidate for each of N_BALLS balls, cut by the plane within 0.8 of their radius; NaN where none."""

    range_m: FloatArray
    range_error_m: FloatArray
    sigma_range_m: FloatArray
    bearing_error_rad: FloatArray
    sigma_bearing_rad: FloatArray

    @property
    def is_found(self):
        return np.isfinite(self.range_error_m)

    @property
    def is_whole(self):
        """Found, and not mixed with what is behind; a mixed range is off by decimetres."""
        return self.is_found & (np.abs(self.range_error_m) < 0.05)


@pytest.fixture(scope="module")
def found(setup) -> Found:
    rng = np.random.default_rng(2)
    scanner = setup.scene.scanner
    feet = spots_on_plane(setup.scene.cameras, scanner, TILT, N_BALLS, room=setup.scene.room, rng=rng)
    up = scanner.world_from_lrf_at(TILT).rotation.as_matrix()[:, 2]
    true_range, true_bearing, _ = scanner.measure(feet, TILT)
    rows = np.full((N_BALLS, 4), np.nan)
    for k, foot in enumerate(feet):
        ball = Capsule.ball(foot + rng.uniform(-0.016, 0.016) * up)
        seen = find_spots(setup.scan([ball], rng=rng)[None], setup.background, steps=STEPS)
        if len(seen):
            best = int(np.argmax(seen.score))
            rows[k] = [
                seen.range_m[best],
                seen.sigma_range_m[best],
                seen.bearing_rad[best],
                seen.sigma_bearing_rad[best],
            ]
    return Found(true_range, rows[:, 0] - true_range, rows[:, 1], rows[:, 2] - true_bearing, rows[:, 3])


# Readings and background


def test_error_codes_and_what_is_out_of_reach_are_no_ranges():
    readings = np.array([[0, 1, 6, 7, 10, 18, 19], [20, 1000, 5600, 5601, 0, 19, 20]])
    ranges = ranges_m(readings, steps=STEPS)
    assert np.isnan(ranges[0]).all()
    np.testing.assert_allclose(ranges[1], [0.02, 1.0, 5.6, np.nan, np.nan, np.nan, 0.02], rtol=1e-15)


def test_background_is_robust_to_a_passer_by_and_to_dropouts():
    rng = np.random.default_rng(0)
    scans = 3.0 + 4e-3 * rng.standard_normal((40, 5))
    scans[:12] = 1.0
    scans[::5] = np.nan
    background = Background.learn(scans)
    # The median of 22 good and 10 near readings is at the 27 % point of the good ones: 0.6 sigma low, give or take 0.3.
    np.testing.assert_allclose(background.range_m, 3.0, atol=2.5 * 4e-3)


def test_background_of_a_beam_on_an_edge_spans_both_depths():
    scans = np.full((30, 2), 3.0)
    scans[::5, 0] = 2.0
    background = Background.learn(scans)
    # One reading in five is 1 m nearer: the 5 % point lies there, 1.645 standard deviations away.
    assert background.sigma_m[0] == pytest.approx(1 / 1.645)
    assert background.sigma_m[1] == pytest.approx(LrfNoise().range_m(3.0))


def test_a_beam_without_background_sees_everything_as_new():
    scans = np.full((30, 3), 3.0)
    scans[3:, 1] = np.nan
    background = Background.learn(scans)
    assert np.isinf(background.range_m[1])
    ranges = np.array([[3.0, 5.0, 3.0], [np.nan, np.nan, np.nan]])
    np.testing.assert_array_equal(
        AdaptiveThreshold().is_foreground(ranges, background), [[False, True, False], [False, False, False]]
    )


def test_a_wall_at_the_limit_of_the_reach_is_no_spot_when_it_comes():
    rng = np.random.default_rng(3)
    wall_m, share = 5.55, 0.1

    def scans(n):
        noisy = wall_m + LrfNoise().range_m(np.array(wall_m)) * rng.standard_normal((n, STEPS.n_measured))
        return np.where(rng.random(noisy.shape) < share, noisy, np.nan)

    background = Background.learn(scans(20))
    later = scans(200)
    is_new = AdaptiveThreshold().is_foreground(later, background)
    # Without any background every range that comes would be new: 10 % of all. Of 340 expected ranges around a beam the
    # median is known to a tenth of a reading's sigma, so that five sigma leave next to none.
    assert is_new.mean() < 1e-3 * share
    ball = np.full((1, STEPS.n_measured), 3.0)
    assert AdaptiveThreshold().is_foreground(ball, background).all()


def test_a_background_of_few_scans_is_refused():
    with pytest.raises(InputError, match="got 4"):
        Background.learn(np.ones((4, 10)))


def test_the_papers_threshold_is_symmetric_and_constant():
    background = Background(np.full(4, 3.0), np.full(4, 0.004))
    ranges = np.array([[2.9, 3.1, 2.95, np.nan]])
    np.testing.assert_array_equal(
        ConstantThreshold(0.1 - 1e-9).is_foreground(ranges, background), [[True, True, False, False]]
    )


# Finding


def test_empty_scans_have_no_spot(setup):
    rng = np.random.default_rng(3)
    scans = np.stack([setup.scan(rng=rng) for _ in range(200)])
    # 200 x 440 beams at 5 sigma, one-sided 2.9e-7 each: 0.03 false beams are expected.
    assert len(find_spots(scans, setup.background, steps=STEPS)) <= 1


def test_the_papers_constant_fails_where_the_adaptive_threshold_does_not(setup):
    rng = np.random.default_rng(3)
    scans = np.stack([setup.scan(rng=rng) for _ in range(100)])
    # A constant that is five sigma at 1 m is 2.5 sigma at 5 m: one beam in a hundred there, where empty scans of the
    # adaptive threshold have none.
    constant = ConstantThreshold(5 * float(LrfNoise().range_m(1.0)))
    assert len(find_spots(scans, setup.background, steps=STEPS, threshold=constant)) > 20


def test_the_ball_is_found(found):
    # A miss needs all of its one to seven beams to drop out (2 % each) or to be mixed: 98 % hold with a wide margin.
    assert found.is_found.mean() > 0.98
    for low, high in ((1.0, 1.7), (1.7, 2.5), (2.5, 3.5)):
        assert found.is_found[(found.range_m > low) & (found.range_m < high)].mean() > 0.97
    # Mixed with the background where the beam (10 mrad) is not much smaller than the ball's chord.
    assert found.is_whole.mean() > 0.8


def test_the_bearing_is_unbiased_and_its_sigma_is_true(found):
    error, sigma = found.bearing_error_rad[found.is_whole], found.sigma_bearing_rad[found.is_whole]
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error))
    # Four standard errors of a mean square of n numbers that are not heavier-tailed than normal ones; the sigma leaves
    # out that a hit of the edge may drop out unnoticed at the end of the ball: 20 %.
    assert np.mean((error / sigma) ** 2) < 1.2 + 4 * np.sqrt(2 / len(error)) + 0.1
    assert np.mean((error / sigma) ** 2) > 0.7
    # And it is an accuracy: below a step.
    assert error.std() < 0.5 * STEPS.step_rad


def test_the_range_is_that_of_the_centre_and_its_sigma_is_true(found):
    error, sigma = found.range_error_m[found.is_whole], found.sigma_range_m[found.is_whole]
    # The surface's mean is a model: right to a tenth of the ball's radius.
    assert abs(error.mean()) < 0.1 * 0.02
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], len(error)) / len(error)
    # The centre of the chord, where the beams hit, recedes less than the whole of it: the sigma may be 30 % too large.
    assert low / 1.3**2 < np.mean((error / sigma) ** 2) < high


def test_neighbouring_hits_are_not_counted_as_independent():
    background = Background(np.full(682, 5.0), np.full(682, 0.006))
    scan = np.full((1, 682), 5.0)
    scan[0, 300:304] = 1.5
    noise = LrfNoise()
    four = find_spots(scan, background, steps=STEPS, noise=noise)
    surface = 0.02**2 * (0.008 + 0.04 / 4)
    # Four beams: (4 + 2 (3 x 0.47 + 2 x 0.29 + 0.17)) / 16 = 0.52 of one beam's variance, not 0.25.
    assert four.sigma_range_m[0] == pytest.approx(np.sqrt(0.52 * noise.range_m(1.5) ** 2 + surface), rel=1e-6)
    assert four.n_hits[0] == 4
    assert four.bearing_rad[0] == pytest.approx(STEPS.bearing_rad(44 + 301.5), abs=1e-12)
    assert four.sigma_bearing_rad[0] == pytest.approx(STEPS.step_rad / np.sqrt(24))


def test_a_missing_neighbour_moves_the_edge_by_half_a_step_and_widens_it():
    background = Background(np.full(682, 5.0), np.full(682, 0.006))
    scan = np.full((1, 682), 5.0)
    scan[0, 300:303] = 1.5
    scan[0, 303] = np.nan
    spot = find_spots(scan, background, steps=STEPS)
    # The right edge is anywhere in (302, 304), the left one in (299, 300): the middle is at 301.25.
    assert spot.bearing_rad[0] == pytest.approx(STEPS.bearing_rad(44 + 301.25), abs=1e-12)
    assert spot.sigma_bearing_rad[0] == pytest.approx(STEPS.step_rad * np.sqrt((1 / 12 + 4 / 12) / 4))


def test_a_dropout_inside_the_ball_does_not_split_it():
    background = Background(np.full(682, 5.0), np.full(682, 0.006))
    scan = np.full((1, 682), 5.0)
    scan[0, 300:305] = 1.5
    scan[0, 302] = np.nan
    spot = find_spots(scan, background, steps=STEPS)
    assert len(spot) == 1
    assert (spot.first_beam[0], spot.n_hits[0]) == (300, 4)


def test_bodies_at_two_depths_are_two_candidates_and_the_far_one_scores_half():
    background = Background(np.full(682, 5.0), np.full(682, 0.006))
    scan = np.full((1, 682), 5.0)
    scan[0, 300:302], scan[0, 302:304] = 1.8, 2.2
    both = find_spots(scan, background, steps=STEPS)
    alone = scan.copy()
    alone[0, 300:302] = 5.0
    far = find_spots(alone, background, steps=STEPS)
    np.testing.assert_allclose(both.range_m - 0.69 * 0.02, [1.8, 2.2])
    assert both.score[1] == pytest.approx(far.score[0] / 2)


def test_an_arm_is_too_wide_and_the_ball_beside_it_is_kept(setup):
    rng = np.random.default_rng(5)
    scanner = setup.scene.scanner
    up = scanner.world_from_lrf_at(TILT).rotation.as_matrix()[:, 2]
    centre = scanner.points_in_world(1.8, 0.1, TILT)
    # A forearm of 80 mm, upright in the plane, 25 cm beside the ball: 7.2 steps wide, where a ball has 3.6 at most.
    elbow = scanner.points_in_world(1.8, -0.04, TILT)
    arm = Capsule(elbow - 0.15 * up, elbow + 0.15 * up, 0.04)
    scans = np.stack([setup.scan([Capsule.ball(centre), arm], rng=rng) for _ in range(60)])
    seen = find_spots(scans, setup.background, steps=STEPS)
    is_ball = np.abs(seen.bearing_rad - 0.1) < 0.03
    assert len(np.unique(seen.scan[is_ball])) >= 58
    best = [int(np.argmax(np.where(seen.scan == k, seen.score, -1))) for k in np.unique(seen.scan)]
    assert np.mean(is_ball[best]) > 0.9
    # Without the ball, whole forearms are never candidates: what remains are their edges.
    alone = np.stack([setup.scan([arm], rng=rng) for _ in range(60)])
    assert (find_spots(alone, setup.background, steps=STEPS).n_hits <= 4).all()


def test_no_foreground_gives_an_empty_table():
    background = Background(np.full(10, 5.0), np.full(10, 0.006))
    seen = find_spots(np.full((3, 10), 5.0), background, steps=STEPS)
    assert isinstance(seen, SpotCandidates)
    assert len(seen) == 0
