"""The end of a session: everybody stops, what is missing is fetched, the recording is closed, and solved from."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from nodes.coordinator.finishing import Finished, FinishJob, finish_offline
from nodes.coordinator.ingest import Ingest
from nodes.coordinator.session_store import SessionStore
from nodes.coordinator.worker_process import WorkerProcess
from nodes.devices.errors import DeviceError

# Nodes tell their last when they are told to stop; those that do not answer in this time are asked for it later.
STOP_TIMEOUT_S = 5.0
COMPLETE_TIMEOUT_S = 60.0
# By then a coordinator that has just come back has heard from every node.
HEARD_S = 1.5
TICK_S = 0.1


class Ending:
    """Runs in a thread of its own, that the caller looks after.

    Args:
        ingest: running.
        store: what came in.
        worker: where it is solved.
        folder: of the session.
        is_stopped: no node that is there is in the session any more.

    Attributes:
        notes: what could not be had.
    """

    def __init__(
        self,
        ingest: Ingest,
        store: SessionStore,
        worker: WorkerProcess,
        folder: Path,
        *,
        is_stopped: Callable[[], bool],
    ) -> None:
        self._ingest, self._store, self._worker, self._folder = ingest, store, worker, folder
        self._is_stopped = is_stopped
        self._is_left = threading.Event()
        self.notes: tuple[str, ...] = ()

    def leave(self) -> None:
        """Give up as soon as may be: the session goes on another time."""
        self._is_left.set()

    def finish(self) -> Finished:
        """To the result.

        Raises:
            SpotcalError: the recording does not determine the answer, or cannot be written, or it was told to leave.
            OSError: the result cannot be written.
        """
        end_s = time.monotonic() + COMPLETE_TIMEOUT_S
        while True:
            self._wait_for_stops()
            missing = self._ingest.complete(max(end_s - time.monotonic(), STOP_TIMEOUT_S))
            if self._is_left.is_set():
                raise DeviceError("told to end before the calibration began")
            # A node that came back in the meantime went on observing, and says so before anybody sees its presence.
            is_whole = missing.is_complete and not missing.observing and self._is_stopped()
            if is_whole or time.monotonic() > end_s:
                break
        self.notes = () if missing.is_complete else (str(missing),)
        if missing.observing:
            self.notes += (f"not stopped, what they see from now on is left out: {', '.join(missing.observing)}",)
        self._store.close()
        return self._worker.submit(finish_offline, FinishJob(self._folder)).result()

    def _wait_for_stops(self) -> None:
        begin_s = time.monotonic()
        while not self._is_left.wait(TICK_S):
            spent_s = time.monotonic() - begin_s
            if spent_s > STOP_TIMEOUT_S or (spent_s > HEARD_S and self._is_stopped()):
                return
