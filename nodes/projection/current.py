"""The calibration that the service answers under, and where new ones come from: a file, or the bus.

A new calibration takes the place of the old one between two requests; each request is answered under one of them. It
is read and prepared first, while the old one answers.
"""

from __future__ import annotations

import tempfile
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import numpy as np
import zenoh

from network_calib.errors import InputError, SpotcalError
from network_calib.formats.calibration_json import load
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MessageError, parse
from nodes.bus.keys import Keys
from nodes.bus.qos import CONGESTION, RESULT
from nodes.projection.calibration import Calibration
from nodes.projection.points import Beams

# What is published may be lost, and a coordinator that starts again knows of one: so it is asked for now and then.
ASK_EVERY_S = 5.0
ASK_TIMEOUT_S = 2.0


class Source(Protocol):
    """Where calibrations come from."""

    def poll(self) -> Calibration | None:
        """One that was not given before, if there is any.

        Raises:
            SpotcalError: there is one, and it cannot be used; told once.
        """
        ...


class Current:
    """The calibration in force; for any thread."""

    def __init__(self) -> None:
        self._calibration: Calibration | None = None

    def get(self) -> Calibration | None:
        """The calibration to answer a whole request under; None: there is none yet."""
        return self._calibration

    def take_from(self, source: Source, say: Callable[[str], None]) -> None:
        """Take over what a source has; what cannot be used is told, and the one before stays in force."""
        try:
            calibration = source.poll()
        except SpotcalError as error:
            kept = self._calibration
            say(f"refused: {error.message}" + ("" if kept is None else f"; calibration {kept.id} stays in force"))
            return
        if calibration is not None:
            self.take(calibration, say)

    def take(self, calibration: Calibration, say: Callable[[str], None]) -> None:
        """Take over a calibration."""
        _prepare(calibration)
        self._calibration = calibration
        n_cameras, n_lrfs = len(calibration.camera_names), len(calibration.lrf_names)
        say(f"answers under calibration {calibration.id}: {n_cameras} cameras, {n_lrfs} LRFs")


def _prepare(calibration: Calibration) -> None:
    """Let it set up what the first request of each LRF would have to wait for."""
    for lrf in calibration.lrf_names:
        calibration.project(Beams(lrf, np.ones(1), np.zeros(1), tilt_rad=0.0))


class FileSource:
    """A calibration.json, looked at again and again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, ...] | None = None

    def first(self) -> Calibration:
        """The one to begin with.

        Raises:
            SpotcalError: there is none, or it cannot be used.
        """
        calibration = self.poll()
        if calibration is None:
            raise InputError(f"{self._path}: no such file", advice="Expected a calibration.json.")
        return calibration

    def poll(self) -> Calibration | None:
        """See `Source`. A file that is away is one that is being replaced.

        Raises:
            SpotcalError: as in `Source`.
        """
        try:
            state = self._path.stat()
        except FileNotFoundError:
            return None
        seen = state.st_mtime_ns, state.st_size, state.st_ino
        if seen == self._seen:
            return None
        self._seen = seen
        return Calibration.load(self._path)


class BusSource:
    """The coordinator's newest calibration.

    Args:
        session: open; calibrations are subscribed to as long as it is.
        keys: of the site.
    """

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._session, self._keys = session, keys
        self._arrived: deque[bytes] = deque(maxlen=4)
        self._asked_s = -np.inf
        self._id, self._stamp_ns = "", 0
        self._subscriber = session.declare_subscriber(keys.calibration, self._hear)

    def _hear(self, sample: zenoh.Sample) -> None:
        self._arrived.append(sample.payload.to_bytes())

    def poll(self) -> Calibration | None:
        """See `Source`.

        Raises:
            SpotcalError: as in `Source`.
        """
        if time.monotonic() - self._asked_s > ASK_EVERY_S:
            self._asked_s = time.monotonic()
            with suppress(zenoh.ZError):  # the session is closing, or not connected: asked again later
                self._session.get(
                    self._keys.calibration_service,
                    lambda reply: None if reply.ok is None else self._hear(reply.ok),
                    timeout=ASK_TIMEOUT_S,
                    congestion_control=CONGESTION,
                    priority=RESULT.priority,
                )
        while self._arrived:
            message = self._checked(self._arrived.popleft())
            if message.id == self._id or message.header.stamp_ns < self._stamp_ns:
                continue
            self._id, self._stamp_ns = message.id, message.header.stamp_ns
            return _calibration_of(message)
        return None

    @staticmethod
    def _checked(payload: bytes) -> pb.Calibration:
        try:
            return parse(pb.Calibration, payload, node=None, now_ns=time.time_ns())
        except MessageError as error:
            raise InputError(f"a calibration on the bus: {error.reason}") from None


def _calibration_of(message: pb.Calibration) -> Calibration:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "calibration.json")
        path.write_bytes(message.calibration_json)
        try:
            return Calibration.of(load(path), message.id)
        except InputError as error:
            raise InputError(f"calibration {message.id!r:.80} on the bus: {error.message}") from None
