"""Every LRF scan projected into every camera that can see it, as it arrives, each beam with the tilt of its own time.

Cameras that nobody listens to are not projected. When the stream is late, the newest scan of each LRF wins; what was
given up is counted, and told in the status. Tilts are known from the first rest on that a node tells while the stream
runs.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING

import zenoh

from nodes.bus import qos
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind
from nodes.measured_rate import MeasuredRate
from nodes.projection.mailbox import Letter, Mailbox
from nodes.projection.scan_desk import ScanDesk, StreamCounts
from nodes.projection.scan_outlet import ScanOutlet
from nodes.projection.tilt_table import TiltTable

if TYPE_CHECKING:
    from nodes.projection.calibration import Calibration

HEARD = (Kind.LRF_INFO, Kind.TILT, Kind.TILTS, Kind.IMU, Kind.EVENT)
WAIT_S = 0.2
STATUS_S = 1.0
CLOSE_S = 2.0


class ProjectionStream:
    """Of one site; `with`, or `start` and `close`.

    Args:
        session: open; it reconnects by itself.
        keys: of the site.
        current: the calibration to use now; None while there is none. A new one is taken with the next scan.
        node: the name under which headers and status go.
        tilts: filled from the bus; may be shared with who answers queries.
        max_distance_m: cameras that no point of a scan is so near to are left out: nothing here knows the walls
            that a camera of another room would see the scan through.
        clock_ns: this machine's clock.

    Attributes:
        tilts: of all LRFs, for any thread.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        current: Callable[[], Calibration | None],
        *,
        node: str = "projection",
        tilts: TiltTable | None = None,
        max_distance_m: float = math.inf,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.tilts = tilts or TiltTable()
        self._session, self._keys, self._node, self._clock_ns = session, keys, node, clock_ns
        self._desk = ScanDesk(current, self.tilts, clock_ns, max_distance_m=max_distance_m)
        self._outlet = ScanOutlet(session, keys, node)
        self._mailbox, self._rate = Mailbox(), MeasuredRate()
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="projection stream", daemon=True)

    def __enter__(self) -> ProjectionStream:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def start(self) -> None:
        """Subscribe, and begin."""
        self._thread.start()
        self._subscribe(Kind.LRF_SCAN, self._mailbox.put_scan)
        for kind in HEARD:
            self._subscribe(kind, self._mailbox.put)

    def close(self) -> None:
        """Stop, in bounded time."""
        self._stop.set()
        self._mailbox.wake()
        for subscriber in self._subscribers:
            try:
                subscriber.undeclare()
            except zenoh.ZError:
                continue
        self._subscribers.clear()
        if self._thread.is_alive():
            self._thread.join(CLOSE_S)

    def counts(self) -> StreamCounts:
        """Since the begin; for any thread."""
        return replace(self._desk.counts, n_dropped=self._mailbox.n_replaced)

    def _subscribe(self, kind: Kind, put: Callable[[str, bytes], None]) -> None:
        def come(sample: zenoh.Sample) -> None:
            put(str(sample.key_expr), sample.payload.to_bytes())

        # The callback only enqueues, so it may run in Zenoh's own thread: one thread less for each.
        handler = zenoh.handlers.Callback(come, indirect=False)
        self._subscribers.append(self._session.declare_subscriber(self._keys.observations_of(kind), handler))

    def _run(self) -> None:
        tell = self._session.declare_publisher(
            self._keys.status(self._node),
            encoding=qos.encoding_of(pb.NodeStatus),
            congestion_control=qos.CONGESTION,
            priority=qos.STATUS.priority,
        )
        next_status_s = time.monotonic()
        while not self._stop.is_set():
            try:
                self._work()
                if time.monotonic() >= next_status_s:
                    next_status_s = time.monotonic() + STATUS_S
                    tell.put(self._status().SerializeToString())
            except zenoh.ZError:
                self._stop.wait(WAIT_S)
        self._outlet.close()

    def _work(self) -> None:
        come = self._mailbox.collect(WAIT_S)
        for letter in come.others:
            self._desk.take(letter.key, letter.payload)
        for letter in come.scans:
            self._rate.note(time.monotonic())
            self._project(letter)

    def _project(self, scan: Letter) -> None:
        try:
            for message in self._desk.project(scan.key, scan.payload, is_wanted=self._outlet.is_wanted):
                self._outlet.send(message, longest_m=self._desk.longest_m(message.lrf))
        except zenoh.ZError:
            raise
        except Exception:  # one scan that no one foresaw must not end the stream for all cameras
            self._desk.fail()

    def _status(self) -> pb.NodeStatus:
        counts = self.counts()
        return pb.NodeStatus(
            header=self._outlet.header(self._clock_ns()),
            role="projection",
            state="projecting" if counts.n_projected else "waiting",
            message=trouble(counts),
            rate_hz=self._rate.rate_hz(time.monotonic()),
            n_frames=counts.n_scans,
            n_detections=counts.n_projected,
            n_dropped=counts.n_dropped,
        )


def trouble(counts: StreamCounts) -> str:
    """What a person should know, in one line; empty when all is well."""
    told = (
        (counts.n_dropped, "scans dropped: they come faster than they can be projected"),
        (counts.n_without_tilt, "scans without a known tilt: an LRF tells it when it comes to rest"),
        (counts.n_without_info, "scans of an LRF that has not told its steps: it does when a session begins"),
        (counts.n_uncalibrated, "scans of an LRF that no calibration holds"),
        (counts.n_refused, "messages refused"),
        (counts.n_failed, "scans that could not be projected: a fault of this program"),
    )
    return "; ".join(f"{n} {what}" for n, what in told if n)
