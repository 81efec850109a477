"""One process for each camera, with progress, and an end at Ctrl-C that leaves nothing running."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.sharedctypes import SynchronizedArray
from typing import TYPE_CHECKING, Protocol

from network_calib.errors import SpotcalError

if TYPE_CHECKING:
    from nodes.camera.camera_detections import CameraDetections
    from nodes.camera.detect_camera import CameraJob

REFRESH_S = 0.1
# Of each camera in the shared counters: frames of the first pass, frames of the second pass.
N_PASSES = 2

Passed = Callable[[int, int], None]


class Interrupted(Exception):  # noqa: N818 — no error: the person stopped it
    """The work was called off."""


class Watcher(Protocol):
    """Who is told how far the work is."""

    def __call__(self, camera: int, n_passed: tuple[int, int], *, is_done: bool) -> None:
        """Camera index, frames of each pass so far."""
        ...


def detect_in_parallel(jobs: Sequence[CameraJob], *, n_processes: int, watch: Watcher) -> list[CameraDetections]:
    """Detect in all recordings, so many at once; the results are in the order of the jobs, however many there are.

    Raises:
        SpotcalError: of the first job, in order, that had failed; or a process that was killed.
        KeyboardInterrupt: once all processes have ended.
    """
    context = multiprocessing.get_context("spawn")
    counters = context.Array("q", N_PASSES * len(jobs) + 1)
    with ProcessPoolExecutor(n_processes, mp_context=context, initializer=_begin, initargs=(counters,)) as pool:
        futures = [pool.submit(_detect, number, job) for number, job in enumerate(jobs)]
        try:
            while True:
                _, not_done = wait(futures, timeout=REFRESH_S, return_when=FIRST_EXCEPTION)
                for number, future in enumerate(futures):
                    first, second = counters[N_PASSES * number : N_PASSES * (number + 1)]
                    watch(number, (first, second), is_done=future.done())
                found = [_result(future, job) for future, job in zip(futures, jobs, strict=True) if future.done()]
                if not not_done:
                    return found
        except BaseException:
            counters[-1] = 1  # the processes look at it in every frame
            pool.shutdown(cancel_futures=True)
            raise


def n_usable_processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0))


def _result(future: Future[CameraDetections], job: CameraJob) -> CameraDetections:
    try:
        return future.result()
    except BrokenProcessPool:
        raise SpotcalError(
            f"{job.source.name}: a process that read recordings was ended from outside",
            advice="Perhaps memory ran out: try --jobs 1.",
        ) from None


_counters: SynchronizedArray | None = None


def _begin(counters: SynchronizedArray) -> None:
    """In each process: one thread, and Ctrl-C is for the process above."""
    global _counters  # noqa: PLW0603 — how a pool hands memory to its processes
    _counters = counters
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import cv2
    from threadpoolctl import threadpool_limits

    # Fits are of small matrices: with the default threads one takes a hundred times as long on a busy machine.
    cv2.setNumThreads(1)
    threadpool_limits(1)


def _detect(number: int, job: CameraJob) -> CameraDetections:
    from nodes.camera.detect_camera import detect_camera

    counters = _counters
    assert counters is not None

    def passed(which: int, n_frames: int) -> None:
        counters[N_PASSES * number + which] = n_frames
        if counters[-1]:
            raise Interrupted

    return detect_camera(job, passed)
