"""Pictures for a person: the frame with the spot's 3-sigma ellipse, the other candidates, and their scores."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from nodes.detection.spots import Detections, Spot
from nodes.devices.errors import SourceError
from nodes.frames import Frame, PixelFormat

BGR = npt.NDArray[np.uint8]
BEST_BGR, OTHER_BGR = (80, 255, 80), (60, 160, 255)
N_SIGMA = 3.0
# An ellipse of a tenth of a pixel is invisible, so a ring of this radius stands around it.
RING_PX = 14.0
# cv2 draws on a grid of 1/16 px.
SHIFT = 4
_TO_BGR = {
    PixelFormat.MONO: cv2.COLOR_GRAY2BGR,
    PixelFormat.YUV420: cv2.COLOR_YUV2BGR_I420,
    PixelFormat.BAYER_RGGB: cv2.COLOR_BayerRGGB2BGR,
    PixelFormat.BAYER_GRBG: cv2.COLOR_BayerGRBG2BGR,
    PixelFormat.BAYER_GBRG: cv2.COLOR_BayerGBRG2BGR,
    PixelFormat.BAYER_BGGR: cv2.COLOR_BayerBGGR2BGR,
}


def annotated(frame: Frame, detections: Detections) -> BGR:
    """The picture (h, w, 3) with all candidates; the best in green with its number, the others in orange."""
    picture = bgr_of(frame)
    for rank, spot in reversed(list(enumerate(detections.spots))):
        _draw_spot(picture, spot, is_best=rank == 0)
    found = f"{len(detections.spots)} found" if detections.spots else detections.state.value
    _write(picture, f"{frame.sequence}  {found}", (6.0, 18.0), BEST_BGR if detections.spots else OTHER_BGR)
    return picture


def bgr_of(frame: Frame) -> BGR:
    """A copy (h, w, 3) to draw on, 8 bits; for a look only: YUV is taken as limited range."""
    image = frame.image
    if frame.bits > 8:
        image = image >> (frame.bits - 8)
    narrow = np.array(image, dtype=np.uint8)
    code = _TO_BGR.get(frame.pixel_format)
    return narrow if code is None else np.asarray(cv2.cvtColor(narrow, code), dtype=np.uint8)


def save_picture(picture: BGR, folder: Path, sequence: int) -> None:
    """Write `000123.jpg`.

    Raises:
        SourceError: it cannot be written.
    """
    path = folder / f"{sequence:06d}.jpg"
    is_coded, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])
    if not is_coded:
        raise SourceError(f"{path}: the picture of {picture.shape[1]} x {picture.shape[0]} cannot be coded as JPEG")
    path.write_bytes(data.tobytes())


def ellipse_of(covariance_px2: npt.NDArray[np.float64]) -> tuple[float, float, float]:
    """Half axes of one sigma (px), the longer first, and the angle (degrees) from x towards y of the longer."""
    values, vectors = np.linalg.eigh(covariance_px2)
    angle_deg = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    long_px, short_px = np.sqrt(np.maximum(values[::-1], 0.0))
    return float(long_px), float(short_px), angle_deg


def _draw_spot(picture: BGR, spot: Spot, *, is_best: bool) -> None:
    colour = BEST_BGR if is_best else OTHER_BGR
    centre = _fixed(spot.px[0]), _fixed(spot.px[1])
    long_px, short_px, angle_deg = ellipse_of(spot.covariance_px2)
    axes = _fixed(N_SIGMA * long_px), _fixed(N_SIGMA * short_px)
    cv2.ellipse(picture, centre, axes, angle_deg, 0, 360, colour, 1, cv2.LINE_AA, SHIFT)
    radius_px = max(RING_PX, 2 * spot.width_px + 4, 0.5 * spot.smear_px + 4)
    cv2.circle(picture, centre, _fixed(radius_px), colour, 1, cv2.LINE_AA, SHIFT)
    place = float(spot.px[0]) + radius_px + 3, float(spot.px[1]) - 4
    _write(picture, f"{spot.score:.2f}", place, colour)
    if is_best:
        told = f"{spot.px[0]:.2f} {spot.px[1]:.2f} +-{spot.sigma_px:.2f}"
        _write(picture, told, (place[0], place[1] + 14), colour)


def _fixed(value: float) -> int:
    return round(float(value) * 2**SHIFT)


def _write(picture: BGR, text: str, place: tuple[float, float], colour: tuple[int, int, int]) -> None:
    """Text with a dark rim, kept inside the picture."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
    x = int(np.clip(place[0], 2, max(picture.shape[1] - width - 2, 2)))
    y = int(np.clip(place[1], height + 2, max(picture.shape[0] - 4, height + 2)))
    for rim, ink in ((3, (0, 0, 0)), (1, colour)):
        cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, ink, rim, cv2.LINE_AA)
