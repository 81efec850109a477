"""What the coordinator says on the bus: the session's state, and the newest calibration, also to who comes late."""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from types import TracebackType
from typing import Self

import zenoh

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import BOOT_BYTES, SCHEMA
from nodes.bus.keys import Keys
from nodes.bus.qos import CONGESTION, RESULT, STATE, encoding_of
from nodes.coordinator.phases import Phase

NODE = "coordinator"
PHASES = {
    Phase.IDLE: pb.SESSION_PHASE_IDLE,
    Phase.BACKGROUND: pb.SESSION_PHASE_BACKGROUND,
    Phase.WAVING: pb.SESSION_PHASE_WAVING,
    Phase.TILTS: pb.SESSION_PHASE_TILTS,
    Phase.SOLVING: pb.SESSION_PHASE_SOLVING,
    Phase.DONE: pb.SESSION_PHASE_DONE,
    Phase.FAILED: pb.SESSION_PHASE_FAILED,
}


class Announcer:
    """For the `with` block.

    Args:
        bus: an open session.
        keys: of the site.
        session: id.
    """

    def __init__(self, bus: zenoh.Session, keys: Keys, session: str) -> None:
        self._bus, self._keys, self._session = bus, keys, session
        self._boot = os.urandom(BOOT_BYTES)
        self._sequence = 0
        self._lock = threading.Lock()
        self._calibration: bytes | None = None

    def __enter__(self) -> Self:
        self._state = self._bus.declare_publisher(
            self._keys.session_state,
            encoding=encoding_of(pb.SessionState),
            congestion_control=CONGESTION,
            priority=STATE.priority,
            express=STATE.express,
        )
        self._result = self._bus.declare_publisher(
            self._keys.calibration,
            encoding=encoding_of(pb.Calibration),
            congestion_control=CONGESTION,
            priority=RESULT.priority,
        )
        self._queryable = self._bus.declare_queryable(self._keys.calibration_service, self._answer)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._queryable.undeclare()
        self._result.undeclare()
        self._state.undeclare()

    def header(self) -> pb.Header:
        """Of the coordinator's next message, from any thread."""
        with self._lock:
            sequence, self._sequence = self._sequence, self._sequence + 1
        return pb.Header(
            schema=SCHEMA,
            node=NODE,
            boot=self._boot,
            sequence=sequence,
            stamp_ns=time.time_ns(),
            session=self._session,
        )

    def tell_state(self, phase: Phase, message: str) -> bytes:
        """Publish the state, and return what was published."""
        payload = pb.SessionState(header=self.header(), phase=PHASES[phase], message=message).SerializeToString()
        with suppress(zenoh.ZError):  # it is said again in a second
            self._state.put(payload)
        return payload

    def tell_calibration(self, calibration_id: str, json_text: bytes) -> None:
        """Publish the result, and answer with it from now on."""
        message = pb.Calibration(
            header=self.header(), id=calibration_id, is_final=True, calibration_json=json_text
        ).SerializeToString()
        with self._lock:
            self._calibration = message
        with suppress(zenoh.ZError):  # whoever asks for it gets it
            self._result.put(message)

    def _answer(self, query: zenoh.Query) -> None:
        """In Zenoh's thread; no reply means that there is no calibration yet."""
        with query, self._lock:
            if self._calibration is not None:
                query.reply(self._keys.calibration_service, self._calibration, encoding=encoding_of(pb.Calibration))
