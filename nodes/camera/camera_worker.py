"""The thread of one camera: takes frames from its feed, heeds orders between them, hands messages on."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence

from nodes.bus import spotcal_pb2 as pb
from nodes.camera.feeds import Feed
from nodes.camera.live_camera import LiveCamera, Resumed
from nodes.devices.redaction import redact
from nodes.frames import Frame
from nodes.measured_rate import MeasuredRate

JOIN_S = 1.0
# Takes a message of a session.
Sink = Callable[[str, pb.SpotBatch], None]
_Order = Callable[[LiveCamera], None]


class CameraWorker:
    """Runs one camera.

    Args:
        name: of the camera.
        feed: its frames; closed by `close`.
        live: what is done with them; this thread's alone from `start` on.
        sink: takes the messages.

    Attributes:
        failure: why the thread ended; None while it runs, or when it was told to.
    """

    def __init__(self, name: str, feed: Feed, live: LiveCamera, sink: Sink) -> None:
        self.name, self.feed, self.live = name, feed, live
        self.failure: BaseException | None = None
        self._sink = sink
        self._orders: queue.SimpleQueue[_Order] = queue.SimpleQueue()
        self._snapshots: queue.SimpleQueue[queue.SimpleQueue[bytes]] = queue.SimpleQueue()
        self._at_play: _Order | None = None
        self._n_plays = 0
        self._rate = MeasuredRate()
        self._is_told_to_end = False
        self.last_frame_s: float | None = None
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Tell the thread to end, and give the camera back without waiting for it."""
        self._is_told_to_end = True
        # Closing a camera that hangs takes as long as its time-outs.
        threading.Thread(target=self.feed.close, name=f"closing {self.name}", daemon=True).start()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread, but no longer than this."""
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def begin(self, session: str, *, is_room_empty: bool = True) -> None:
        """A session begins, with the next frame."""
        self._give_begin(lambda live: live.begin(session, None if is_room_empty else Resumed(None)))
        self.feed.begin()

    def go_on(self, session: str, resumed: Resumed) -> None:
        """A session goes on that was running when this node ended."""
        self._give_begin(lambda live: live.begin(session, resumed))

    def end(self) -> None:
        """The session is over."""
        self._orders.put(LiveCamera.end)

    def relearn(self) -> None:
        """Learn the background anew, from the next frame on."""
        self._orders.put(LiveCamera.relearn)

    def snapshot(self, timeout_s: float) -> bytes | None:
        """The next frame as a PNG; None when none comes in time."""
        answer: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._snapshots.put(answer)
        try:
            return answer.get(timeout=timeout_s)
        except queue.Empty:
            return None

    @property
    def rate_hz(self) -> float:
        """Frames a second, measured."""
        return self._rate.rate_hz(time.monotonic())

    def _give_begin(self, order: _Order) -> None:
        """For the next frame; of a recording, for the first frame when it is played anew."""
        if self.feed.is_played:
            self._at_play = order
        else:
            self._orders.put(order)

    def _run(self) -> None:
        try:
            for frame in self.feed.frames():
                self._heed_orders()
                if frame is None:
                    self._hand_on(self.live.flush())
                else:
                    self._take(frame)
                if self._is_told_to_end:
                    break
            self._hand_on(self.live.flush())
        except BaseException as error:  # the node's main thread tells it and ends the node
            if not self._is_told_to_end:
                self.failure = error

    def _take(self, frame: Frame) -> None:
        now_s = time.monotonic()
        self._rate.note(now_s)
        full = self.live.take(frame, n_dropped=self.feed.counts.dropped, began_ns=self.feed.began_ns)
        self.last_frame_s = now_s
        self._hand_on(full)
        while not self._snapshots.empty():
            self._snapshots.get().put(_png(frame))

    def _heed_orders(self) -> None:
        if self._at_play is not None and self.feed.n_plays != self._n_plays:
            self._n_plays = self.feed.n_plays
            self._at_play(self.live)
        while not self._orders.empty():
            self._orders.get()(self.live)

    def _hand_on(self, batches: list[pb.SpotBatch]) -> None:
        for batch in batches:
            self._sink(self.live.session, batch)


def stop_all(workers: Sequence[CameraWorker]) -> None:
    """End all cameras at once."""
    for worker in workers:
        worker.close()
    end_s = time.monotonic() + JOIN_S
    for worker in workers:
        worker.join(max(end_s - time.monotonic(), 0.0))


def told(failure: BaseException) -> str:
    """Why a thread ended, without passwords."""
    message = getattr(failure, "message", None)
    return redact(message if isinstance(message, str) else f"{type(failure).__name__}: {failure}")


def _png(frame: Frame) -> bytes:
    import cv2

    from nodes.camera.annotate import bgr_of

    is_coded, data = cv2.imencode(".png", bgr_of(frame))
    return data.tobytes() if is_coded else b""
