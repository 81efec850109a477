"""Cutting one image that holds the views of both eyes of a stereo head into two."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from nodes.frames import Frame, PixelFormat

_Samples = npt.NDArray[Any]  # uint8 or uint16


class StereoLayout(StrEnum):
    """How a stereo head sends both views through one source."""

    LEFT_RIGHT = "left_right"  # halves side by side
    TOP_BOTTOM = "top_bottom"  # halves one above the other, left above
    LINES = "lines"  # even lines left, odd lines right
    ALTERNATING = "alternating"  # even frames left, odd frames right


def layout_fault(layout: StereoLayout, pixel_format: PixelFormat, size_px: tuple[int, int]) -> str | None:
    """Why an image of this kind cannot be cut in this layout; None when it can.

    Both views must be whole images of the same kind: the chroma of YUV420 stands for 2 x 2 pixels, and a Bayer mosaic
    repeats after 2.
    """
    if layout is StereoLayout.ALTERNATING:
        return None
    is_wide = layout is StereoLayout.LEFT_RIGHT
    length = size_px[0] if is_wide else size_px[1]
    is_bayer = pixel_format.value.startswith("bayer")
    if is_bayer and layout is StereoLayout.LINES:
        return f"lines of a {pixel_format.value} mosaic belong together, expected another layout"
    multiple = 4 if is_bayer or pixel_format is PixelFormat.YUV420 else 2
    if length % multiple:
        what = "width" if is_wide else "height"
        return f"its {what} is {length} px, expected a multiple of {multiple} for two halves of {pixel_format.value}"
    return None


def split_image(frame: Frame, layout: StereoLayout) -> tuple[_Samples, _Samples]:
    """Left and right view of one frame; they may lie in its memory.

    The luma of YUV420 is cut exactly, and its chroma too, but for LINES: there one sample of chroma belongs to a line
    of either view, so that both views get the mean, and colours can be trusted in neither.
    """
    if frame.pixel_format is not PixelFormat.YUV420:
        return _halves(frame.image, layout)
    width, height = frame.size_px
    luma = _halves(frame.image[:height], layout)
    planes = frame.image[height:].reshape(2, height // 2, width // 2)
    if layout is StereoLayout.LINES:
        pairs = planes.reshape(2, height // 4, 2, width // 2)
        mean = ((pairs[:, :, 0].astype(np.uint32) + pairs[:, :, 1] + 1) // 2).astype(planes.dtype)
        chroma = [(plane, plane) for plane in mean]
    else:
        chroma = [_halves(plane, layout) for plane in planes]
    return _planar(luma[0], chroma[0][0], chroma[1][0]), _planar(luma[1], chroma[0][1], chroma[1][1])


def _halves(image: _Samples, layout: StereoLayout) -> tuple[_Samples, _Samples]:
    if layout is StereoLayout.LINES:
        return np.ascontiguousarray(image[::2]), np.ascontiguousarray(image[1::2])
    if layout is StereoLayout.TOP_BOTTOM:
        half = image.shape[0] // 2
        return image[:half], image[half:]
    half = image.shape[1] // 2
    return np.ascontiguousarray(image[:, :half]), np.ascontiguousarray(image[:, half:])


def _planar(luma: _Samples, u: _Samples, v: _Samples) -> _Samples:
    width = luma.shape[1]
    # Chroma planes follow the luma without gaps: as rows of the full width where that comes out even.
    return np.concatenate([luma.ravel(), u.ravel(), v.ravel()]).reshape(-1, width)
