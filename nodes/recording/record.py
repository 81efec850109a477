"""`spotcal record`: what a site's nodes observe goes into a recording, without a coordinator."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import zenoh

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MessageError, parse, parse_observation
from nodes.bus.keys import Keys
from nodes.bus.seal import is_intact
from nodes.bus.session import BusOptions, open_bus
from nodes.recording.schemas import address_of
from nodes.recording.writer import RecordingWriter

POLL_S = 0.2
# Some seconds of a large site; beyond that what arrives is left out and counted, and memory stays flat.
MAX_QUEUED = 100_000


@dataclass(frozen=True, slots=True)
class Arrived:
    """A message as Zenoh delivered it."""

    key: str
    payload: bytes
    seal: bytes | None
    arrival_ns: int


@dataclass(frozen=True, slots=True)
class Recorded:
    """What was recorded, and into which file."""

    path: Path
    n_rows: int
    refused: Counter[str]


class Recorder:
    """Checks what arrives, and writes it as it is.

    Args:
        writer: of the recording.
        keys: of the site.
    """

    def __init__(self, writer: RecordingWriter, keys: Keys) -> None:
        self._writer = writer
        self._keys = keys
        self.n_rows = 0
        self.refused = Counter[str]()

    def take(self, arrived: Arrived) -> None:
        """Record one message, or count why not.

        Raises:
            DeviceError: the disk is full or fails.
        """
        try:
            stamp_ns = self._stamp_ns(arrived)
        except MessageError as error:
            self.refused[error.reason] += 1
            return
        self._writer.append(arrived.key, arrived.payload, log_ns=arrived.arrival_ns, publish_ns=stamp_ns)
        self.n_rows += 1

    def _stamp_ns(self, arrived: Arrived) -> int:
        if arrived.key == self._keys.session_state:
            state = parse(pb.SessionState, arrived.payload, node=None, now_ns=arrived.arrival_ns)
            return state.header.stamp_ns
        key = address_of(arrived.key)
        if key is None:
            raise MessageError("key: of no observation")
        if not is_intact(arrived.payload, arrived.seal):
            raise MessageError("seal: broken")
        message = parse_observation(key.kind, arrived.payload, node=key.node, now_ns=arrived.arrival_ns)
        return message.header.stamp_ns


def record(bus: BusOptions, folder: Path, *, stop: threading.Event, told: Callable[[Recorder], None]) -> Recorded:
    """Record until told to stop.

    What a node published while the link was down is not asked for: a coordinator does that.

    Args:
        bus: where to listen.
        folder: for the recording; one that is there is continued.
        stop: ends it.
        told: called now and then with how far it is.

    Raises:
        DeviceError: told to stop before a router answered; or the disk is full or fails.
        InputError: another program records there, or an address that is none.
    """
    keys = Keys(bus.site)
    arrivals: queue.Queue[Arrived] = queue.Queue(MAX_QUEUED)
    overrun = Counter[str]()

    def enqueue(sample: zenoh.Sample) -> None:
        try:
            arrivals.put_nowait(_arrived(sample))
        except queue.Full:
            overrun["recorder: too much at once"] += 1

    with RecordingWriter(folder) as writer:
        recorder = Recorder(writer, keys)
        with open_bus(bus, stop=stop) as session:
            session.declare_subscriber(keys.all_observations, enqueue)
            session.declare_subscriber(keys.session_state, enqueue)
            _drain(arrivals, recorder, stop=stop, told=told)
        path = writer.close()
    return Recorded(path, recorder.n_rows, recorder.refused + overrun)


def _arrived(sample: zenoh.Sample) -> Arrived:
    attachment = sample.attachment
    seal = None if attachment is None else attachment.to_bytes()
    return Arrived(str(sample.key_expr), sample.payload.to_bytes(), seal, time.time_ns())


def _drain(
    arrivals: queue.Queue[Arrived], recorder: Recorder, *, stop: threading.Event, told: Callable[[Recorder], None]
) -> None:
    """Until it is told to stop and everything that had arrived by then is written."""
    while not stop.is_set():
        with suppress(queue.Empty):
            recorder.take(arrivals.get(timeout=POLL_S))
        if arrivals.empty() or recorder.n_rows % 100 == 0:
            told(recorder)
    for _ in range(arrivals.qsize()):
        recorder.take(arrivals.get())
