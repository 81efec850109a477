"""Rendered cameras on disk: video or images, their stamps, and the truth beside them."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from network_calib.errors import InputError
from nodes.devices.cameras.image_folder import TABLE_NAME
from nodes.devices.errors import SourceError
from nodes.simulated.rendering.rendered_camera import RenderedCamera
from nodes.simulated.rendering.spot_truth import SpotTruth
from nodes.simulated.rendering.video_codec import VideoCodec, picture_of, rate_fraction

TRUTH_COLUMNS = (
    "frame",
    "stamp_ns",
    "x_px",
    "y_px",
    "centroid_x_px",
    "centroid_y_px",
    "is_visible",
    "visible_part",
    "peak",
    "background",
    "smear_px",
    "radius_px",
    "reflection_x_px",
    "reflection_y_px",
)


def write_video(
    camera: RenderedCamera,
    path: Path,
    *,
    codec: VideoCodec = VideoCodec.H264,
    bit_rate: int = 4_000_000,
    n_frames: int | None = None,
) -> tuple[SpotTruth, ...]:
    """Render the first frames into a video with its stamp table `name.stamps.csv` beside it.

    Args:
        camera: what is looked at.
        path: the video; its suffix names the container: `.mkv` holds every codec, `.mp4` not FFV1.
        codec: FFV1 keeps every sample.
        bit_rate: bits a second, of the codecs with loss.
        n_frames: how many at most; None: to the end of the path.

    Returns:
        The truth about each frame, in order.

    Raises:
        InputError: frames that the codec cannot hold, or no frames.
        SourceError: the file cannot be written.
    """
    from av.error import FFmpegError

    count, sensor = _count(camera, n_frames), camera.sensor
    coded_format = codec.coded_format(sensor.pixel_format, sensor.bits, camera.size_px)
    try:
        truths = _encode(camera, path, codec, bit_rate=bit_rate, coded_format=coded_format, count=count)
    except (OSError, FFmpegError) as error:
        raise SourceError(f"{path} cannot be written as {codec.value}: {error.strerror or error}") from None
    stamps = ((truth.sequence, truth.stamp_ns) for truth in truths)
    _write_csv(path.with_suffix(".stamps.csv"), ("frame", "stamp_ns"), stamps)
    return tuple(truths)


def write_images(camera: RenderedCamera, folder: Path, *, n_frames: int | None = None) -> tuple[SpotTruth, ...]:
    """Render the first frames into PNG files `frame_000000.png`, ... with their stamp table `stamps.csv`.

    Samples of more than 8 bits keep their values in 16-bit files; mosaics stay single-channel.

    Returns:
        The truth about each frame, in order.

    Raises:
        InputError: no frames.
        SourceError: the folder or a file cannot be written.
    """
    import cv2

    truths, rows = [], []
    _make_folder(folder)
    for sequence in range(_count(camera, n_frames)):
        frame, truth = camera.render(sequence)
        name = f"frame_{sequence:06d}.png"
        # The fastest level: noise does not compress, and lossless it is at every level.
        if not cv2.imwrite(str(folder / name), frame.image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
            raise SourceError(f"{folder / name} cannot be written")
        truths.append(truth)
        rows.append((name, frame.stamp_ns))
    _write_csv(folder / TABLE_NAME, ("file", "stamp_ns"), rows)
    return tuple(truths)


def write_truth(truths: Iterable[SpotTruth], path: Path) -> None:
    """Write the truth about frames as CSV, TRUTH_COLUMNS; empty cells: there is none. See `SpotTruth`."""
    _write_csv(path, TRUTH_COLUMNS, (_truth_row(truth) for truth in truths))


def _encode(
    camera: RenderedCamera, path: Path, codec: VideoCodec, *, bit_rate: int, coded_format: str, count: int
) -> list[SpotTruth]:
    """Render and encode `count` frames."""
    import av

    rate, truths = rate_fraction(camera.rate_hz), []
    with av.open(path, "w") as container:
        stream: Any = container.add_stream(codec.encoder, rate=rate, options=codec.options(is_live=False))
        stream.width, stream.height = camera.size_px
        stream.pix_fmt, stream.time_base = coded_format, 1 / rate
        if not codec.is_lossless:
            stream.bit_rate = bit_rate
        for sequence in range(count):
            frame, truth = camera.render(sequence)
            truths.append(truth)
            container.mux(stream.encode(picture_of(frame, coded_format, number=sequence, rate=rate)))
        container.mux(stream.encode(None))
    return truths


def _truth_row(truth: SpotTruth) -> tuple[object, ...]:
    reflection = (None, None) if truth.reflection_px is None else truth.reflection_px
    places = (*truth.px, *truth.centroid_px)
    numbers = (truth.visible_part, truth.peak, truth.background, truth.smear_px, truth.radius_px)
    return (
        truth.sequence,
        truth.stamp_ns,
        *map(_cell, places),
        int(truth.is_visible),
        *map(_cell, numbers),
        *map(_cell, reflection),
    )


def _cell(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.6g}" if abs(value) < 100 else f"{value:.4f}"


def _count(camera: RenderedCamera, n_frames: int | None) -> int:
    count = camera.n_frames if n_frames is None else min(n_frames, camera.n_frames)
    if count < 1:
        raise InputError(f"n_frames is {n_frames}, expected 1 or more")
    return count


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(f"{folder} cannot be made: {error.strerror}") from None


def _write_csv(path: Path, header: tuple[str, ...], rows: Iterable[tuple[object, ...]]) -> None:
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(rows)
    except OSError as error:
        raise SourceError(f"{path} cannot be written: {error.strerror}") from None
