from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError
from nodes.frames import PixelFormat
from nodes.simulated.rendering.sensor import MOSAICS, SensorModel, add_light, bloom, develop, on_mosaic, surplus_of

PLAIN = SensorModel(black_level=0.02)


def flat(level, shape=(400, 500)):
    return np.full(shape, level, dtype=np.float32)


def spot(shape, px, sigma_px):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.exp(-0.5 * ((x - px[0]) ** 2 + (y - px[1]) ** 2) / sigma_px**2).astype(np.float32)


def centroid(values, x, y):
    return np.array([(x * values).sum(), (y * values).sum()]) / values.sum()


def only(colour):
    """Light of one colour."""
    blue, green, red = (1.0 if c == colour else 0.0 for c in range(3))
    return blue, green, red


def noisy(sensor, level, seed=1):
    noise = np.random.default_rng(seed).standard_normal(200_000, dtype=np.float32)
    return sensor.levels_of(develop(sensor, flat(level), noise)).astype(np.float64)


@pytest.mark.parametrize("gain_db", [0.0, 12.0])
def test_photon_noise_is_linear_in_the_light_and_read_noise_stays(gain_db):
    sensor = SensorModel(bits=16, black_level=0.05, full_well_e=10_000, read_noise_e=15, gain_db=gain_db)
    full = sensor.electrons_at_full_scale
    assert full == pytest.approx(10_000 / 10 ** (gain_db / 20))
    for level in (0.0, 0.1, 0.2, 0.4, 0.8):
        electrons = noisy(sensor, level) * full
        # A variance of 2e5 samples has a relative sigma of sqrt(2 / 2e5) = 0.3 %, a mean one of noise / 447.
        assert electrons.var() == pytest.approx(level * full + 15**2, rel=0.016)
        assert electrons.mean() == pytest.approx(level * full, abs=5 * electrons.std() / 447)
        assert sensor.noise_of(level) * full == pytest.approx(np.sqrt(level * full + 15**2))


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_saturation_is_the_top_code_and_darkness_the_black_level(bits, gamma):
    sensor = replace(PLAIN, bits=bits, gamma=gamma)
    top = 2**bits - 1
    for level, expected in ((1.0, top), (7.0, top), (0.0, 0.02 * top)):
        image = develop(sensor, flat(level), None)
        assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
        # Two roundings with gamma: of the 12-bit code (its slope at 0 is 0.01^(1/2.2 - 1) = 12.3), and of the sample.
        assert abs(float(image[0, 0]) - expected) <= (
            0.5 if gamma == 1 else 0.5 + 12.4 * top / 2 / (2 ** max(bits, 12) - 1)
        )


def test_noise_never_leaves_saturated_samples_below_the_top_far_beyond_it():
    sensor = SensorModel(bits=12)
    assert (noisy(sensor, 2.0) == noisy(sensor, 3.0)).all()


@given(st.floats(0.0, 1.0), st.sampled_from([8, 10, 12, 16]), st.sampled_from([1.0, 1.8, 2.2, 2.6]))
def test_gamma_black_level_and_quantisation_can_be_undone(level, bits, gamma):
    sensor = replace(PLAIN, bits=bits, gamma=gamma)
    back = sensor.levels_of(develop(sensor, flat(level, (2, 2)), None))[0, 0]
    # Half a sample times the steepest slope of the inverse curve (gamma, at level 1), and half a code before the curve.
    step = gamma / (2 * (2**bits - 1)) + (gamma > 1) / (2 * (2 ** max(bits, 12) - 1))
    assert back == pytest.approx(level, abs=1.1 * step / 0.98 + 1e-6)


def test_gamma_brightens_the_dark():
    samples = [develop(replace(PLAIN, gamma=gamma), flat(0.2, (2, 2)), None)[0, 0] for gamma in (1.0, 2.2)]
    # 0.2^(1 / 2.2) = 0.481.
    assert samples == pytest.approx([255 * (0.02 + 0.98 * 0.2), 255 * (0.02 + 0.98 * 0.481)], abs=0.6)


@pytest.mark.parametrize("mosaic", list(MOSAICS))
@pytest.mark.parametrize("colour", [0, 1, 2])
def test_each_colour_of_a_mosaic_sees_the_spot_where_it_is(mosaic, colour):
    """Colours by the name of the format: `rggb` is row 0 red green, row 1 green blue."""
    px, shape, order = np.array([40.3, 31.8]), (64, 80), mosaic.value.removeprefix("bayer_")
    bgr = only(colour)
    plane = np.zeros(shape, dtype=np.float32)
    values = spot(shape, px, 2.5)
    # In two patches whose corners are odd and even: the filter is tied to the chip, not to the patch.
    for x, y, part in ((0, 0, values[:31]), (0, 31, values[31:])):
        add_light(plane, part, bgr=bgr, mosaic=MOSAICS[mosaic], x=x, y=y)
    np.testing.assert_array_equal(plane, on_mosaic(values[..., None] * np.array(bgr, np.float32), MOSAICS[mosaic]))
    y, x = np.mgrid[: shape[0], : shape[1]]
    sees = np.array([["bgr".index(order[2 * (r % 2) + c % 2]) == colour for c in range(2)] for r in range(2)])
    is_seeing = np.tile(sees, (shape[0] // 2, shape[1] // 2))
    assert (plane[~is_seeing] == 0).all()
    # Every second sample of a Gaussian of 2.5 px: aliases are 2 exp(-2 pi^2 1.25^2) < 1e-13.
    assert centroid(plane[is_seeing].astype(float), x[is_seeing], y[is_seeing]) == pytest.approx(px, abs=1e-4)


def test_interpolated_colours_keep_their_place():
    sensor = replace(PLAIN, pixel_format=PixelFormat.BGR, bits=16, black_level=0.0)
    px, shape = np.array([40.3, 31.8]), (64, 80)
    y, x = np.mgrid[: shape[0], : shape[1]]
    for colour in range(3):
        plane = np.zeros(shape, dtype=np.float32)
        bgr = only(colour)
        add_light(plane, 0.9 * spot(shape, px, 2.5), bgr=bgr, mosaic=sensor.mosaic, x=0, y=0)
        image = develop(sensor, plane, None).astype(float)
        assert image.shape == (64, 80, 3)
        # Bilinear kernels are even, so the centre stays; 16-bit rounding over 5120 pixels is 1e-3 px at most.
        assert centroid(image[..., colour], x, y) == pytest.approx(px, abs=1e-3)
        assert image[..., [c for c in range(3) if c != colour]].max() == 0


def test_a_monochrome_chip_sees_the_best_of_a_light_and_the_mean_of_a_scene():
    plane = np.zeros((4, 6), dtype=np.float32)
    add_light(plane, flat(0.5, (2, 2)), bgr=(0.1, 0.2, 0.8), mosaic=None, x=2, y=1)
    assert plane.sum() == pytest.approx(4 * 0.4)
    assert (plane[1:3, 2:4] > 0).all()
    assert on_mosaic(np.full((2, 2, 3), [0.1, 0.2, 0.6], dtype=np.float32), None) == pytest.approx(np.full((2, 2), 0.3))


def test_blooming_moves_surplus_charge_along_columns_both_ways():
    levels = flat(0.4, (41, 5))
    levels[20, 2] = 4.0
    before = levels.copy()
    bloom(levels, surplus_of(levels))
    added = levels - before
    # The surplus of 3 goes half up and half down, 0.6 into each pixel: two filled, one half filled each way.
    assert added.sum() == pytest.approx(3.0, abs=1e-5)
    assert (added[:, [0, 1, 3, 4]] == 0).all()
    assert added[17:24, 2] == pytest.approx([0.3, 0.6, 0.6, 0.0, 0.6, 0.6, 0.3], abs=1e-6)
    np.testing.assert_allclose(added, added[::-1], atol=1e-6)


def test_charge_runs_through_full_pixels():
    levels = flat(0.9, (12, 1))
    levels[4:7, 0] = [2.0, 3.0, 2.0]
    before = levels.copy()
    bloom(levels, surplus_of(levels))
    added = (levels - before)[:, 0]
    # Half of the surplus of 4 each way, 0.1 fits into a pixel: the four above and the five below are full.
    assert added == pytest.approx([0.1] * 4 + [0.0] * 3 + [0.1] * 5, abs=1e-6)


def test_exposure_and_gain_scale_brightness():
    assert SensorModel(exposure_s=0.01).brightness == 1
    assert SensorModel(exposure_s=0.03, gain_db=20).brightness == pytest.approx(30)
    assert SensorModel(exposure_s=0.03, gain_db=20).settings.exposure_s == 0.03


@pytest.mark.parametrize(
    ("field", "value"),
    [("pixel_format", PixelFormat.YUV420), ("bits", 9), ("exposure_s", 0.0), ("gamma", -1.0), ("blooming", 1.5)],
)
def test_a_sensor_that_cannot_be_is_refused(field, value):
    with pytest.raises(InputError, match=field):
        SensorModel(**{field: value})
