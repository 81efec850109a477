"""The thread that captures from a camera, and connects again when it is lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from nodes.devices.backoff import Backoff
from nodes.devices.cameras.connection import Connection, ConnectionLostError
from nodes.devices.cameras.frame_maker import FrameMaker
from nodes.devices.cameras.frame_queue import FrameQueue
from nodes.devices.cameras.lateness import Lateness
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.errors import SourceError
from nodes.devices.redaction import redact
from nodes.frames import Frame

# Beyond the time-outs of the calls that can block: decoding on a busy machine, and asking a dead name server.
_SPARE_READ_S, _SPARE_CONNECT_S = 10.0, 60.0
_LOOK_EVERY_S = 0.5


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What capturing takes from outside: clock and chance.

    Attributes:
        rng: of the waits between attempts to connect. Not seeded by default, unlike all else: the waits must differ
            from node to node.
        now_s: a clock that only goes forward.
        pause: waits so many seconds, less when the event is set meanwhile.
    """

    rng: np.random.Generator = field(default_factory=np.random.default_rng)
    now_s: Callable[[], float] = time.monotonic
    pause: Callable[[threading.Event, float], object] = threading.Event.wait


class CaptureThread:
    """Fills a queue with the frames of a camera until it is stopped, or the camera fails for good.

    Args:
        name: of the source, for messages.
        connect: makes a connection; called here for the first.
        options: how to keep it.
        around: clock and chance.

    Raises:
        SourceError: of the first `connect`.
    """

    def __init__(
        self, name: str, connect: Callable[[], Connection], options: LiveOptions, around: Surroundings
    ) -> None:
        self._name, self._connect, self._options, self._around = name, connect, options, around
        self._queue = FrameQueue(options.n_queued)
        self.n_late = self.n_reconnects = self.n_clock_steps = 0
        self._n_overflows = 0
        self._stop = threading.Event()
        self.last_shot_s = around.now_s()
        first = connect()
        self._due_s = around.now_s() + options.timeout_s + _SPARE_READ_S
        self.size_px, self.rate_hz = first.size_px, first.rate_hz
        self._maker = FrameMaker(name, first.size_px)
        self._thread = threading.Thread(target=self._run, args=(first,), name=f"capture {name}", daemon=True)
        self._thread.start()

    @property
    def n_dropped(self) -> int:
        return self._maker.n_lost + self._n_overflows

    def next_frame(self) -> Frame | None:
        """The oldest frame not yet taken, when there is one; None when stopped.

        Raises:
            SourceError: the camera failed for good, or the thread hangs in a driver.
        """
        while True:
            try:
                return self._queue.get(wait_s=_LOOK_EVERY_S)
            except TimeoutError:
                overdue_s = self._around.now_s() - self._due_s
            if overdue_s > 0:
                raise SourceError(
                    f"{self._name}: hangs: its driver or network call should have ended {overdue_s:.0f} s ago",
                    advice="Unplug the camera and plug it in again, then start again.",
                )

    def stop(self, *, wait_s: float) -> None:
        """End the thread, and wait for it so long."""
        self._stop.set()
        self._queue.clear()
        self._thread.join(wait_s)

    def _run(self, connection: Connection) -> None:
        failure: SourceError | None = SourceError(f"{self._name}: its capture thread died")
        try:
            self._capture_until_stopped(connection)
            failure = None
        except SourceError as error:
            failure = error
        except Exception as error:
            failure = SourceError(
                f"{self._name}: capturing failed: {redact(f'{type(error).__name__}: {error}')}",
                advice="This is a defect of spotcal: please report it, with what was done before.",
            )
        finally:
            self._queue.finish(failure)

    def _capture_until_stopped(self, connection: Connection | None) -> None:
        while connection is not None:
            lost = self._capture(connection)
            connection = None if self._stop.is_set() else self._connected_again(lost)

    def _capture(self, connection: Connection) -> ConnectionLostError:
        """Queue frames until the connection is lost or this thread stopped; it is closed in any case."""
        n_steps_before, lateness = self.n_clock_steps, Lateness(connection.rate_hz)
        try:
            for shot in connection.shots():
                if self._stop.is_set():
                    break
                self._due_s = self._around.now_s() + self._options.timeout_s + _SPARE_READ_S
                self.n_clock_steps = n_steps_before + connection.n_clock_steps
                if shot is None:
                    continue
                self.last_shot_s = self._around.now_s()
                self.n_late += lateness.is_late(self.last_shot_s)
                frame = self._maker.frame_of(shot)
                self._n_overflows += frame is not None and self._queue.put(frame)
        except ConnectionLostError as error:
            return error
        finally:
            connection.close()
        return ConnectionLostError(f"{self._name}: the camera ended the stream")

    def _connected_again(self, lost: ConnectionLostError) -> Connection | None:
        """A connection made anew, as soon as there is one; None when stopped.

        Raises:
            SourceError: the camera stays away for longer than `max_away_s`, or refuses for good.
        """
        lost_s = self._around.now_s()
        for wait_s in Backoff().waits_s(self._around.rng):
            left_s = lost_s + self._options.max_away_s - self._around.now_s()
            if left_s <= 0:
                break
            self._due_s = self._around.now_s() + wait_s + 2 * self._options.timeout_s + _SPARE_CONNECT_S
            self._around.pause(self._stop, min(wait_s, left_s))
            if self._stop.is_set():
                return None
            try:
                connection = self._connect()
            except ConnectionLostError as error:
                lost = error
                continue
            self.n_reconnects += 1
            self._due_s = self._around.now_s() + self._options.timeout_s + _SPARE_READ_S
            return connection
        raise SourceError(
            f"{self._name}: away for more than {self._options.max_away_s:g} s; the last attempt: {lost.message}",
            advice=lost.advice or "Check the camera's power and network.",
        )
