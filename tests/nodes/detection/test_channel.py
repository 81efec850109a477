import cv2
import numpy as np
import pytest

from network_calib.errors import InputError
from nodes.detection.channel import auto_channels, channel_of
from nodes.detection.spots import Channel
from nodes.frames import Frame, PixelFormat, StampOrigin

BAYER = [PixelFormat.BAYER_RGGB, PixelFormat.BAYER_GRBG, PixelFormat.BAYER_GBRG, PixelFormat.BAYER_BGGR]
LETTERS = {"b": 0, "g": 1, "r": 2}
NAMED = {Channel.BLUE: 0, Channel.GREEN: 1, Channel.RED: 2}


def frame_of(image, pixel_format, *, bits=8, is_full_range=False):
    return Frame(0, 0, StampOrigin.ORDER, image, pixel_format, bits, is_full_range)


def mosaic_of(bgr, pixel_format):
    """What a chip with this filter sees of a colour image."""
    letters = pixel_format.value.removeprefix("bayer_")
    out = np.empty(bgr.shape[:2], bgr.dtype)
    for k, letter in enumerate(letters):
        row, column = divmod(k, 2)
        out[row::2, column::2] = bgr[row::2, column::2, LETTERS[letter]]
    return out


def yuv_of(bgr, *, is_full_range):
    """Planar 4:2:0 of a colour image with constant 2 x 2 blocks, by ITU-R BT.601."""
    blue, green, red = np.moveaxis(bgr.astype(float), 2, 0)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    u, v = (blue - luma) / 1.772, (red - luma) / 1.402
    if not is_full_range:
        luma, u, v = 16 + luma * 219 / 255, u * 224 / 255, v * 224 / 255
    chroma = np.concatenate([(part[::2, ::2] + 128).reshape(-1, bgr.shape[1]) for part in (u, v)])
    return np.clip(np.rint(np.concatenate([luma, chroma])), 0, 255).astype(np.uint8)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.mark.parametrize("channel", NAMED)
@pytest.mark.parametrize(("dtype", "bits"), [(np.uint8, 8), (np.uint16, 10), (np.uint16, 12), (np.uint16, 16)])
def test_bgr_channel_is_a_view_of_the_frame(rng, channel, dtype, bits):
    image = rng.integers(0, 2**bits, (20, 30, 3), dtype=dtype)
    plane = channel_of(frame_of(image, PixelFormat.BGR, bits=bits), channel)
    np.testing.assert_array_equal(plane.samples, image[:, :, NAMED[channel]])
    assert np.shares_memory(plane.samples, image)
    np.testing.assert_array_equal(plane.packed[:, plane.lane :: 3], plane.samples)
    assert plane.full_scale == 2**bits - 1


@pytest.mark.parametrize("channel", [*NAMED, Channel.LUMA])
def test_mono_has_one_channel_only_and_copies_nothing(rng, channel):
    image = rng.integers(0, 4096, (20, 30), dtype=np.uint16)
    plane = channel_of(frame_of(image, PixelFormat.MONO, bits=12), channel)
    assert plane.samples is image
    assert plane.full_scale == 4095


def test_bgr_luma_is_that_of_the_standard(rng):
    image = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    luma = channel_of(frame_of(image, PixelFormat.BGR), Channel.LUMA).samples
    np.testing.assert_allclose(luma, image @ [0.114, 0.587, 0.299], atol=0.51)


@pytest.mark.parametrize("weights", [(0.0, 0.5, 0.5), (-0.5, -0.5, 2.0)])
def test_weights_of_bgr_saturate_once_at_the_end(rng, weights):
    image = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    mixed = channel_of(frame_of(image, PixelFormat.BGR), Channel.AUTO, weights).samples
    np.testing.assert_allclose(mixed, np.clip(image @ weights, 0, 255), atol=0.51)


def test_yuv_luma_is_the_frame_s_own_memory(rng):
    image = rng.integers(16, 236, (36, 32), dtype=np.uint8)
    plane = channel_of(frame_of(image, PixelFormat.YUV420), Channel.LUMA)
    assert np.shares_memory(plane.samples, image)
    np.testing.assert_array_equal(plane.samples, image[:24])
    assert plane.full_scale == 235
    assert channel_of(frame_of(image, PixelFormat.YUV420, is_full_range=True), Channel.LUMA).full_scale == 255


@pytest.mark.parametrize("is_full_range", [False, True])
@pytest.mark.parametrize("channel", NAMED)
def test_yuv_colour_is_that_of_the_picture(rng, channel, is_full_range):
    # One colour over 12 x 12 pixels: in the middle of each, interpolated chroma is that of the colour.
    colours = rng.integers(20, 236, (4, 4, 3))
    bgr = colours.repeat(12, axis=0).repeat(12, axis=1)
    image = yuv_of(bgr, is_full_range=is_full_range)
    plane = channel_of(frame_of(image, PixelFormat.YUV420, is_full_range=is_full_range), channel)
    # Rounding of Y (0.5), U and V (0.5 each, times at most 1.772), stretched by 255 / 219, and three roundings here.
    tolerance = (0.5 + 0.5 * 1.772) * 255 / 219 + 1.5
    np.testing.assert_allclose(plane.samples[5::12, 5::12], colours[:, :, NAMED[channel]], atol=tolerance)
    assert plane.full_scale == 255


@pytest.mark.parametrize("first", [80, 130])
def test_yuv_red_lies_where_the_chroma_lies(first):
    # Chroma rises along x; its samples lie in the middle of two columns: at column 2 k + 0.5 stands sample k.
    chroma = np.tile(np.arange(first, first + 40, 2, dtype=np.uint8), (10, 1))
    image = np.concatenate([np.full((20, 40), 100), np.full((5, 40), 128), chroma.reshape(5, 40)]).astype(np.uint8)
    red = channel_of(frame_of(image, PixelFormat.YUV420, is_full_range=True), Channel.RED).samples
    x = np.arange(2, 38)
    expected = 100 + 1.402 * (first + 2 * (x - 0.5) / 2 - 128)
    # Half a sample off would shift by 0.7; rounding of both parts is 0.5 each at most, and zero in the mean over x.
    assert abs(np.mean(red[10, 2:38] - expected)) < 0.2
    # Interpolated, the columns of a pair differ by a step, give or take the rounding; repeated, by none.
    assert np.mean(red[10, 3:37:2].astype(float) - red[10, 2:36:2]) == pytest.approx(1.402, abs=0.5)


@pytest.mark.parametrize("pixel_format", BAYER)
@pytest.mark.parametrize("channel", [*NAMED, Channel.LUMA])
def test_bayer_samples_lie_where_the_plane_says(pixel_format, channel):
    # All colours are the ramp 40 + 2 x + 3 y, so a sample tells where it was taken.
    y, x = np.mgrid[:24, :32]
    ramp = (40 + 2 * x + 3 * y).astype(np.uint8)
    plane = channel_of(frame_of(mosaic_of(np.dstack([ramp] * 3), pixel_format), pixel_format), channel)
    v, u = np.mgrid[: plane.samples.shape[0], : plane.samples.shape[1]]
    px = plane.image_px(np.stack([u, v], axis=-1))
    np.testing.assert_allclose(plane.samples, 40 + px @ [2, 3], atol=0.5)
    assert plane.samples.shape == (12, 16)


@pytest.mark.parametrize("pixel_format", BAYER)
@pytest.mark.parametrize("channel", NAMED)
def test_bayer_takes_the_colour_asked_for(pixel_format, channel):
    bgr = np.tile(np.array([10, 90, 200], np.uint16), (8, 10, 1))
    plane = channel_of(frame_of(mosaic_of(bgr, pixel_format), pixel_format, bits=12), channel)
    assert np.unique(plane.samples).tolist() == [bgr[0, 0, NAMED[channel]]]


def test_buffer_is_used_again_where_it_fits(rng):
    image = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    out = np.empty((20, 30), np.uint8)
    assert channel_of(frame_of(image, PixelFormat.BGR), Channel.LUMA, out=out).samples is out
    assert channel_of(frame_of(image, PixelFormat.BGR), Channel.LUMA, out=np.empty((9, 9), np.uint8)).samples is not out
    np.testing.assert_array_equal(out, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize(
    ("shape", "pixel_format"),
    [
        ((20, 30), PixelFormat.BGR),
        ((20, 30, 3), PixelFormat.MONO),
        ((20, 30, 4), PixelFormat.BGR),
        ((35, 32), PixelFormat.YUV420),
        ((21, 30), PixelFormat.BAYER_RGGB),
        ((0, 30), PixelFormat.MONO),
    ],
)
def test_an_array_that_is_no_such_image_is_refused(shape, pixel_format):
    with pytest.raises(InputError, match=pixel_format.value):
        channel_of(frame_of(np.zeros(shape, np.uint8), pixel_format), Channel.LUMA)


def test_bits_beyond_the_type_and_auto_are_refused():
    image = np.zeros((4, 4), np.uint8)
    with pytest.raises(InputError, match="12 bits"):
        channel_of(frame_of(image, PixelFormat.MONO, bits=12), Channel.LUMA)
    with pytest.raises(InputError, match="auto"):
        channel_of(frame_of(image, PixelFormat.MONO), Channel.AUTO)


def test_auto_looks_at_one_channel_of_mono_and_luma_first_of_yuv():
    assert auto_channels(PixelFormat.MONO) == (Channel.LUMA,)
    assert auto_channels(PixelFormat.YUV420)[0] is Channel.LUMA
    assert set(auto_channels(PixelFormat.BGR)) == set(NAMED)
