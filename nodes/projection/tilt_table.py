"""The tilts of all LRFs of a site, for any thread: what comes over the bus goes in, what a beam needs comes out."""

from __future__ import annotations

import threading

import numpy as np
import numpy.typing as npt

from network_calib.observations import FloatArray
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import Observation
from nodes.lrf.acquisition import Phase
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.tilt_track import TiltTrack

MAX_LRFS = 1024


class TiltTable:
    """Of all LRFs."""

    def __init__(self) -> None:
        self._tracks: dict[str, TiltTrack] = {}
        # A node tells that it moves without saying which LRF: it has one.
        self._lrf_of_node: dict[str, str] = {}
        self._lock = threading.Lock()

    def take(self, message: Observation) -> None:
        """An observation that was checked; what says nothing about a tilt is passed over."""
        with self._lock:
            match message:
                case pb.TiltSample():
                    self._track(message).rest(message)
                case pb.TiltSettings():
                    self._track(message).settle(message)
                case pb.ImuBatch():
                    self._track(message).turn(message)
                case pb.NodeEvent(text=Phase.MOVING):
                    track = self._tracks.get(self._lrf_of_node.get(message.header.node, ""))
                    if track is not None:
                        track.leave(message.header.stamp_ns)
                case _:
                    pass

    def at(self, lrf: str, stamp_ns: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Tilts and their standard deviations at times (N,) of the LRF node's clock, rad; NaN where not known.

        Raises:
            ProjectionError: NO_TILT: it is known at none of the times.
        """
        with self._lock:
            track = self._tracks.get(lrf)
            tilt_rad, sigma_rad = (np.empty(0), np.empty(0)) if track is None else track.at(stamp_ns)
        if not np.isfinite(tilt_rad).any():
            why = "its node has told none" if track is None else "it moved, or it is not in what was kept"
            raise ProjectionError(
                ErrorCode.NO_TILT,
                f"the tilt of {lrf} at that time is not known: {why}",
                "give tilt_rad in place of stamp_ns",
            )
        return tilt_rad, sigma_rad

    def _track(self, message: pb.TiltSample | pb.TiltSettings | pb.ImuBatch) -> TiltTrack:
        self._lrf_of_node[message.header.node] = message.lrf
        if message.lrf not in self._tracks and len(self._tracks) >= MAX_LRFS:
            del self._tracks[next(iter(self._tracks))]
        return self._tracks.setdefault(message.lrf, TiltTrack())
