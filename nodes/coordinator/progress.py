"""The costly looks at a running session, paced: counting overlaps, and calibrating with what is there so far."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

from nodes.config_model import RoomConfig
from nodes.coordinator.guidance import where_to_wave
from nodes.coordinator.live_result import LiveResult
from nodes.coordinator.live_solve import LiveInput, solve_live
from nodes.coordinator.session_store import SessionStore
from nodes.coordinator.sufficiency import Needs, Overlaps, waving_lacks
from nodes.coordinator.worker_process import WorkerProcess

LOOK_EVERY_S = 2.0
SOLVE_EVERY_S = 10.0
# Where a look takes long, as with a thousand cameras, it is taken more seldom: never more than this share of the time.
MAX_SHARE = 0.1


class Progress:
    """What is known of a running session's sufficiency.

    Args:
        store: what came in.
        worker: where first calibrations are tried.
        room: what is known of the cameras.
        needs: what is enough.
        expected: names of the cameras of the site.
        seed: of all random draws.

    Attributes:
        overlaps: of the last look.
        islands: groups of cameras that hang together, by the last look.
        live: newest try; None before the first.
        lacks: what waving has not given yet.
        guidance: where to wave next.
    """

    def __init__(
        self,
        store: SessionStore,
        worker: WorkerProcess,
        room: RoomConfig,
        needs: Needs,
        *,
        expected: Sequence[str],
        seed: int = 0,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store, self._worker, self._room, self._needs = store, worker, room, needs
        self._expected, self._seed, self._clock_s = tuple(expected), seed, clock_s
        self._next_look_s = self._next_solve_s = 0.0
        self._future: Future[LiveResult] | None = None
        self.overlaps: Overlaps = store.overlaps()
        self.islands: tuple[tuple[str, ...], ...] = ()
        self.live: LiveResult | None = None
        self.lacks: tuple[str, ...] = ()
        self.guidance: tuple[str, ...] = ()
        self._judge()

    def step(self, *, is_solving: bool) -> bool:
        """Look and try again where it is time to; True after a look.

        Args:
            is_solving: a calibration may be tried.
        """
        self._collect()
        now_s = self._clock_s()
        if now_s < self._next_look_s:
            return False
        self.overlaps = self._store.overlaps()
        if is_solving and self._future is None and now_s >= self._next_solve_s:
            recordings, stride = self._store.detections()
            self._future = self._worker.submit(solve_live, LiveInput(recordings, self._room, stride, self._seed))
            self._next_solve_s = now_s + SOLVE_EVERY_S
        self._judge()
        spent_s = self._clock_s() - now_s
        self._next_look_s = now_s + max(LOOK_EVERY_S, spent_s / MAX_SHARE)
        return True

    def _collect(self) -> None:
        if self._future is None or not self._future.done():
            return
        try:
            self.live = self._future.result()
        except BrokenProcessPool:
            self.live = LiveResult(not_yet="the process that calibrates was killed; it is started again")
        except Exception as error:  # a defect there must not end the recording here
            self.live = LiveResult(not_yet=f"the calibration failed unexpectedly: {type(error).__name__}: {error}")
        self._future = None
        self._judge()

    def _judge(self) -> None:
        self.islands = tuple(self.overlaps.islands(self._needs.n_link))
        self.lacks = waving_lacks(self.overlaps, self._needs, expected=self._expected, live=self.live)
        self.guidance = where_to_wave(self.overlaps, self._needs, expected=self._expected, live=self.live)
