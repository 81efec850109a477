"""Pictures with the spots drawn in."""

import cv2
import numpy as np
import pytest

from nodes.camera.annotate import BEST_BGR, OTHER_BGR, annotated, bgr_of, ellipse_of, save_picture
from nodes.detection.spots import Detections, DetectorState, Spot
from nodes.frames import Frame, PixelFormat, StampOrigin


def frame_of(image, pixel_format, bits=8):
    return Frame(7, 0, StampOrigin.ORDER, image, pixel_format, bits)


def spot_at(x, y, score=0.9):
    return Spot(np.array([x, y]), np.diag([9.0, 1.0]), score, 0.8, 1.5, 0.0, is_saturated=False)


def has_colour(picture, colour, near):
    x, y = near
    part = picture[max(y - 25, 0) : y + 25, max(x - 25, 0) : x + 25].astype(int)
    return bool((np.abs(part - colour).max(axis=-1) < 30).any())


def test_the_best_is_green_and_the_others_orange():
    frame = frame_of(np.zeros((240, 320), np.uint8), PixelFormat.MONO)
    spots = (spot_at(100, 60), spot_at(250, 180, 0.4))
    picture = annotated(frame, Detections(7, 0, DetectorState.WATCHING, spots))
    assert picture.shape == (240, 320, 3)
    assert has_colour(picture, BEST_BGR, (100, 60))
    assert not has_colour(picture, OTHER_BGR, (100, 60))
    assert has_colour(picture, OTHER_BGR, (250, 180))
    assert frame.image.max() == 0  # the frame itself is not written to


@pytest.mark.parametrize(
    ("pixel_format", "shape"),
    [
        (PixelFormat.MONO, (48, 64)),
        (PixelFormat.BGR, (48, 64, 3)),
        (PixelFormat.YUV420, (72, 64)),
        (PixelFormat.BAYER_RGGB, (48, 64)),
        (PixelFormat.BAYER_GBRG, (48, 64)),
    ],
)
@pytest.mark.parametrize("bits", [8, 12])
def test_every_format_gives_a_picture(pixel_format, shape, bits):
    image = np.full(shape, 2 ** (bits - 1), np.uint8 if bits == 8 else np.uint16)
    picture = bgr_of(frame_of(image, pixel_format, bits))
    assert (picture.shape, picture.dtype) == ((48, 64, 3), np.uint8)
    # Half of full scale without colour: grey, and limited range stretches 128 to (128 - 16) * 255 / 219 = 130.
    assert np.abs(picture.astype(int) - 129).max() <= 2


def test_bayer_colours_are_in_their_place():
    image = np.zeros((48, 64), np.uint8)
    image[::2, ::2] = 200  # red in RGGB
    assert bgr_of(frame_of(image, PixelFormat.BAYER_RGGB))[10:-10, 10:-10].mean(axis=(0, 1)).argmax() == 2


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 150.0])
def test_ellipse_has_the_axes_of_the_covariance(angle_deg):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn = np.array([[c, -s], [s, c]])
    long_px, short_px, found_deg = ellipse_of(turn @ np.diag([9.0, 4.0]) @ turn.T)
    assert (long_px, short_px) == pytest.approx((3.0, 2.0))
    assert (found_deg - angle_deg + 90) % 180 == pytest.approx(90)


def test_a_saved_picture_is_numbered_and_reads_back(tmp_path):
    save_picture(np.full((48, 64, 3), 100, np.uint8), tmp_path, 123)
    picture = cv2.imread(str(tmp_path / "000123.jpg"))
    assert picture is not None
    assert picture.shape == (48, 64, 3)
