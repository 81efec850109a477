"""Frames that were watched, gathered into messages of 50 to 100 ms: no frame is lost or stands in two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nodes.bus import spotcal_pb2 as pb
from nodes.camera.detect_camera import MAX_SIGMA_PX
from nodes.detection.spots import Spot
from nodes.frames import Frame, StampOrigin

MAX_BATCH_FRAMES = 1024
_ORIGINS = {
    StampOrigin.CAMERA: pb.STAMP_ORIGIN_CAMERA,
    StampOrigin.DRIVER: pb.STAMP_ORIGIN_DRIVER,
    StampOrigin.TABLE: pb.STAMP_ORIGIN_TABLE,
    StampOrigin.FILE: pb.STAMP_ORIGIN_FILE,
    StampOrigin.ARRIVAL: pb.STAMP_ORIGIN_ARRIVAL,
    StampOrigin.ORDER: pb.STAMP_ORIGIN_ORDER,
}


@dataclass(frozen=True, slots=True)
class BatchOptions:
    """What all messages of a camera have in common.

    Attributes:
        camera: its name.
        rate_hz: nominal frames a second; 0 where it is not known.
        span_ns: frames of so long travel together.
    """

    camera: str
    rate_hz: float
    span_ns: int


class SpotBatcher:
    """Gathers frames until a message is full."""

    def __init__(self, options: BatchOptions) -> None:
        self._options = options
        # Half a period early: the next frame would come too late to stay within the span.
        self._slack_ns = round(0.5e9 / options.rate_hz) if options.rate_hz > 0 else 0
        self._batch: pb.SpotBatch | None = None
        self._origin: StampOrigin | None = None

    def add(self, frame: Frame, spots: Sequence[Spot], *, n_dropped: int) -> list[pb.SpotBatch]:
        """One more frame; the messages that are full now.

        Args:
            frame: that was watched.
            spots: in it, best first.
            n_dropped: frames that the source knows it lost, so far.
        """
        full = self.flush() if self._is_other(frame) else []
        batch = self._batch = self._batch or self._begun(frame)
        row = len(batch.frame_sequence)
        batch.frame_sequence.append(frame.sequence)
        batch.frame_stamp_ns.append(frame.stamp_ns)
        batch.n_dropped = n_dropped
        for spot in spots:
            if _is_worth(spot, frame.size_px):
                batch.spot_frame.append(row)
                batch.x_px.append(float(spot.px[0]))
                batch.y_px.append(float(spot.px[1]))
                batch.sigma_px.append(spot.sigma_px)
                batch.score.append(min(max(spot.score, 0.0), 1.0))
        span_ns = frame.stamp_ns - batch.frame_stamp_ns[0]
        if span_ns + self._slack_ns >= self._options.span_ns or row + 1 >= MAX_BATCH_FRAMES:
            full += self.flush()
        return full

    def flush(self) -> list[pb.SpotBatch]:
        """What there is, full or not."""
        batch, self._batch = self._batch, None
        return [] if batch is None else [batch]

    def _begun(self, frame: Frame) -> pb.SpotBatch:
        width_px, height_px = frame.size_px
        self._origin = frame.origin
        return pb.SpotBatch(
            camera=self._options.camera,
            width_px=width_px,
            height_px=height_px,
            rate_hz=self._options.rate_hz,
            origin=_ORIGINS[frame.origin],
        )

    def _is_other(self, frame: Frame) -> bool:
        """Whether a frame cannot stand behind the last one in a message."""
        if self._batch is None:
            return False
        batch, size_px = self._batch, (self._batch.width_px, self._batch.height_px)
        is_behind = frame.sequence <= batch.frame_sequence[-1]
        return is_behind or frame.origin is not self._origin or frame.size_px != size_px


def _is_worth(spot: Spot, size_px: tuple[int, int]) -> bool:
    """Whether a candidate tells a calibration anything; a fit may also place it beyond the picture's edge."""
    is_inside = all(-0.5 <= x <= side - 0.5 for x, side in zip(spot.px, size_px, strict=True))
    return is_inside and 1e-6 <= spot.sigma_px <= MAX_SIGMA_PX
