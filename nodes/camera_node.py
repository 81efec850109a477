"""`spotcal camera`: a node with one or several cameras. It finds the spot, and publishes points, never video."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from threadpoolctl import threadpool_limits

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.host_clock import clock_quality
from nodes.bus.host_temperature import temperature_c
from nodes.bus.keys import Kind, Role, Verb
from nodes.bus.node import BusNode
from nodes.camera.camera_worker import CameraWorker, stop_all, told
from nodes.camera.feeds import Feed, open_feed
from nodes.camera.live_camera import IDLE, LiveCamera, Resumed
from nodes.camera.session_marks import SessionMarks
from nodes.camera.spot_batches import BatchOptions
from nodes.detection.spots import Channel, DetectorOptions, DetectorState
from nodes.detector_settings import read_mask
from nodes.journal import Journal
from nodes.site.bus_options import bus_options
from nodes.site.model import CameraNodeConfig, CameraSourceConfig

TICK_S = 0.1
SNAPSHOT_S = 2.0
# A camera that delivers nothing for so long is told of; presence is withdrawn a little later.
SILENT_S = 2.0
# A fault is told on the bus before the node ends.
TELLING_S = 1.5
FAULT = "fault"
# A node with several cameras is in the first of these that one of them is in.
_STATES = (FAULT, DetectorState.LEARNING, DetectorState.WATCHING, IDLE)


def run_camera_node(config: CameraNodeConfig, *, stop: threading.Event, console: Console) -> bool:
    """Run until told to stop; false when a camera failed for good while running, which the bus was told.

    Args:
        config: of the node.
        stop: ends it.
        console: told once that it runs.

    Raises:
        SpotcalError: a camera or the journal cannot be opened.
    """
    # Fits are of small matrices: more threads than one make them slower, and there are cameras enough.
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(1))
        journal = stack.enter_context(Journal(Path(config.journal)))
        bus = BusNode(config.node, Role.CAMERA, bus_options(config), journal, clock=clock_quality())
        node = CameraNode(bus, _workers(config, bus))
        bus.status, bus.on_command = node.status, node.command
        node.go_on()
        stack.enter_context(bus)
        stack.callback(stop_all, node.workers)
        for worker in node.workers:
            worker.start()
        console.print(f"camera node {config.node} runs", markup=False, soft_wrap=True)
        failure = node.watch(stop)
        if failure:
            console.print(f"error: {failure}", markup=False, soft_wrap=True)
        return not failure


class CameraNode:
    """Status and commands of a node's cameras."""

    def __init__(self, bus: BusNode, workers: Sequence[CameraWorker]) -> None:
        self._bus, self.workers = bus, workers
        self._failed: CameraWorker | None = None

    def go_on(self) -> None:
        """Go on with the session in which the node ended, if it did within one."""
        session = self._bus.session
        if not session:
            return
        for worker in self.workers:
            mark = worker.live.mark_of(session)
            if mark is None and worker.feed.is_played:
                worker.begin(session)  # it was killed before the first frame
            else:
                worker.go_on(session, Resumed(mark, last_sequence(self._bus.journal, session, worker.name)))

    def watch(self, stop: threading.Event) -> str:
        """Look after the cameras until told to stop; what failed for good, when something did."""
        while not stop.wait(TICK_S):
            self._failed = next((worker for worker in self.workers if worker.failure is not None), None)
            if self._failed is not None:
                self._bus.set_alive(False)
                stop.wait(TELLING_S)
                return f"camera {self._failed.name} failed: {self._trouble()}"
            if all(_delivers(worker) for worker in self.workers):
                self._bus.beat()
        return ""

    def command(self, verb: Verb, command: pb.Command) -> pb.Reply:
        """See `nodes.bus.command_desk`."""
        match verb:
            case Verb.START:
                for worker in self.workers:
                    # A recording is played from its beginning, however late it is begun.
                    is_empty = worker.feed.is_played or not command.is_late
                    worker.begin(command.header.session, is_room_empty=is_empty)
            case Verb.STOP:
                for worker in self.workers:
                    worker.end()
            case Verb.RELEARN if self._bus.session:
                for worker in self.workers:
                    worker.relearn()
            case Verb.RELEARN:
                return pb.Reply(code="FAILED", message="no session is running; the background is learnt at its start")
            case Verb.SNAPSHOT:
                return self._snapshot(command.number)
            case Verb.EXPOSURE:
                return pb.Reply(code="UNSUPPORTED", message="the cameras of this node cannot be told their exposure")
            case _:
                return pb.Reply(code="UNSUPPORTED", message=f"a camera node knows no {verb}")
        return pb.Reply(code="OK")

    def status(self) -> pb.NodeStatus:
        """What the node says of itself."""
        lives = [worker.live for worker in self.workers]
        states = {live.state for live in lives} | ({FAULT} if self._failed is not None else set())
        heat_c = temperature_c()
        return pb.NodeStatus(
            state=next((str(state) for state in _STATES if state in states), IDLE),
            message=self._trouble(),
            # The slowest camera's: a node is as good as that.
            rate_hz=min(worker.rate_hz for worker in self.workers),
            n_frames=sum(live.counts.n_frames for live in lives),
            n_detections=sum(live.counts.n_detections for live in lives),
            n_dropped=sum(worker.feed.counts.dropped for worker in self.workers),
            temperature_c=heat_c or 0.0,
            has_temperature=heat_c is not None,
            advice=[f"{worker.name}: {text}" for worker in self.workers for text in worker.live.counts.advice],
        )

    def _snapshot(self, number: float) -> pb.Reply:
        if not (0 <= number < len(self.workers) and number == int(number)):
            return pb.Reply(code="FAILED", message=f"snapshot of camera {number:g}: there are {len(self.workers)}")
        worker = self.workers[int(number)]
        picture = worker.snapshot(SNAPSHOT_S)
        if not picture:
            return pb.Reply(code="FAILED", message=f"{worker.name}: no frame came within {SNAPSHOT_S:g} s")
        return pb.Reply(code="OK", content=picture)

    def _trouble(self) -> str:
        if self._failed is not None and self._failed.failure is not None:
            return told(self._failed.failure)
        return "; ".join(f"{worker.name}: no frames" for worker in self.workers if not _delivers(worker))


def last_sequence(journal: Journal, session: str, camera: str) -> int:
    """Of the last frame of a camera that the journal holds of a session; -1 where there is none."""
    payload = journal.last_of(session, Kind.SPOTS, accepts=lambda row: pb.SpotBatch.FromString(row).camera == camera)
    return -1 if payload is None else pb.SpotBatch.FromString(payload).frame_sequence[-1]


def _delivers(worker: CameraWorker) -> bool:
    """Whether frames flow; a recording that is not being played is ready, which is as good."""
    if worker.feed.is_played and worker.failure is None:
        return True
    return worker.last_frame_s is not None and time.monotonic() - worker.last_frame_s < SILENT_S


def _workers(config: CameraNodeConfig, bus: BusNode) -> list[CameraWorker]:
    """The node's cameras, opened: all or none."""
    marks = SessionMarks(Path(config.journal))

    def publish(session: str, batch: pb.SpotBatch) -> None:
        # What was gathered in a session that is over by now would stand under another one's name.
        if session and session == bus.session:
            bus.observe(Kind.SPOTS, batch, stamp_ns=batch.frame_stamp_ns[0])

    out = []
    with ExitStack() as opened:
        for camera in config.cameras:
            mark = marks.of(camera.name, bus.session) if bus.session else None
            feed = open_feed(camera, mark)
            opened.callback(feed.close)
            live = _live(camera, feed, marks, config.batch_ms)
            out.append(CameraWorker(camera.name, feed, live, publish))
        opened.pop_all()
    return out


def _live(camera: CameraSourceConfig, feed: Feed, marks: SessionMarks, batch_ms: float) -> LiveCamera:
    detector = DetectorOptions(
        channel=Channel(camera.channel),
        mask=None if camera.mask is None else read_mask(Path(camera.mask), feed.size_px),
        n_learning_frames=camera.n_learning,
        max_candidates=camera.max_candidates,
        exposure_s=None if camera.exposure_ms is None else 1e-3 * camera.exposure_ms,
    )
    batches = BatchOptions(camera.name, feed.rate_hz, round(1e6 * batch_ms))
    return LiveCamera(detector, batches, marks if feed.is_repeatable else None)
