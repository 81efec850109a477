"""From light on the chip to the samples of a frame: exposure, blooming, noise, quantisation, gamma, colours.

Light is counted in *levels*: 1 is the full scale of the sensor. A chip with colour filters has one light-sensitive
place a pixel, so everything up to the samples happens in one plane; colours are interpolated last.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from network_calib.errors import InputError
from nodes.frames import FrameSettings, ImageArray, PixelFormat

Float32Array = npt.NDArray[np.float32]
# Radiances of the scene are levels at this exposure time and 0 dB.
REFERENCE_EXPOSURE_S = 0.01
# Rows are developed in strips that stay in the processor's cache: three times as fast as whole planes.
STRIP_SAMPLES = 1 << 16
# Below this level the gamma curve is a straight line, as in every video standard: its slope at 0 would be infinite.
GAMMA_TOE = 0.01
# Colour (0 blue, 1 green, 2 red) of the places (0, 0), (0, 1), (1, 0), (1, 1) of each mosaic, row first.
MOSAICS = {
    PixelFormat.BAYER_RGGB: (2, 1, 1, 0),
    PixelFormat.BAYER_GRBG: (1, 2, 0, 1),
    PixelFormat.BAYER_GBRG: (1, 0, 2, 1),
    PixelFormat.BAYER_BGGR: (0, 1, 1, 2),
}
FORMATS = (PixelFormat.MONO, PixelFormat.BGR, *MOSAICS)


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A chip with its lens's blur and its electronics.

    Attributes:
        pixel_format: MONO, a Bayer mosaic (raw), or BGR (the RGGB mosaic, interpolated bilinearly as cameras do).
        bits: significant bits of a sample: 8, 10, 12 or 16.
        exposure_s: exposure time.
        gain_db: electronic gain: brighter samples, fewer electrons at full scale.
        full_well_e: electrons at full scale at 0 dB.
        read_noise_e: standard deviation of the electronics, electrons.
        has_noise: False: no photon and no read noise, for tests.
        black_level: sample of no light, in full scales; keeps the noise in the dark from being cut off.
        gamma: sample = level ** (1 / gamma) above GAMMA_TOE; applied before colours are interpolated.
        response_spread: standard deviation of the pixels' sensitivities, relative (fixed pattern).
        n_hot_pixels: pixels that shine by themselves.
        psf_sigma_px: blur of lens and pixel cover glass, Gaussian.
        glare_part: part of a light that the lens scatters into a wide skirt around it.
        glare_sigma_px: size of that skirt.
        blooming: part of the charge beyond full scale that runs over into the next pixels of the column, both ways.
        streak: part of a column's light that is smeared over the whole column while the charge is read out.
    """

    pixel_format: PixelFormat = PixelFormat.MONO
    bits: int = 8
    exposure_s: float = 0.01
    gain_db: float = 0.0
    full_well_e: float = 12_000.0
    read_noise_e: float = 12.0
    has_noise: bool = True
    black_level: float = 0.008
    gamma: float = 1.0
    response_spread: float = 0.004
    n_hot_pixels: int = 0
    psf_sigma_px: float = 0.75
    glare_part: float = 0.03
    glare_sigma_px: float = 7.0
    blooming: float = 0.0
    streak: float = 0.0

    def __post_init__(self) -> None:
        if self.pixel_format not in FORMATS:
            raise InputError(f"pixel_format is {self.pixel_format.value}, expected one of {', '.join(FORMATS)}")
        if self.bits not in (8, 10, 12, 16):
            raise InputError(f"bits is {self.bits}, expected 8, 10, 12 or 16")
        positive = {"exposure_s": self.exposure_s, "full_well_e": self.full_well_e, "gamma": self.gamma}
        positive |= {"psf_sigma_px": self.psf_sigma_px, "glare_sigma_px": self.glare_sigma_px}
        for field_name, value in positive.items():
            if not value > 0:
                raise InputError(f"{field_name} is {value}, expected more than 0")
        if not 0 <= self.blooming <= 1:
            raise InputError(f"blooming is {self.blooming}, expected 0 to 1")

    @property
    def settings(self) -> FrameSettings:
        """As the camera would tell them."""
        return FrameSettings(exposure_s=self.exposure_s, gain_db=self.gain_db)

    @property
    def brightness(self) -> float:
        """Level on the chip of radiance 1."""
        return self.exposure_s / REFERENCE_EXPOSURE_S * self._gain

    @property
    def electrons_at_full_scale(self) -> float:
        """Fewer with gain."""
        return self.full_well_e / self._gain

    @property
    def mosaic(self) -> tuple[int, int, int, int] | None:
        """Colours of the four places of the filter, see MOSAICS; None for a monochrome chip."""
        if self.pixel_format is PixelFormat.MONO:
            return None
        return MOSAICS.get(self.pixel_format, MOSAICS[PixelFormat.BAYER_RGGB])

    @property
    def _gain(self) -> float:
        return 10 ** (self.gain_db / 20)

    def noise_of(self, level: float) -> float:
        """Standard deviation of a level: photon noise, linear in the light as variance, and the electronics'."""
        full = self.electrons_at_full_scale
        return float(np.sqrt(max(level, 0.0) / full + (self.read_noise_e / full) ** 2))

    def levels_of(self, samples: ImageArray) -> Float32Array:
        """Undo black level, quantisation and gamma of samples that were not interpolated: levels, to half a step."""
        signal = samples.astype(np.float32) / np.float32((1 << self.bits) - 1)
        signal = (signal - np.float32(self.black_level)) / np.float32(1 - self.black_level)
        return _from_gamma(signal, self.gamma)


def on_mosaic(bgr: Float32Array, mosaic: tuple[int, int, int, int] | None, *, x: int = 0, y: int = 0) -> Float32Array:
    """What each place of the chip sees of a colour image (h, w, 3) whose first pixel is at column x, row y: (h, w).

    A monochrome chip sees the mean of the colours.
    """
    if mosaic is None:
        return bgr.mean(axis=2, dtype=np.float32)
    out = np.empty(bgr.shape[:2], dtype=np.float32)
    for row in (0, 1):
        for column in (0, 1):
            colour = mosaic[2 * ((y + row) % 2) + (x + column) % 2]
            out[row::2, column::2] = bgr[row::2, column::2, colour]
    return out


def add_light(
    plane: Float32Array,
    values: Float32Array,
    *,
    bgr: tuple[float, float, float],
    mosaic: tuple[int, int, int, int] | None,
    x: int,
    y: int,
) -> None:
    """Add one colour's light `values` (h, w) to the chip's plane at column x, row y, in place.

    A monochrome chip answers as the best of the three colours does.
    """
    height, width = values.shape
    target = plane[y : y + height, x : x + width]
    if mosaic is None:
        target += values * np.float32(max(bgr))
        return
    for row in (0, 1):
        for column in (0, 1):
            factor = bgr[mosaic[2 * ((y + row) % 2) + (x + column) % 2]]
            target[row::2, column::2] += values[row::2, column::2] * np.float32(factor)


def surplus_of(levels: Float32Array) -> Float32Array:
    """Charge beyond full scale."""
    return np.maximum(levels - 1, 0)


def bloom(levels: Float32Array, running: Float32Array) -> None:
    """Let charge run over along the columns of levels (h, w), half each way, in place.

    `running` (h, w) is the part of the surplus that runs; what stays behind is clipped with the rest.

    Going along a column, a pixel beyond full scale adds its surplus to what is carried, and one below takes what fits:
    the queue's law carried' = max(carried + surplus - room, 0), whose solution is the running sum less its least value
    so far.
    """
    columns = np.flatnonzero(running.any(axis=0))
    if len(columns) == 0:
        return
    surplus = running[:, columns].astype(np.float64) / 2
    for way in (slice(None), slice(None, None, -1)):
        room = np.maximum(1.0 - levels[way, columns], 0)
        total = np.cumsum(surplus[way] - room, axis=0)
        carried = total - np.minimum(np.minimum.accumulate(total, axis=0), 0)
        grown = np.diff(carried, axis=0, prepend=0.0)
        levels[way, columns] += (surplus[way] - grown).astype(np.float32)


def develop(sensor: SensorModel, levels: Float32Array, noise: Float32Array | None) -> ImageArray:
    """Turn levels (h, w) on the chip and standard normal noise (at least h w numbers; None: no noise) into an image.

    Electrons are Poisson; at the counts that matter (above 20) their normal approximation is used.
    """
    depth = sensor.bits if sensor.gamma == 1 else max(sensor.bits, 12)
    codes: ImageArray = np.empty(levels.shape, np.uint8) if depth == 8 else np.empty(levels.shape, np.uint16)
    rows = max(1, STRIP_SAMPLES // levels.shape[1])
    for top in range(0, len(levels), rows):
        strip = levels[top : top + rows]
        part = None if noise is None else noise[top * levels.shape[1] :][: strip.size].reshape(strip.shape)
        _quantise(sensor, strip, part, depth=depth, out=codes[top : top + rows])
    image = codes if sensor.gamma == 1 else cv2.LUT(codes, _gamma_table(sensor.gamma, sensor.black_level, sensor.bits))
    if sensor.pixel_format is PixelFormat.BGR:
        image = cv2.demosaicing(image, cv2.COLOR_BayerRGGB2BGR)
    return image  # pyright: ignore[reportReturnType] - cv2 states any dtype


def _quantise(
    sensor: SensorModel, levels: Float32Array, noise: Float32Array | None, *, depth: int, out: ImageArray
) -> None:
    """Add noise, clip at full scale, put the black level under it, round."""
    full, top = sensor.electrons_at_full_scale, (1 << depth) - 1
    if noise is not None:
        signal = np.maximum(levels, 0)
        signal *= np.float32(1 / full)
        signal += np.float32((sensor.read_noise_e / full) ** 2)
        np.sqrt(signal, out=signal)
        signal *= noise
        signal += levels
    else:
        signal = levels.copy()
    signal *= np.float32((1 - sensor.black_level) * top)
    signal += np.float32(sensor.black_level * top + 0.5)  # the cast below cuts off: half a step more rounds
    np.clip(signal, 0, top, out=signal)
    np.copyto(out, signal, casting="unsafe")


@cache
def _gamma_table(gamma: float, black_level: float, bits: int) -> ImageArray:
    """(65536,) samples of linear 12-bit (or, for 16 bits, 16-bit) codes."""
    depth = max(bits, 12)
    level = (np.arange(1 << 16, dtype=np.float64) / ((1 << depth) - 1) - black_level) / (1 - black_level)
    top = (1 << bits) - 1
    sample = np.rint((black_level + (1 - black_level) * _to_gamma(level, gamma)) * top)
    sample = np.clip(sample, 0, top)
    return sample.astype(np.uint8) if bits == 8 else sample.astype(np.uint16)


def _to_gamma(level: npt.NDArray[np.float64], gamma: float) -> npt.NDArray[np.float64]:
    slope = GAMMA_TOE ** (1 / gamma - 1)
    return np.where(level < GAMMA_TOE, slope * level, np.maximum(level, GAMMA_TOE) ** (1 / gamma))


def _from_gamma(signal: Float32Array, gamma: float) -> Float32Array:
    slope = GAMMA_TOE ** (1 / gamma - 1)
    knee = slope * GAMMA_TOE
    return np.where(signal < knee, signal / slope, np.maximum(signal, knee) ** gamma).astype(np.float32)
