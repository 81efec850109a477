"""Formats of decoders that no common codec of a test writes: paired chroma, mosaics, and what needs conversion."""

import av
import numpy as np
import pytest

from nodes.devices.cameras.video_pixels import pixels_of
from nodes.frames import PixelFormat
from tests.nodes.devices.video_writer import picture, planar, samples_of

WIDTH, HEIGHT = 50, 36  # not a multiple of any row alignment


def flat(format_name, *values):
    frame = av.VideoFrame(WIDTH, HEIGHT, format_name)
    for plane, value in zip(frame.planes, values, strict=True):
        plane.update(bytes([value]) * plane.buffer_size)
    return frame


@pytest.mark.parametrize(("name", "bits", "order"), [("nv12", 8, (0, 1)), ("nv21", 8, (1, 0)), ("p010le", 10, (0, 1))])
def test_paired_chroma_is_put_into_planes(name, bits, order):
    frame = picture(7, name, width=WIDTH, height=HEIGHT)
    pixels = pixels_of(frame)
    shift = 6 if bits == 10 else 0
    luma = samples_of(frame, 0, width=WIDTH, height=HEIGHT) >> shift
    pairs = (samples_of(frame, 1, width=WIDTH, height=HEIGHT // 2) >> shift).reshape(HEIGHT // 2, WIDTH // 2, 2)
    assert (pixels.pixel_format, pixels.bits) == (PixelFormat.YUV420, bits)
    np.testing.assert_array_equal(pixels.image[:HEIGHT], luma)
    u, v = pixels.image[HEIGHT:].reshape(2, HEIGHT // 2, WIDTH // 2)
    np.testing.assert_array_equal(u, pairs[..., order[0]])
    np.testing.assert_array_equal(v, pairs[..., order[1]])


@pytest.mark.parametrize(("name", "bits", "told", "factor"), [("yuv420p9le", 9, 10, 2), ("yuv420p14le", 14, 16, 4)])
def test_rare_depths_are_shifted_up(name, bits, told, factor):
    frame = picture(1, name, width=WIDTH, height=HEIGHT)
    pixels = pixels_of(frame)
    assert pixels.bits == told
    assert pixels.image.max() < 1 << told
    np.testing.assert_array_equal(pixels.image, planar(frame) * factor)
    assert bits < told


@pytest.mark.parametrize(("name", "pixel_format"), [("bayer_rggb8", "bayer_rggb"), ("bayer_bggr16le", "bayer_bggr")])
def test_mosaics_stay_mosaics(name, pixel_format):
    frame = picture(2, name, width=WIDTH, height=HEIGHT)
    pixels = pixels_of(frame)
    assert pixels.pixel_format.value == pixel_format
    assert pixels.bits == 8 * pixels.image.itemsize
    np.testing.assert_array_equal(pixels.image, samples_of(frame, 0, width=WIDTH, height=HEIGHT))


@pytest.mark.parametrize(
    ("name", "planes", "expected"),
    [
        ("yuvj422p", (255, 128, 128), 255),
        ("yuv422p", (235, 128, 128), 255),
        ("yuv444p", (16, 128, 128), 0),
        ("yuvj444p", (16, 128, 128), 16),
    ],
)
def test_range_is_kept_in_mind_when_converting(name, planes, expected):
    pixels = pixels_of(flat(name, *planes))
    assert (pixels.pixel_format, pixels.image.shape) == (PixelFormat.BGR, (HEIGHT, WIDTH, 3))
    assert np.abs(pixels.image.astype(int) - expected).max() <= 1  # rounding of the conversion matrix


def test_deep_422_comes_as_16_bits():
    pixels = pixels_of(picture(3, "yuv422p10le", width=WIDTH, height=HEIGHT))
    assert (pixels.pixel_format, pixels.bits, pixels.image.dtype) == (PixelFormat.BGR, 16, np.uint16)


def test_gray_with_transparency_is_gray():
    frame = picture(4, "ya8", width=WIDTH, height=HEIGHT)
    gray = samples_of(frame, 0, width=2 * WIDTH, height=HEIGHT)[:, ::2]
    pixels = pixels_of(frame)
    assert pixels.pixel_format is PixelFormat.MONO
    np.testing.assert_array_equal(pixels.image, gray)


def test_tagged_full_range_is_told():
    frame = flat("yuv420p", 200, 128, 128)
    assert not pixels_of(frame).is_full_range
    frame.color_range = 2
    assert pixels_of(frame).is_full_range
