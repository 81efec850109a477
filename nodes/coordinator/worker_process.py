"""One process beside the coordinator for what takes long: spawned, ends with the coordinator however that ends."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from types import TracebackType
from typing import Self, TypeVar

from nodes.devices.errors import DeviceError

Given = TypeVar("Given")
Found = TypeVar("Found")
# It may be held up by other work on a busy machine, but starting an interpreter takes no minute.
START_TIMEOUT_S = 60.0


class WorkerProcess:
    """Runs one call at a time; `with` ends it, in the middle of a call if need be."""

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._pid: Future[int] | None = None

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._pool is None or self._pid is None:
            return
        # No call is worth waiting for: what it was to find can be found again from the recording.
        with suppress(ProcessLookupError, BrokenProcessPool):
            os.kill(self._pid.result(START_TIMEOUT_S), signal.SIGKILL)
        self._pool.shutdown(cancel_futures=True)
        self._pool = None

    def submit(self, call: Callable[[Given], Found], given: Given) -> Future[Found]:
        """Begin a call; the function and what goes in and out must pickle.

        Raises:
            DeviceError: the `with` has ended.
        """
        if self._pool is None:
            raise DeviceError("told to end: nothing new is calculated")
        try:
            return self._pool.submit(call, given)
        except BrokenProcessPool:  # somebody killed it: a new one does as well
            self._pool.shutdown()
            self._start()
            return self._pool.submit(call, given)

    def _start(self) -> None:
        self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_begin)
        self._pid = self._pool.submit(os.getpid)


def _begin() -> None:
    """In the new process: Ctrl-C is the coordinator's; matrices are small, one thread is fastest; never an orphan."""
    from threadpoolctl import threadpool_limits

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threadpool_limits(1)
    threading.Thread(target=_end_with_parent, name="end with parent", daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
