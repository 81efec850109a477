"""What the detector found in one camera's recording, as columns that travel between processes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from network_calib.observations import FloatArray, IntArray
from nodes.frames import StampOrigin


@dataclass(frozen=True, slots=True)
class CameraDetections:
    """F frames of one camera and K candidates in them.

    Attributes:
        name: of the camera.
        source: of what it was read from, for messages.
        size_px: width and height.
        rate_hz: nominal frames a second, None where the source does not know.
        origin: of the stamps; the worst one of the recording.
        sequence: (F,) frame numbers as the source counts.
        stamp_ns: (F,) instants of capture.
        picture: (K,) index of the frame that holds the candidate; rising, best candidate first within a frame.
        px: (K, 2).
        sigma_px: (K,) standard deviation per axis.
        score: (K,) 0..1.
        n_dropped: frames that the source knows it lost.
        advice: what may be better about the pictures, in words.
        notes: what the source says of itself, one sentence each: cut, damaged, interlaced.
    """

    name: str
    source: str
    size_px: tuple[int, int]
    rate_hz: float | None
    origin: StampOrigin
    sequence: IntArray
    stamp_ns: IntArray
    picture: IntArray
    px: FloatArray
    sigma_px: FloatArray
    score: FloatArray
    n_dropped: int = 0
    advice: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def n_frames(self) -> int:
        return len(self.sequence)

    @property
    def n_seen(self) -> int:
        """Frames with a candidate."""
        return len(np.unique(self.picture))
