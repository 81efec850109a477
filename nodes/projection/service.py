"""The desk on the bus: three queryables, each with a thread that answers one request after the other.

Zenoh's own threads only put requests into a ring, so that nothing else on the session ever waits for an answer. When
more wait than the ring holds, the oldest are let go: their askers get no reply at once, and ask again.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import zenoh

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys
from nodes.bus.qos import encoding_of
from nodes.bus.session import BusOptions, open_bus
from nodes.projection.current import BusSource, Current, FileSource
from nodes.projection.desk import Desk
from nodes.projection.services import Service, service_key
from nodes.projection.stream import ProjectionStream

MAX_WAITING = 512
LOOK_S = 0.2
# An answer that takes longer is left behind in its thread, which does not keep the process.
LEAVE_S = 1.0
REPLIES = {
    Service.PROJECT: encoding_of(pb.ProjectReply),
    Service.LOCATE: encoding_of(pb.LocateReply),
    Service.BEARINGS: encoding_of(pb.BearingsReply),
}
ERROR = encoding_of(pb.ErrorReply)


class ProjectionService:
    """Answers for the `with` block.

    Args:
        session: open.
        keys: of the site.
        desk: that answers; the three threads may call it at the same time.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, desk: Desk) -> None:
        self._session, self._keys, self._desk = session, keys, desk
        self._queryables: list[zenoh.Queryable] = []
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> ProjectionService:
        for service in Service:
            key = service_key(self._keys, service)
            # Complete: of two services of a site, one answers.
            queryable = self._session.declare_queryable(key, zenoh.handlers.RingChannel(MAX_WAITING), complete=True)
            thread = threading.Thread(
                target=self._serve, args=(queryable.handler, service, key), name=service, daemon=True
            )
            thread.start()
            self._queryables.append(queryable)
            self._threads.append(thread)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for queryable in self._queryables:
            with suppress(zenoh.ZError):  # the session was closed first
                queryable.undeclare()
        for thread in self._threads:
            thread.join(LEAVE_S)

    def _serve(self, waiting: zenoh.handlers.Handler[zenoh.Query], service: Service, key: str) -> None:
        while True:
            try:
                query = waiting.recv()
            except zenoh.ZError:
                return  # undeclared
            # Whatever happens to one reply, its asker gone or its memory not to be had, the others get theirs.
            with query, suppress(Exception):
                self._reply(query, service, key)

    def _reply(self, query: zenoh.Query, service: Service, key: str) -> None:
        payload = query.payload
        told = self._desk.answer(service, b"" if payload is None else payload.to_bytes())
        # Replies travel as the query did: so urgent, and dropped where it would have been.
        if told.is_error:
            query.reply_err(told.payload, encoding=ERROR)
        else:
            query.reply(key, told.payload, encoding=REPLIES[service])


def run_projection(
    bus: BusOptions,
    calibration: Path | None,
    *,
    stop: threading.Event,
    say: Callable[[str], None],
    max_distance_m: float = math.inf,
) -> None:
    """Answer and stream until told to stop.

    Args:
        bus: where to.
        calibration: a calibration.json; None: what the coordinator publishes.
        stop: ends it.
        say: gets a line at the start, for each calibration that is taken over, and for each that cannot be.
        max_distance_m: a scan is streamed into cameras that some point of it is so near to.

    Raises:
        DeviceError: told to stop before a router answered.
        SpotcalError: the calibration cannot be used, the site cannot stand in a key, or an address is none.
    """
    keys, current = Keys(bus.site), Current()
    file = None if calibration is None else FileSource(calibration)
    if file is not None:
        current.take(file.first(), say)
    with open_bus(bus, stop=stop) as session:
        source = file or BusSource(session, keys)
        current.take_from(source, say)
        with (
            ProjectionStream(session, keys, current.get, max_distance_m=max_distance_m) as stream,
            ProjectionService(session, keys, Desk(current.get, stream.tilts)),
        ):
            say(f"projection service answers at {keys.base}/svc")
            while not stop.wait(LOOK_S):
                current.take_from(source, say)
