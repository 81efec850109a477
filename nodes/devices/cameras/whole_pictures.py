"""Decoding that hands out only pictures that are what the camera saw.

After a loss a decoder goes on: it paints over, or builds on an older picture. A spot that is found there stands where
it was, not where it is, and nothing tells so. Pictures are therefore held back from a loss to the next key frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import av.error

from nodes.devices.cameras.h264_gaps import FrameNumbers

if TYPE_CHECKING:
    import av
    from av.video.codeccontext import VideoCodecContext
    from av.video.stream import VideoStream


class WholePictures:
    """The decoder of one connection.

    Args:
        codec: H.264 or H.265, not yet open.
        is_lossy: packets may be cut. The decoder then stops at any damage instead of painting over it. Not otherwise:
            it would stop at harmless faults of cheap encoders too.
    """

    def __init__(self, codec: VideoCodecContext, *, is_lossy: bool) -> None:
        self._codec = codec
        # H.265 names the pictures that each one needs, and its decoder gives nothing without them.
        self._numbers = FrameNumbers(codec.extradata) if codec.name == "h264" else None
        self._is_damaged = True
        self.n_lost = 0
        if is_lossy:
            codec.options = {**codec.options, "err_detect": "explode"}

    def frames_of(self, packet: av.Packet[VideoStream]) -> list[av.VideoFrame]:
        """The good pictures that this packet completes; `n_lost` then tells how many were not good."""
        self.n_lost = 0
        if packet.is_corrupt or (self._numbers is not None and self._numbers.is_gap_before(bytes(packet))):
            self._is_damaged = True
        try:
            decoded = self._codec.decode(packet)
        except av.error.FFmpegError:
            self._is_damaged = True
            self.n_lost = 1
            return []
        good = []
        for frame in decoded:
            self._is_damaged = frame.is_corrupt or (self._is_damaged and not frame.key_frame)
            if not self._is_damaged:
                good.append(frame)
        self.n_lost = len(decoded) - len(good)
        return good
