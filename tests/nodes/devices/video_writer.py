"""Videos with known samples, for tests of video files."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream

WIDTH, HEIGHT, RATE = 64, 48, 25
LOSSLESS = {
    "libx264": {"qp": "0", "preset": "ultrafast"},
    "libx265": {"x265-params": "lossless=1:log-level=none", "preset": "ultrafast"},
    "ffv1": {"level": "3", "g": "1"},
}


def picture(number: int, format_name: str, *, width: int = WIDTH, height: int = HEIGHT) -> av.VideoFrame:
    """A picture of smooth random samples over the whole range of the format, another for each number."""
    frame = av.VideoFrame(width, height, format_name)
    rng = np.random.default_rng(number)
    for index, plane in enumerate(frame.planes):
        component = min(index, len(frame.format.components) - 1)
        bits = frame.format.components[component].bits
        if format_name.startswith("bayer"):  # FFmpeg counts the share of each colour
            bits = 16 if format_name.endswith("16le") else 8
        dtype = np.dtype(np.uint8 if bits <= 8 else "<u2")
        # Formats such as P010 keep their samples in the upper bits.
        shift = 16 - bits if format_name.startswith("p0") else 0
        n_samples = plane.buffer_size // dtype.itemsize
        samples = rng.integers(0, 1 << bits, n_samples).astype(dtype) << shift
        plane.update(samples.astype(dtype).tobytes())
    return frame


def samples_of(frame: av.VideoFrame, index: int, *, width: int, height: int) -> np.ndarray:
    """One plane of a picture, read row by row, apart from the code under test."""
    plane = frame.planes[index]
    dtype = np.dtype("<u2" if frame.format.name.endswith("le") else np.uint8)
    data = bytes(plane)
    rows = [data[k * plane.line_size :][: width * dtype.itemsize] for k in range(height)]
    return np.stack([np.frombuffer(row, dtype) for row in rows])


def planar(frame: av.VideoFrame) -> np.ndarray:
    """Luma above, both chroma planes below: what a 4:2:0 picture must be delivered as."""
    width, height = frame.width, frame.height
    planes = [samples_of(frame, 0, width=width, height=height)]
    planes += [samples_of(frame, k, width=width // 2, height=height // 2) for k in (1, 2)]
    return np.concatenate([plane.ravel() for plane in planes]).reshape(-1, width)


def write_video(
    path: Path,
    pictures: Iterable[av.VideoFrame],
    *,
    codec: str = "ffv1",
    pts: Iterable[int] | None = None,
    time_base: Fraction = Fraction(1, RATE),
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
    container_format: str | None = None,
) -> None:
    """Encode pictures, without loss unless the options say otherwise."""
    frames = list(pictures)
    times = list(pts) if pts is not None else list(range(len(frames)))
    with av.open(str(path), "w", options=container_options or {}, format=container_format) as container:
        stream = container.add_stream(codec, rate=RATE, options=LOSSLESS.get(codec, {}) | (options or {}))
        assert isinstance(stream, VideoStream)
        stream.time_base = stream.codec_context.time_base = time_base
        if frames:
            stream.width, stream.height = frames[0].width, frames[0].height
            stream.pix_fmt = frames[0].format.name
        for frame, time in zip(frames, times, strict=True):
            frame.pts, frame.time_base = time, time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def pictures(format_name: str, n_frames: int, *, width: int = WIDTH, height: int = HEIGHT) -> list[av.VideoFrame]:
    """So many pictures, numbered from 0."""
    return [picture(number, format_name, width=width, height=height) for number in range(n_frames)]
