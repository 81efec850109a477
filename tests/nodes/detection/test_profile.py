import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.detection.noise_model import NoiseModel
from nodes.detection.profile import localise
from nodes.detection.profile_models import MovingSpot, StillSpot

READ_SIGMA, BACKGROUND = 2.0, 20.0
NOISE = NoiseModel(READ_SIGMA**2, 0.0)
UNLIMITED = 1e9


@dataclass(frozen=True)
class Truth:
    """A spot that is summed over 8 x 8 points of each pixel, points of its way and of its disc; no error functions."""

    x: float
    y: float
    width: float
    peak: float
    half: float = 0.0
    angle: float = 0.0
    ball: float = 0.0
    shape: tuple[int, int] = (21, 21)
    gain: float = 0.0
    full_scale: float = UNLIMITED

    @property
    def px(self):
        return np.array([self.x, self.y])

    @property
    def axes(self):
        c, s = math.cos(self.angle), math.sin(self.angle)
        return np.array([[c, s], [-s, c]]) if self.half else np.eye(2)

    def light(self):
        centred = replace(self, x=0.0, y=0.0, shape=(1, 1))
        return self.peak * self._profile() / centred._profile()[0, 0]

    def window(self, rng):
        light = self.light()
        if self.gain:
            light = rng.poisson(light / self.gain) * self.gain
        noisy = light + BACKGROUND + rng.normal(0, READ_SIGMA, self.shape)
        return np.minimum(np.round(noisy), self.full_scale)

    def bound(self):
        """Covariance of Cramer and Rao along the axes, by numeric derivatives; full samples tell nothing."""
        names = ["x", "y", "width", "peak", *(("half", "angle") if self.half else ())]
        columns = [np.ones(self.shape)]
        for name in names:
            above, below = (replace(self, **{name: getattr(self, name) + d}).light() for d in (1e-3, -1e-3))
            columns.insert(-1, (above - below) / 2e-3)
        jacobian, light = np.array(columns).reshape(len(columns), -1), self.light().ravel()
        weight = (light + BACKGROUND < self.full_scale) / (READ_SIGMA**2 + 1 / 12 + self.gain * light)
        return self.axes @ np.linalg.inv((jacobian * weight) @ jacobian.T)[:2, :2] @ self.axes.T

    def _profile(self):
        spread = [(2 * np.arange(n) + 1) / n - 1 for n in (12, 1 + 2 * math.ceil(2 * self.half / self.width))]
        disc = np.stack(np.meshgrid(spread[0], spread[0]), axis=-1).reshape(-1, 2)
        disc = disc[(disc**2).sum(axis=1) < 1] if self.ball else np.zeros((1, 2))
        way = self.half * spread[1][:, None, None] * [math.cos(self.angle), math.sin(self.angle)]
        points = (way + self.ball * disc).reshape(-1, 2) + self.px
        across, down = (_shares(n, points[:, i], self.width) for i, n in enumerate(self.shape[::-1]))
        return down.T @ across / len(points)


def _shares(n_px, centres, width):
    fine = (np.arange(8 * n_px) + 0.5) / 8 - 0.5
    density = np.exp(-0.5 * ((fine - centres[:, None]) / width) ** 2) / (width * math.sqrt(2 * math.pi))
    return density.reshape(len(centres), n_px, 8).mean(axis=2)


@dataclass(frozen=True)
class Found:
    error: np.ndarray  # (M, 2) along the axes of the way
    stated: np.ndarray  # (M, 2) variances
    bound: np.ndarray  # (2,) variances
    localisations: list

    @property
    def over_bound(self):
        return np.sqrt((self.error**2).mean(axis=0) / self.bound)

    @property
    def stated_over_true(self):
        return np.sqrt(self.stated.mean(axis=0) / (self.error**2).mean(axis=0))


def _locate(truth, n, seed, *, noise=NOISE, spoil=lambda _: None):
    """n spots anywhere within the middle pixel, going anywhere; the bound is averaged over 16 of them."""
    rng = np.random.default_rng(seed)
    errors, stated, bounds, all_found = [], [], [], []
    for i in range(n):
        x, y = np.array(truth.shape[::-1]) // 2 + rng.uniform(-0.5, 0.5, 2)
        shown = replace(truth, x=float(x), y=float(y), angle=float(rng.uniform(0, np.pi)))
        window = shown.window(rng)
        spoil(window)
        found = localise(window, BACKGROUND, noise=noise, full_scale=truth.full_scale)
        if i < 16:
            bounds.append(shown.bound().diagonal())
        if found is not None:
            errors.append(shown.axes @ (found.px - shown.px))
            stated.append((shown.axes @ found.covariance_px2 @ shown.axes.T).diagonal())
            all_found.append(found)
    return Found(np.array(errors), np.array(stated), np.mean(bounds, axis=0), all_found)


def _found(window, *, noise=NOISE, full_scale=UNLIMITED, origin_px=(0.0, 0.0)):
    """What must be there."""
    found = localise(window, BACKGROUND, noise=noise, full_scale=full_scale, origin_px=origin_px)
    assert found is not None
    return found


def _assert_true(found, n):
    """Next to nothing lost, errors near the bound, stated standard deviations true within 15 %.

    The RMS of 500 draws is good to 1 / sqrt(2 * 500) = 3.2 %: an estimate at the bound, or a true sigma, leaves the
    band of 15 % by chance less than once in 10^5.
    """
    assert len(found.error) >= 0.98 * n
    assert found.over_bound.max() < 1.15
    assert np.abs(np.log(found.stated_over_true)).max() < math.log(1.15)


@pytest.mark.parametrize(("width", "snr"), [(0.6, 20), (1.0, 10), (1.5, 5), (1.5, 100), (3.0, 20)])
def test_error_is_near_the_bound_and_the_covariance_is_true(width, snr):
    truth = Truth(10, 10, width, snr * READ_SIGMA, shape=(25, 25) if width > 2 else (17, 17))
    _assert_true(_locate(truth, 500, 1), 500)


@pytest.mark.parametrize("gain", [1.0, None])
def test_photon_noise_with_the_gain_known_and_not(gain):
    # peak = 20 sqrt(peak + 4): SNR 20 where the spot is brightest
    found = _locate(Truth(10, 10, 1.5, 404.0, gain=1.0, shape=(17, 17)), 500, 2, noise=NoiseModel(4.0, gain))
    _assert_true(found, 500)


@pytest.mark.parametrize("width", [0.5, 0.7, 1.0, 2.0])
@pytest.mark.parametrize("ball", [0.0, 1.0, 3.0])
def test_position_within_the_pixel_does_not_bias(width, ball):
    phases = [(10 + x / 5, 10 + y / 5) for x in range(-2, 3) for y in range(-2, 3)]
    truths = [Truth(x, y, width, 200.0, ball=ball * width, shape=(25, 25)) for x, y in phases]
    noise = NoiseModel(0.01, 0.0)
    found = [_found(np.round(t.light() + 20), noise=noise, full_scale=255) for t in truths]
    errors = np.array([f.px - t.px for f, t in zip(found, truths, strict=True)])
    assert np.abs(errors).max() < 0.02


def test_ball_keeps_a_true_covariance():
    # A ball of three blurs is far from a Gaussian: at SNR 50 its misfit is twice the noise, yet alike on both sides.
    found = _locate(Truth(12, 12, 1.5, 100.0, ball=4.5, shape=(31, 31)), 500, 3)
    assert np.median([f.misfit for f in found.localisations]) > 1.3
    assert np.abs(np.log(found.stated_over_true)).max() < math.log(1.15)


def test_lopsided_spot_is_given_less_trust():
    rng = np.random.default_rng(4)
    tail = Truth(12.0, 10.0, 1.5, 60.0).light()
    window = Truth(10.0, 10.0, 1.5, 200.0).window(rng)
    clean = _found(window)
    lopsided = _found(window + tail + 30 * (tail > 40))
    assert np.trace(lopsided.covariance_px2) > 2 * np.trace(clean.covariance_px2)
    assert lopsided.misfit > 2


def test_noise_in_common_with_the_neighbours_widens_the_covariance():
    # Means over 2 x 2 white samples have a quarter of the variance, and err together over four pixels.
    rng = np.random.default_rng(18)
    truth, errors, stated = Truth(10, 10, 2.5, 30.0, shape=(25, 25)), [], []
    for _ in range(300):
        shown = replace(truth, x=float(12 + rng.uniform(-0.5, 0.5)), y=float(12 + rng.uniform(-0.5, 0.5)))
        white = rng.normal(0, READ_SIGMA, (26, 26))
        common = (white[1:, 1:] + white[:-1, 1:] + white[1:, :-1] + white[:-1, :-1]) / 4
        noise = NoiseModel(READ_SIGMA**2 / 4, 0.0, 4.0)
        found = _found(shown.light() + BACKGROUND + common, noise=noise)
        errors.append(found.px - shown.px)
        stated.append(found.covariance_px2.diagonal())
    # The spot is not very much wider than two pixels: a few per cent beside what 300 draws leave open.
    assert np.sqrt(np.mean(stated) / np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.2)


def test_noise_greater_than_stated_widens_the_covariance():
    # Stated at half of what it is: without the residuals' word the ratio would be 0.5.
    found = _locate(Truth(10, 10, 2.0, 100.0), 500, 5, noise=NoiseModel(READ_SIGMA**2 / 4, 0.0))
    assert np.abs(np.log(found.stated_over_true)).max() < math.log(1.15)


@pytest.mark.parametrize("over", [2, 5])
def test_saturated_spot_is_located_by_its_flanks(over):
    found = _locate(
        Truth(15, 15, 2.0, over * 235.0, gain=0.3, full_scale=255, shape=(31, 31)), 500, 6, noise=NoiseModel(4.0, 0.3)
    )
    _assert_true(found, 500)
    assert all(f.is_saturated for f in found.localisations)
    assert np.median([f.peak for f in found.localisations]) == pytest.approx(over * 235.0, rel=0.05)


def test_blooming_to_one_side_does_not_draw_the_position_along():
    def bloom(window):
        column = window[:, 15]
        column[np.flatnonzero(column >= 255)[-1] :][:7] = 255

    truth = Truth(15, 15, 2.0, 3 * 235.0, gain=0.3, full_scale=255, shape=(31, 31))
    found = _locate(truth, 200, 7, noise=NoiseModel(4.0, 0.3), spoil=bloom)
    # The mean of 200 draws of 0.016 px is good to 0.0011 px; charge of six samples would move a centroid by 0.9 px.
    assert np.abs(found.error.mean(axis=0)).max() < 0.006
    assert np.abs(np.log(found.stated_over_true)).max() < math.log(1.25)  # five deviations of the RMS of 200 draws


@pytest.mark.parametrize(("length", "snr"), [(5, 20), (10, 10), (20, 20)])
def test_middle_and_length_of_a_smear(length, snr):
    found = _locate(Truth(20, 20, 1.5, snr * READ_SIGMA, half=length / 2, shape=(41, 41)), 500, 8)
    _assert_true(found, 500)
    told = np.array([f.smear_px for f in found.localisations])
    sigma = np.array([f.smear_sigma_px for f in found.localisations])
    assert (told > 0).all()
    # 500 draws: the mean is good to 0.045 of a sigma, the spread to 3.2 %.
    assert told.mean() == pytest.approx(length, abs=0.2 * sigma.mean())
    assert np.std((told - length) / sigma) == pytest.approx(1.0, rel=0.15)


def test_direction_of_a_smear():
    truth = Truth(20.2, 19.7, 1.5, 100.0, half=6.0, angle=0.4, shape=(41, 41))
    found = _found(truth.window(np.random.default_rng(9)))
    way = found.smear_half_px * np.sign(found.smear_half_px[0])
    # At SNR 50 the ends are known to 0.04 px.
    assert way == pytest.approx(6.0 * np.array([math.cos(0.4), math.sin(0.4)]), abs=0.2)
    assert found.width_px == pytest.approx(1.5, abs=0.1)


def test_still_spot_is_hardly_ever_taken_for_smeared():
    found = _locate(Truth(8, 8, 1.5, 40.0, shape=(17, 17)), 2000, 10)
    # One in a thousand: more than nine of 2,000 has a chance of 5e-5.
    assert sum(f.smear_px > 0 for f in found.localisations) <= 9


@pytest.mark.parametrize("outside", [-1.0, 0.0, 0.4])
def test_spot_cut_by_the_border_has_a_true_covariance_or_none(outside):
    rng = np.random.default_rng(11)
    squared = []
    for _ in range(300):
        truth = Truth(-outside, float(rng.uniform(8, 12)), 1.5, 100.0)
        found = localise(truth.window(rng), BACKGROUND, noise=NOISE, full_scale=UNLIMITED)
        if found is not None:
            error = found.px - truth.px
            squared.append(error @ np.linalg.solve(found.covariance_px2, error))
    assert len(squared) > 200
    # Chi² with two degrees of freedom has mean 2 and variance 4: 200 draws give the mean to 0.14. Spots whose fit left
    # the window are missing, and a strongly cut Gaussian is no linear problem any more: five deviations are allowed.
    assert 1.3 < np.mean(squared) < 2.7


def test_spot_whose_centre_is_outside_is_refused():
    truth = Truth(-1.5, 10.0, 1.5, 400.0)
    window = truth.window(np.random.default_rng(12))
    assert localise(window, BACKGROUND, noise=NOISE, full_scale=UNLIMITED) is None


def test_window_without_a_spot_is_refused():
    rng = np.random.default_rng(13)
    assert localise(np.full((21, 21), 20, dtype=np.uint8), 20.0, noise=NoiseModel(0.0, 0.0), full_scale=255) is None
    assert localise(np.full((21, 21), 255, dtype=np.uint8), 20.0, noise=NOISE, full_scale=255) is None
    noise = np.round(rng.normal(BACKGROUND, READ_SIGMA, (1500, 21, 21)))
    n_found = sum(localise(window, BACKGROUND, noise=NOISE, full_scale=255) is not None for window in noise)
    # Five deviations of the flux at some hundred places: about one in a thousand; above eight has a chance of 4e-5.
    assert n_found <= 8


@pytest.mark.parametrize(("dtype", "scale"), [(np.uint8, 1), (np.uint16, 16)])
def test_integer_samples_give_what_floats_give(dtype, scale):
    window = Truth(10.3, 9.8, 1.5, 300.0, full_scale=255).window(np.random.default_rng(14)) * scale
    noise = NoiseModel((scale * READ_SIGMA) ** 2, 0.0)
    of_floats, of_integers = (
        localise(w, BACKGROUND * scale, noise=noise, full_scale=255 * scale) for w in (window, window.astype(dtype))
    )
    assert of_floats is not None
    assert of_integers is not None
    assert of_integers.is_saturated
    assert np.array_equal(of_integers.px, of_floats.px)
    assert np.array_equal(of_integers.covariance_px2, of_floats.covariance_px2)


def test_pixels_of_great_variance_are_not_listened_to():
    rng = np.random.default_rng(15)
    window = Truth(10.3, 9.8, 2.0, 100.0).window(rng)
    variance = np.full(window.shape, READ_SIGMA**2)
    window[:, 12], variance[:, 12] = rng.uniform(0, 200, 21), 1e8
    found = _found(window, noise=NoiseModel(variance, 0.0))
    assert found.px == pytest.approx([10.3, 9.8], abs=4 * math.sqrt(found.covariance_px2.diagonal().max()))
    assert found.covariance_px2[0, 0] > found.covariance_px2[1, 1]


@given(
    st.floats(-0.5, 0.5),
    st.floats(-0.5, 0.5),
    st.floats(0.6, 3.0),
    st.integers(-3, 3),
    st.integers(-3, 3),
    st.booleans(),
)
def test_spot_moves_with_the_picture(x, y, width, dx, dy, is_smeared):
    truth = Truth(15 + x, 15 + y, width, 200.0, half=5.0 if is_smeared else 0.0, angle=0.7, shape=(31, 31))
    window = truth.window(np.random.default_rng(16))
    found, shifted = (_found(window[i : i + 25, j : j + 25], origin_px=(j, i)) for i, j in ((3, 3), (3 + dy, 3 + dx)))
    # The same samples of the spot, another rim of background: what that adds is a small part of a sigma.
    sigma = math.sqrt(np.trace(found.covariance_px2))
    assert shifted.px == pytest.approx(found.px, abs=0.5 * sigma)
    turned = _found(window.T[3:28, 3:28], origin_px=(3, 3))
    assert turned.px == pytest.approx(found.px[::-1], abs=0.05 * sigma)
    assert turned.covariance_px2 == pytest.approx(found.covariance_px2[::-1, ::-1], rel=0.02, abs=1e-3 * sigma**2)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        (StillSpot((9, 13)), [5.2, 4.1, 1.3, 900.0, 0.5]),
        (MovingSpot((9, 13)), [5.2, 4.1, 1.3, 900.0, 2.2, 0.6, 0.5]),
    ],
)
def test_derivatives_of_the_models(model, parameters):
    at = np.array(parameters)
    jacobian = model.light(at).jacobian.copy()
    for i, step in enumerate(1e-5 * np.eye(len(at))):
        above, below = (model.light(p).signal.copy() + p[-1] for p in (at + step, at - step))
        # Central differences of numbers up to 100: third derivatives give 1e-9, rounding 1e-14 * 100 / 1e-5.
        assert jacobian[i] == pytest.approx((above - below) / 2e-5, abs=1e-6)
