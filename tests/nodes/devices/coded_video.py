"""Coded pictures for tests: packets of a video with a bright spot that moves evenly."""

from __future__ import annotations

from fractions import Fraction
from typing import cast

import av
import numpy as np

WIDTH, HEIGHT, STEP_PX, SPOT_PX = 320, 240, 4, 8


def spot_left_px(number: int) -> int:
    """Where the spot of a picture begins."""
    return 20 + STEP_PX * number


def coded(encoder: str, n_frames: int, *, gop: int, options: dict[str, str] | None = None) -> list[bytes]:
    """A packet for each picture, in Annex B."""
    codec = av.CodecContext.create(encoder, "w")
    assert isinstance(codec, av.VideoCodecContext)
    codec.width, codec.height, codec.pix_fmt, codec.time_base = WIDTH, HEIGHT, "yuv420p", Fraction(1, 25)
    codec.gop_size = gop
    codec.options = {"preset": "ultrafast", "tune": "zerolatency", **(options or {})}
    background = np.random.default_rng(3).integers(20, 60, (HEIGHT, WIDTH), dtype=np.uint8)
    packets: list[bytes] = []
    for number in range(n_frames):
        image = np.full((HEIGHT * 3 // 2, WIDTH), 128, np.uint8)
        image[:HEIGHT] = background
        left = spot_left_px(number)
        image[100 : 100 + SPOT_PX, left : left + SPOT_PX] = 250
        frame = av.VideoFrame.from_ndarray(image, format="yuv420p")
        frame.pts = number
        packets += map(bytes, codec.encode(frame))
    return packets + [bytes(packet) for packet in codec.encode(None)]


def packet_of(data: bytes, number: int) -> av.Packet[av.VideoStream]:
    """A packet whose presentation time is the number of its picture."""
    packet = cast("av.Packet[av.VideoStream]", av.Packet(data))
    packet.pts = packet.dts = number
    return packet


def spot_error_px(frame: av.VideoFrame) -> float:
    """How far the bright columns of a picture lie from where its spot was drawn."""
    assert frame.pts is not None
    columns = np.flatnonzero(frame.to_ndarray()[100 : 100 + SPOT_PX].mean(axis=0) > 150)
    truth_px = spot_left_px(frame.pts) + (SPOT_PX - 1) / 2
    return float(abs(np.median(columns) - truth_px)) if len(columns) else np.inf
