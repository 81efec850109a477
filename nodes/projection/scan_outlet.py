"""Where projected scans leave: two publishers for each camera, one for viewers, used where somebody listens."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from network_calib.errors import InputError
from nodes.bus import qos
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import BOOT_BYTES, SCHEMA
from nodes.bus.keys import Keys
from nodes.projection.foxglove_stream import scan_annotations
from nodes.projection.scan_message import ScanInCamera, read_scan

ANNOTATIONS_SCHEMA = "foxglove.ImageAnnotations"


@dataclass(frozen=True, slots=True)
class _Doors:
    scans: zenoh.Publisher
    annotations: zenoh.Publisher


class ScanOutlet:
    """Of one session. One thread at a time.

    Args:
        session: open.
        keys: of the site.
        node: that publishes.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, node: str) -> None:
        self._session, self._keys, self._node = session, keys, node
        self._boot, self._n_sent = os.urandom(BOOT_BYTES), 0
        # None: a name that cannot stand in a key. It has no stream; queries answer for it.
        self._doors: dict[str, _Doors | None] = {}

    def is_wanted(self, camera: str) -> bool:
        """Whether anybody listens to a camera."""
        doors = self._of(camera)
        return doors is not None and (_is_heard(doors.scans) or _is_heard(doors.annotations))

    def send(self, message: pb.Projection, *, longest_m: float) -> None:
        """Publish the scan in one camera; `longest_m` is the range with the last colour for viewers."""
        doors = self._of(message.camera)
        if doors is None:
            return
        message.header.CopyFrom(self.header(message.stamp_ns))
        payload = message.SerializeToString()
        if _is_heard(doors.scans):
            doors.scans.put(payload)
        if _is_heard(doors.annotations):
            doors.annotations.put(_annotations(read_scan(payload), message.stamp_ns, longest_m))

    def header(self, stamp_ns: int) -> pb.Header:
        """Of the next message."""
        header = pb.Header(schema=SCHEMA, node=self._node, boot=self._boot, sequence=self._n_sent, stamp_ns=stamp_ns)
        self._n_sent += 1
        return header

    def close(self) -> None:
        """Undeclare all publishers."""
        for doors in self._doors.values():
            if doors is not None:
                _quietly(doors.scans.undeclare)
                _quietly(doors.annotations.undeclare)
        self._doors.clear()

    def _of(self, camera: str) -> _Doors | None:
        if camera not in self._doors:
            self._doors[camera] = self._declared(camera)
        return self._doors[camera]

    def _declared(self, camera: str) -> _Doors | None:
        try:
            scans, annotations = self._keys.projection(camera), self._keys.projection_annotations(camera)
        except InputError:
            return None
        foxglove = zenoh.Encoding.APPLICATION_PROTOBUF.with_schema(ANNOTATIONS_SCHEMA)
        return _Doors(
            *(
                self._session.declare_publisher(
                    key,
                    encoding=encoding,
                    congestion_control=qos.CONGESTION,
                    priority=qos.PROJECTION.priority,
                    express=qos.PROJECTION.express,
                )
                for key, encoding in ((scans, qos.encoding_of(pb.Projection)), (annotations, foxglove))
            )
        )


def _is_heard(publisher: zenoh.Publisher) -> bool:
    # An object that is always true, though typed as bool.
    return bool(publisher.matching_status.matching)  # pyright: ignore[reportAttributeAccessIssue]


def _annotations(scan: ScanInCamera, stamp_ns: int, longest_m: float) -> bytes:
    return scan_annotations(stamp_ns, scan.px, scan.range_m, scan.is_valid, longest_m=longest_m).SerializeToString()


def _quietly(undeclare: Callable[[], object]) -> None:
    try:
        undeclare()
    except zenoh.ZError:
        return
