"""`spotcal replay`: a recording goes into the bus as if it were live: same keys, payloads unchanged."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import zenoh
from rich.console import Console

from nodes.bus import qos
from nodes.bus.keys import parse_observation, parse_status
from nodes.bus.seal import seal
from nodes.bus.session import BusOptions, open_bus
from nodes.recording.reader import Row, rows
from nodes.recording.schemas import message_type_of

NS = 10**9
# With nobody holding it back a publisher overruns its own queue, and DROP drops. So many at once fit into the queue
# of one priority (2 batches of 64 KiB); a pause lets it run empty.
BURST_BYTES, BURST_PAUSE_S = 32 * 2**10, 0.002
# How long the last messages may take to leave the process before the session is closed.
LINGER_S = 0.3


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How to replay.

    Attributes:
        path: of the recording.
        bus: where to.
        speed: 2 is twice as fast as it was; 0: as fast as possible.
    """

    path: Path
    bus: BusOptions
    speed: float = 1.0


@dataclass(frozen=True, slots=True)
class Replayed:
    """What was published.

    Attributes:
        n_rows: of the recording.
        n_published: of them, before the end or the interruption.
    """

    n_rows: int
    n_published: int


def replay(options: ReplayOptions, *, stop: threading.Event, console: Console) -> Replayed:
    """Publish all rows in the order of their stamps, at their pace.

    All rows are held in memory: a recording is ordered by arrival, and late rows stand far behind.

    Args:
        options: what, where and how fast.
        stop: ends it early.
        console: shows how far it is.

    Raises:
        InputError: nothing there, no recording, or an address that is none.
        DeviceError: told to stop before a router answered.
    """
    from rich.progress import Progress

    ordered = in_time(options.path)
    n_published = 0
    with open_bus(options.bus, stop=stop) as session, Progress(console=console, transient=True) as progress:
        bar = progress.add_task("replay", total=len(ordered))
        publishers = _Publishers(session)
        for row in paced(ordered, speed=options.speed, wait=stop.wait):
            publishers.put(row)
            n_published += 1
            progress.update(bar, completed=n_published)
        stop.wait(LINGER_S)
    return Replayed(len(ordered), n_published)


def in_time(path: Path) -> list[Row]:
    """The rows of the bus in a recording, by their stamps.

    Raises:
        InputError: nothing there, or no recording.
    """
    known = (row for row in rows(path) if message_type_of(row.key) is not None)
    return sorted(known, key=lambda row: row.publish_ns)


def paced(
    ordered: Sequence[Row],
    *,
    speed: float,
    wait: Callable[[float], bool],
    clock_s: Callable[[], float] = time.monotonic,
) -> Iterator[Row]:
    """Rows when their time has come.

    Args:
        ordered: by their stamps.
        speed: 0: at once, with a pause after every burst.
        wait: sleeps so many seconds; true when it was told to stop, which ends the rows.
        clock_s: of the pace.
    """
    begin_s, n_bytes = clock_s(), 0
    for row in ordered:
        pause_s = 0.0
        if speed > 0:
            pause_s = begin_s + (row.publish_ns - ordered[0].publish_ns) / NS / speed - clock_s()
        elif n_bytes > BURST_BYTES:
            pause_s, n_bytes = BURST_PAUSE_S, 0
        if wait(max(pause_s, 0.0)):
            return
        n_bytes += len(row.payload)
        yield row


class _Publishers:
    """One publisher for each key, declared when first needed."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._of_key: dict[str, zenoh.Publisher] = {}

    def put(self, row: Row) -> None:
        publisher = self._of_key.get(row.key)
        if publisher is None:
            publisher = self._of_key[row.key] = self._declared(row.key)
        publisher.put(row.payload, attachment=None if parse_observation(row.key) is None else seal(row.payload))

    def _declared(self, key: str) -> zenoh.Publisher:
        message_type = message_type_of(key)
        kind = _qos_of(key)
        return self._session.declare_publisher(
            key,
            encoding=None if message_type is None else qos.encoding_of(message_type),
            congestion_control=qos.CONGESTION,
            priority=kind.priority,
            express=kind.express,
        )


def _qos_of(key: str) -> qos.Qos:
    if parse_observation(key) is not None:
        return qos.OBSERVATION
    if parse_status(key) is not None:
        return qos.STATUS
    return qos.STATE if key.endswith("/session/state") else qos.RESULT
