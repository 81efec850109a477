"""Reading one channel of a frame, whatever its pixel format, without a whole conversion to colour.

Every channel is a weighted sum of blue, green and red. A `Plane` says where its samples lie in the image, so that a
position found in a sub-plane of a Bayer mosaic is exact in the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from network_calib.errors import InputError
from nodes.detection.spots import Channel, FloatArray
from nodes.frames import Frame, PixelFormat

SampleArray = npt.NDArray[np.uint8 | np.uint16]

# Blue, green, red.
_WEIGHTS = {
    Channel.BLUE: (1.0, 0.0, 0.0),
    Channel.GREEN: (0.0, 1.0, 0.0),
    Channel.RED: (0.0, 0.0, 1.0),
    Channel.LUMA: (0.114, 0.587, 0.299),
}
# All four samples of a Bayer quad alike: its light, and its middle, are then those of the quad.
_BAYER_LUMA = (0.25, 0.5, 0.25)
# ITU-R BT.601: how far a unit of U and V moves blue, green and red from luma.
_U_GAIN = np.array([1.772, -0.344136, 0.0])
_V_GAIN = np.array([0.0, -0.714136, 1.402])
# Index into blue, green, red of the samples at (row, column) of a quad: (0, 0), (0, 1), (1, 0), (1, 1).
_BAYER_COLOURS = {
    PixelFormat.BAYER_RGGB: (2, 1, 1, 0),
    PixelFormat.BAYER_GRBG: (1, 2, 0, 1),
    PixelFormat.BAYER_GBRG: (1, 0, 2, 1),
    PixelFormat.BAYER_BGGR: (0, 1, 1, 2),
}

BRIGHTNESS_STEP = 32


@dataclass(frozen=True, slots=True)
class Plane:
    """One channel of a frame.

    Attributes:
        samples: (h, w) uint8 or uint16; may share memory with the frame, or with the next plane read into the same
            buffer. Not to be written to.
        packed: (h, w n) the memory in which the samples lie, every n-th of each row: n is 3 for a channel of BGR.
        lane: which one of n.
        full_scale: the sample of a saturated pixel.
        step_px: image pixels from one sample to the next: 2 in a sub-plane of a Bayer mosaic, else 1.
        origin_px: (2,) where the top-left sample lies in the image: x, y.
    """

    samples: SampleArray
    packed: SampleArray
    lane: int
    full_scale: float
    step_px: int
    origin_px: FloatArray

    def brightness(self) -> float:
        """Mean of a grid of samples, as a share of full scale."""
        return float(self.samples[::BRIGHTNESS_STEP, ::BRIGHTNESS_STEP].mean()) / self.full_scale

    def image_px(self, plane_px: FloatArray) -> FloatArray:
        """Positions (..., 2) in the image of positions among the samples."""
        return self.origin_px + self.step_px * plane_px


def auto_channels(pixel_format: PixelFormat) -> tuple[Channel, ...]:
    """The channels among which `Channel.AUTO` chooses.

    Of YUV420, whose colour has half the resolution, luma comes first: colour must be much better to be preferred.
    """
    if pixel_format is PixelFormat.MONO:
        return (Channel.LUMA,)
    if pixel_format is PixelFormat.YUV420:
        return Channel.LUMA, Channel.RED
    return Channel.RED, Channel.GREEN, Channel.BLUE


def channel_of(
    frame: Frame,
    channel: Channel,
    weights: tuple[float, float, float] | None = None,
    *,
    out: SampleArray | None = None,
) -> Plane:
    """Read a channel.

    MONO has one channel only, whatever is asked for. It, YUV420 luma and a channel of BGR are the frame's own memory.
    Colour of YUV420 is interpolated between chroma samples that lie in the middle of their four luma samples. Of a
    Bayer mosaic, one sample of each 2 x 2 quad is taken (red, blue) or their weighted mean (green, luma, weights),
    nothing interpolated: the plane has half the size, and its origin is the weighted middle of the samples used.

    Args:
        frame: not written to.
        channel: RED, GREEN, BLUE or LUMA.
        weights: blue, green, red weights in place of a named channel; may be negative.
        out: a plane's samples of an earlier frame, whose memory may be used again.

    Raises:
        InputError: the array does not fit the pixel format, or the channel is AUTO.
    """
    if channel is Channel.AUTO and weights is None:
        raise InputError("the channel 'auto' must be decided before a frame is read")
    _check(frame)
    full_scale = float(2**frame.bits - 1)
    if frame.pixel_format is PixelFormat.MONO:
        return _whole(frame.image, full_scale)
    if frame.pixel_format is PixelFormat.YUV420:
        return _of_yuv(frame, np.array(weights or _WEIGHTS[channel]), out)
    if frame.pixel_format is PixelFormat.BGR:
        return _of_bgr(frame.image, channel, weights, out, full_scale)
    return _of_bayer(frame, weights or (_BAYER_LUMA if channel is Channel.LUMA else _WEIGHTS[channel]), out)


def _whole(samples: SampleArray, full_scale: float) -> Plane:
    return Plane(samples, samples, 0, full_scale, 1, np.zeros(2))


def _of_bgr(
    image: SampleArray,
    channel: Channel,
    weights: tuple[float, float, float] | None,
    out: SampleArray | None,
    full_scale: float,
) -> Plane:
    if weights is not None:
        return _whole(_image(cv2.transform(image, np.array([weights], np.float32))), full_scale)
    if channel is Channel.LUMA:
        buffer = _reusable(out, image.shape[:2], image.dtype)
        return _whole(_image(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY, dst=buffer)), full_scale)
    image = np.ascontiguousarray(image)
    lane = _WEIGHTS[channel].index(1.0)
    # Unpacking one channel would take longer than all that is done with it.
    return Plane(image[:, :, lane], image.reshape(len(image), -1), lane, full_scale, 1, np.zeros(2))


def _of_yuv(frame: Frame, weights: FloatArray, out: SampleArray | None) -> Plane:
    width, height = frame.size_px
    luma = frame.image[:height]
    unit = 2 ** (frame.bits - 8)
    u_gain, v_gain = float(weights @ _U_GAIN), float(weights @ _V_GAIN)
    # Luma weights are gains of zero but for the rounding of the standard's own coefficients.
    if max(abs(u_gain), abs(v_gain)) < 1e-3:
        return _whole(luma, 255.0 * unit if frame.is_full_range else 235.0 * unit)
    full_scale = float(2**frame.bits - 1)
    depth = cv2.CV_8U if luma.dtype == np.uint8 else cv2.CV_16U
    if not frame.is_full_range:
        u_gain, v_gain = u_gain * full_scale / (224 * unit), v_gain * full_scale / (224 * unit)
        y_gain = full_scale / (219 * unit)
        luma = cv2.addWeighted(luma, y_gain, luma, 0.0, -16 * unit * y_gain, dtype=depth)
    quarter = height * width // 4
    chroma = frame.image[height:].reshape(2, quarter).reshape(2, height // 2, width // 2)
    rest = -128 * unit * (u_gain + v_gain)
    # What colour adds and what it takes away, each saturating at zero: unsigned arithmetic throughout.
    added = cv2.addWeighted(chroma[0], u_gain, chroma[1], v_gain, rest, dtype=depth)
    taken = cv2.addWeighted(chroma[0], -u_gain, chroma[1], -v_gain, -rest, dtype=depth)
    taken = cv2.subtract(luma, cv2.resize(taken, (width, height), interpolation=cv2.INTER_LINEAR))
    buffer = _reusable(out, (height, width), frame.image.dtype)
    red = cv2.add(taken, cv2.resize(added, (width, height), interpolation=cv2.INTER_LINEAR), buffer)
    if frame.bits not in {8, 16}:
        np.minimum(red, int(full_scale), out=red)
    return _whole(_image(red), full_scale)


def _of_bayer(frame: Frame, weights: tuple[float, float, float], out: SampleArray | None) -> Plane:
    height, width = frame.image.shape
    colours = _BAYER_COLOURS[frame.pixel_format]
    share = np.array([weights[colour] / colours.count(colour) for colour in colours])
    pairs = [frame.image[row::2].reshape(height // 2, width // 2, 2) for row in (0, 1)]
    used = np.flatnonzero(share)
    if len(used) == 1:
        row, column = divmod(int(used[0]), 2)
        buffer = _reusable(out, (height // 2, width // 2), frame.image.dtype)
        samples = cv2.extractChannel(pairs[row], column, buffer)
    else:
        samples = cv2.transform(np.concatenate(pairs, axis=2), share[None].astype(np.float32))
    middle = np.array([share[[1, 3]].sum(), share[[2, 3]].sum()])
    return Plane(_image(samples), _image(samples), 0, float(2**frame.bits - 1), 2, middle)


def _check(frame: Frame) -> None:
    """Raise unless the array's shape and type are what the pixel format says."""
    image = frame.image
    n_dimensions = 3 if frame.pixel_format is PixelFormat.BGR else 2
    is_right = image.ndim == n_dimensions and image.size > 0 and image.dtype in (np.uint8, np.uint16)
    if is_right and frame.pixel_format is PixelFormat.BGR:
        is_right = image.shape[2] == 3
    elif is_right and frame.pixel_format is PixelFormat.YUV420:
        is_right = image.shape[0] % 3 == 0 and frame.size_px[1] % 2 == 0 and image.shape[1] % 2 == 0
    elif is_right and frame.pixel_format is not PixelFormat.MONO:
        is_right = image.shape[0] % 2 == 0 and image.shape[1] % 2 == 0
    if not is_right:
        raise InputError(
            f"frame {frame.sequence}: an array of shape {image.shape}, {image.dtype}, is no {frame.pixel_format} image",
            advice="expected uint8 or uint16: (h, w) mono, (h, w, 3) bgr, (3 h / 2, w) yuv420, even (h, w) Bayer",
        )
    if frame.bits > 8 * image.dtype.itemsize or frame.bits < 8:
        raise InputError(f"frame {frame.sequence}: {frame.bits} bits a sample in an array of {image.dtype}")


def _reusable(out: SampleArray | None, shape: tuple[int, ...], dtype: np.dtype) -> SampleArray | None:
    return out if out is not None and out.shape == shape and out.dtype == dtype else None


def _image(array: object) -> SampleArray:
    """The same array: OpenCV's stubs promise any type of number."""
    return array  # pyright: ignore[reportReturnType]
