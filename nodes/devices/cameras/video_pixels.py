"""Decoded pictures as arrays, with as little conversion as the array formats of `Frame` allow.

| decoder gives                       | frame holds                                             |
|-------------------------------------|---------------------------------------------------------|
| 4:2:0, 8 to 16 bits, even size      | YUV420, every sample as it was (NV12 and P010 reordered) |
| gray, 8 to 16 bits                  | MONO; 9 and 14 bits are shifted up to 10 and 16          |
| Bayer mosaic                        | that mosaic                                             |
| RGB in planes, 9 to 16 bits         | BGR, uint16, every sample as it was                     |
| other RGB, 8 bits                   | BGR, every sample as it was                             |
| anything else: 4:2:2, 4:4:4, odd    | BGR by swscale; uint16 with 16 bits when deeper than 8  |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import av
import numpy as np
import numpy.typing as npt

from nodes.frames import ImageArray, PixelFormat

_Samples = npt.NDArray[Any]  # uint8 or uint16

_FULL_RANGE = 2  # AVCOL_RANGE_JPEG
_STORED_BITS = (8, 10, 12, 16)
_PLANAR_420 = {f"yuv420p{bits}le": bits for bits in (9, 10, 12, 14, 16)} | {"yuv420p": 8, "yuvj420p": 8}
_GRAY = {f"gray{bits}le": bits for bits in (9, 10, 12, 14, 16)} | {"gray": 8}
_GBR_PLANES = {f"gbrp{bits}le": bits for bits in (9, 10, 12, 14, 16)}
# Both chroma planes in one, U and V side by side (in nv21 V and U).
_PAIRED_420 = {"nv12": 8, "nv21": 8, "p010le": 10, "p012le": 12, "p016le": 16}
_BAYER = {
    f"bayer_{order}{suffix}": (PixelFormat(f"bayer_{order}"), bits)
    for order in ("rggb", "grbg", "gbrg", "bggr")
    for suffix, bits in (("8", 8), ("16le", 16))
}


@dataclass(frozen=True, slots=True)
class Pixels:
    """The image part of a `Frame`; for the fields see there."""

    image: ImageArray
    pixel_format: PixelFormat
    bits: int = 8
    is_full_range: bool = False


def pixels_of(picture: av.VideoFrame) -> Pixels:
    """The picture as an array that owns its memory."""
    name = picture.format.name
    is_even = picture.width % 2 == 0 and picture.height % 2 == 0
    if is_even and (name in _PLANAR_420 or name in _PAIRED_420):
        return _yuv420(picture)
    if name in _GRAY:
        image, bits = _stored(_plane(picture, 0, bits=_GRAY[name]), _GRAY[name])
        return Pixels(np.ascontiguousarray(image), PixelFormat.MONO, bits)
    if name in _BAYER:
        pixel_format, bits = _BAYER[name]
        return Pixels(_plane(picture, 0, bits=bits).copy(), pixel_format, bits)
    if name in _GBR_PLANES:
        planes = (_plane(picture, k, bits=_GBR_PLANES[name]) for k in (1, 0, 2))  # G, B, R become B, G, R
        image, bits = _stored(np.stack(list(planes), axis=-1), _GBR_PLANES[name])
        return Pixels(image, PixelFormat.BGR, bits)
    return _converted(picture)


def _yuv420(picture: av.VideoFrame) -> Pixels:
    name, width, height = picture.format.name, picture.width, picture.height
    bits = _PLANAR_420[name] if name in _PLANAR_420 else _PAIRED_420[name]
    image = np.empty((height * 3 // 2, width), dtype=np.uint8 if bits == 8 else np.uint16)
    image[:height] = _plane(picture, 0, bits=bits)
    chroma = image[height:].reshape(2, height // 2, width // 2)
    if name in _PLANAR_420:
        chroma[0], chroma[1] = (_plane(picture, k, bits=bits) for k in (1, 2))
    else:
        pairs = _plane(picture, 1, bits=bits).reshape(height // 2, width // 2, 2)
        chroma[:] = np.moveaxis(pairs[..., ::-1] if name == "nv21" else pairs, -1, 0)
        if bits > 8:
            image >>= 16 - bits  # P010 holds its ten bits above six zeros
    image, bits = _stored(image, bits)
    is_full = name.startswith("yuvj") or picture.color_range == _FULL_RANGE
    return Pixels(image, PixelFormat.YUV420, bits, is_full)


def _plane(picture: av.VideoFrame, index: int, *, bits: int) -> _Samples:
    """One plane, (h, w) with the plane's own size, lying in the picture's memory."""
    plane = picture.planes[index]
    dtype = np.dtype(np.uint8 if bits == 8 else "<u2")
    samples = np.frombuffer(cast("memoryview", plane), dtype=dtype)
    row = plane.line_size // dtype.itemsize
    n_columns = picture.width if index == 0 else plane.width
    if index == 1 and picture.format.name in _PAIRED_420:
        n_columns = picture.width
    return samples[: row * plane.height].reshape(plane.height, row)[:, :n_columns]


def _stored(image: _Samples, bits: int) -> tuple[_Samples, int]:
    """Samples with one of the bit depths that a `Frame` may have, shifted up where needed."""
    stored = next(depth for depth in _STORED_BITS if depth >= bits)
    return (image if stored == bits else image << (stored - bits)), stored


def _converted(picture: av.VideoFrame) -> Pixels:
    kind = picture.format
    is_deep = max(component.bits for component in kind.components) > 8
    if kind.name.startswith(("gray", "ya", "mono")):
        target, pixel_format = ("gray16le" if is_deep else "gray"), PixelFormat.MONO
    else:
        target, pixel_format = ("bgr48le" if is_deep else "bgr24"), PixelFormat.BGR
    image = picture.to_ndarray(format=target)
    return Pixels(cast("ImageArray", np.ascontiguousarray(image)), pixel_format, 16 if is_deep else 8)
