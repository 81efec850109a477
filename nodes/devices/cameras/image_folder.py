"""Folders of images as frame sources."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from nodes.closing import Closing
from nodes.devices.cameras.image_names import NumberedImage, Numbering, numbered_images
from nodes.devices.cameras.image_read import DamagedImageError, read_image
from nodes.devices.cameras.source_info import SourceInfo
from nodes.devices.cameras.stamp_table import ImageStamps, read_image_stamps
from nodes.devices.cameras.tally import FrameTally
from nodes.devices.errors import SourceError
from nodes.frames import Frame, ImageArray, PixelFormat, SourceCounts, StampOrigin

TABLE_NAME = "stamps.csv"
_ASSUMED_RATE_HZ = 25.0
_BAYER = (PixelFormat.BAYER_RGGB, PixelFormat.BAYER_GRBG, PixelFormat.BAYER_GBRG, PixelFormat.BAYER_BGGR)


@dataclass(frozen=True, slots=True)
class ImageOptions:
    """How a folder of images is read.

    Attributes:
        numbering: what the numbers in the names mean.
        stamp_table: CSV with the instants of capture; None: `stamps.csv` in the folder, if there.
        rate_hz: frame numbers a second, for stamps where nothing tells them; None: 25.
        bits: significant bits of 16-bit samples: 10, 12 or 16.
        mosaic: what single-channel images hold: MONO, or the order of a Bayer mosaic.
        skip_damaged: count images that cannot be read as dropped, instead of ending with an error.
    """

    numbering: Numbering = Numbering.FRAME
    stamp_table: Path | None = None
    rate_hz: float | None = None
    bits: int = 16
    mosaic: PixelFormat = PixelFormat.MONO
    skip_damaged: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            InputError: names the option, its value and what was expected.
        """
        if self.bits not in (10, 12, 16):
            raise InputError(f"images: bits = {self.bits}, expected 10, 12 or 16")
        if self.mosaic not in (PixelFormat.MONO, *_BAYER):
            raise InputError(f"images: mosaic = {self.mosaic.value}, expected mono or one of the Bayer mosaics")
        if self.rate_hz is not None and not (0 < self.rate_hz < math.inf):
            raise InputError(f"images: rate_hz = {self.rate_hz}, expected a number > 0")


class ImageFolder(Closing):
    """Images of one camera, one file a frame, read one after the other. Every iteration starts at the first.

    `sequence` is the number in the file's name; where all numbers step by more than one, the common step is no loss.
    Stamps come from a table (TABLE), from the names (TABLE), or are number over rate (ORDER).

    Attributes:
        is_recording: iterating anew starts anew.
    """

    is_recording = True

    def __init__(self, folder: Path, options: ImageOptions | None = None, *, pattern: str | None = None) -> None:
        """Open whole or not at all: the names of all images are checked, and the first image is read.

        Args:
            folder: with the images.
            options: how they are read.
            pattern: of the names of this camera's images, where others stand beside them.

        Raises:
            SourceError: no folder, no images, names without one number each, the first image cannot be read.
            InputError: the stamp table does not fit.
        """
        self._folder, self._pattern, self._options = folder, pattern, options or ImageOptions()
        self._is_closed = False
        self._images = numbered_images(folder, pattern, self._options.numbering)
        self._stamps_ns, self._origin = _stamps(folder, self._images, self._options)
        numbers = np.array([image.number for image in self._images])
        self._step = int(np.gcd.reduce(np.diff(numbers))) or 1 if len(numbers) > 1 else 1
        self._shape, self._dtype, self._format = self._look_at_first()
        self._tally = FrameTally(self.rate_hz)

    @property
    def name(self) -> str:
        return self._folder.name if self._pattern is None else f"{self._folder.name}/{self._pattern}"

    @property
    def size_px(self) -> tuple[int, int]:
        return self._shape[1], self._shape[0]

    @property
    def rate_hz(self) -> float | None:
        """As told by the options, else the median of the stamps' steps; None where neither is there."""
        if self._options.rate_hz is not None or self._origin is StampOrigin.ORDER or len(self._stamps_ns) < 2:
            return self._options.rate_hz
        return 1e9 / float(np.median(np.diff(self._stamps_ns)))

    @property
    def counts(self) -> SourceCounts:
        """Of the latest iteration."""
        return self._tally.counts

    @property
    def info(self) -> SourceInfo:
        is_timed = self._origin is not StampOrigin.ORDER
        note = f"{self.name} has no times: stamps are frame number over rate"
        return SourceInfo(
            name=self.name,
            kind="images",
            size_px=self.size_px,
            rate_hz=self.rate_hz,
            duration_s=(self._stamps_ns[-1] - self._stamps_ns[0]) / 1e9 if is_timed else None,
            n_frames=len(self._images),
            codec=Path(self._images[0].name).suffix.lstrip(".").lower(),
            pixel_format=self._format,
            bits=self._bits(self._dtype),
            stamp_origin=self._origin,
            notes=() if is_timed else (note,),
        )

    def __iter__(self) -> Iterator[Frame]:
        if self._is_closed:
            raise SourceError(f"{self.name} is closed")
        tally = self._tally = FrameTally(self.rate_hz)
        last_number = self._images[0].number - self._step
        for image, stamp_ns in zip(self._images, self._stamps_ns, strict=True):
            if self._is_closed:
                return
            tally.drop((image.number - last_number) // self._step - 1)
            last_number = image.number
            try:
                array, pixel_format = self._read(image)
            except DamagedImageError:
                if not self._options.skip_damaged:
                    raise
                tally.drop()
                continue
            tally.deliver(stamp_ns)
            yield Frame(image.number, stamp_ns, self._origin, array, pixel_format, self._bits(array.dtype))

    def _read(self, image: NumberedImage) -> tuple[ImageArray, PixelFormat]:
        path = self._folder / image.name
        array, pixel_format = read_image(path)
        if array.shape != self._shape or array.dtype != self._dtype:
            raise SourceError(
                f"{path} is {_kind(array.shape, array.dtype)}, expected {_kind(self._shape, self._dtype)} "
                "like the images before it",
                advice="Images of different cameras or settings belong into folders of their own.",
            )
        if array.dtype == np.uint16 and array.max() >= 1 << self._options.bits:
            raise SourceError(
                f"{path} holds the value {array.max()}, expected less than {1 << self._options.bits} "
                f"for bits = {self._options.bits}",
                advice="Correct the option bits.",
            )
        return array, self._options.mosaic if pixel_format is PixelFormat.MONO else pixel_format

    def _look_at_first(self) -> tuple[tuple[int, ...], np.dtype, PixelFormat]:
        """Shape, type and format of the first image that can be read; all others must have them."""
        for image in self._images:
            try:
                array, pixel_format = read_image(self._folder / image.name)
            except DamagedImageError:
                if not self._options.skip_damaged:
                    raise
                continue
            mosaic = self._options.mosaic if pixel_format is PixelFormat.MONO else pixel_format
            return array.shape, array.dtype, mosaic
        raise SourceError(f"{self._folder}: none of its {len(self._images)} images can be read")

    def _bits(self, dtype: np.dtype) -> int:
        return 8 if dtype == np.uint8 else self._options.bits

    def close(self) -> None:
        """End every iteration at its next frame."""
        self._is_closed = True


def _stamps(
    folder: Path, images: tuple[NumberedImage, ...], options: ImageOptions
) -> tuple[tuple[int, ...], StampOrigin]:
    """The stamp of each image, and where they come from."""
    table = options.stamp_table
    if table is None and (folder / TABLE_NAME).is_file():
        table = folder / TABLE_NAME
    if table is not None:
        return _table_stamps(read_image_stamps(table), images), StampOrigin.TABLE
    if options.numbering is Numbering.STAMP_NS:
        return tuple(image.stamp_ns or 0 for image in images), StampOrigin.TABLE
    rate = Fraction(options.rate_hz or _ASSUMED_RATE_HZ)
    return tuple(round(image.number * 10**9 / rate) for image in images), StampOrigin.ORDER


def _table_stamps(table: ImageStamps, images: tuple[NumberedImage, ...]) -> tuple[int, ...]:
    rows = [table.row(image.name, image.number) for image in images]
    for (_, stamp_ns), (line, next_ns), image in zip(rows, rows[1:], images[1:], strict=False):
        if next_ns <= stamp_ns:
            raise InputError(
                f"{table.path}, line {line}, column stamp_ns: {next_ns} for {image.name}, "
                f"expected more than {stamp_ns} of the image before it"
            )
    return tuple(stamp_ns for _, stamp_ns in rows)


def _kind(shape: tuple[int, ...], dtype: np.dtype) -> str:
    colour = "grey" if len(shape) == 2 else "colour"
    return f"{shape[1]} x {shape[0]}, {colour}, {8 * dtype.itemsize} bits"
