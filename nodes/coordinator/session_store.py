"""What was received: written down first, then counted; and read back when a session goes on."""

from __future__ import annotations

import threading
from pathlib import Path

from nodes.bus.checks import MessageError, parse_observation
from nodes.bus.keys import parse_observation as parse_key
from nodes.bus.ledger import Ledger
from nodes.camera.camera_detections import CameraDetections
from nodes.coordinator.coverage import CameraSeen, Coverage, LrfSeen
from nodes.coordinator.received import Received
from nodes.coordinator.sufficiency import Overlaps, overlaps_of
from nodes.recording.reader import rows
from nodes.recording.writer import RecordingWriter

# Rows of a recording were held to their time when they came.
_ANY_TIME_NS = 2**62


class SessionStore:
    """Recording and coverage of one session; `take` may be called from any thread.

    Args:
        writer: of the session's folder.
    """

    def __init__(self, writer: RecordingWriter) -> None:
        self.coverage = Coverage()
        self.n_rows = 0
        self.n_late = 0
        self._writer = writer
        self._lock = threading.Lock()
        self._is_closed = False

    def take(self, received: Received) -> None:
        """Record and count a row; the ingest gives each only once.

        Raises:
            DeviceError: it could not be written.
        """
        with self._lock:
            if self._is_closed:
                self.n_late += 1
                return
            stamp_ns = received.message.header.stamp_ns
            self._writer.append(received.key, received.payload, log_ns=received.arrival_ns, publish_ns=stamp_ns)
            self.n_rows += 1
            self.coverage.add(received.message, node=received.node)

    def note(self, key: str, payload: bytes, *, stamp_ns: int) -> None:
        """Record something of the coordinator's own, such as a change of state."""
        with self._lock:
            if not self._is_closed:
                self._writer.append(key, payload, log_ns=stamp_ns, publish_ns=stamp_ns)

    def restore(self, folder: Path) -> Ledger:
        """Count what an earlier run recorded, and say which rows these are."""
        ledger = Ledger()
        with self._lock:
            for row in rows(folder):
                key = parse_key(row.key)
                if key is None:
                    continue
                try:
                    message = parse_observation(key.kind, row.payload, node=key.node, now_ns=_ANY_TIME_NS)
                except MessageError:
                    continue
                if ledger.insert(key.node, message.header.boot, message.header.sequence):
                    self.n_rows += 1
                    self.coverage.add(message, node=key.node)
        return ledger

    def cameras(self) -> tuple[CameraSeen, ...]:
        """What each camera has seen; the figures go on changing."""
        with self._lock:
            return tuple(self.coverage.cameras.values())

    def lrfs(self) -> tuple[LrfSeen, ...]:
        """What each LRF has given; likewise."""
        with self._lock:
            return tuple(self.coverage.lrfs.values())

    def overlaps(self) -> Overlaps:
        """As of now; holds up the receiving for as long as it takes."""
        with self._lock:
            return overlaps_of(self.coverage)

    def detections(self) -> tuple[tuple[CameraDetections, ...], int]:
        """What the solve takes, and of how many instants one was kept."""
        with self._lock:
            return self.coverage.detections(), self.coverage.stride

    def close(self) -> Path:
        """End the recording; what comes afterwards is counted as late."""
        with self._lock:
            self._is_closed = True
        return self._writer.close()
