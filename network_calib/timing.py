"""Grouping of detections by time: which of them show one instant."""

from __future__ import annotations

import numpy as np

from network_calib.errors import InputError
from network_calib.observations import IntArray


def group_by_stamp(
    stamp_ns: IntArray, camera: IntArray, *, tolerance_ns: int | None = None, camera_names: tuple[str, ...] = ()
) -> IntArray:
    """Number the instants: detections belong together when no gap between neighbouring stamps exceeds the tolerance.

    Args:
        stamp_ns: (K,) times on one common clock, in any order.
        camera: (K,) camera index.
        tolerance_ns: largest gap inside an instant; None takes a quarter of `frame_interval_ns`.
        camera_names: for messages.

    Returns:
        (K,) frame number of each row, from 0 in the order of time.

    Raises:
        InputError: one camera has two detections in one instant, or there is no frame interval to derive the tolerance
            from.
    """
    if not len(stamp_ns):
        return np.zeros(0, dtype=np.int64)
    if tolerance_ns is None:
        tolerance_ns = max(frame_interval_ns(stamp_ns, camera) // 4, 1)
    order = np.argsort(stamp_ns, kind="stable")
    is_start = np.diff(stamp_ns[order]) > tolerance_ns
    frame = np.empty(len(stamp_ns), dtype=np.int64)
    frame[order] = np.concatenate([[0], np.cumsum(is_start)])
    _refuse_twice(stamp_ns, camera, frame, tolerance_ns=tolerance_ns, camera_names=camera_names)
    return frame


def frame_interval_ns(stamp_ns: IntArray, camera: IntArray) -> int:
    """The shortest median time between two detections of one camera.

    The shortest over the cameras, because a camera that misses more than half of the spots has a median of two
    intervals or more.

    Raises:
        InputError: no camera has two detections.
    """
    order = np.lexsort((stamp_ns, camera))
    step, is_same = np.diff(stamp_ns[order]), np.diff(camera[order]) == 0
    owner = camera[order][1:]
    medians = [float(np.median(step[is_same & (owner == c)])) for c in np.unique(owner[is_same])]
    if not medians:
        raise InputError(
            "no camera has two detections, so the frame interval is unknown", advice="Give the tolerance of grouping."
        )
    return int(min(medians))


def _refuse_twice(
    stamp_ns: IntArray, camera: IntArray, frame: IntArray, *, tolerance_ns: int, camera_names: tuple[str, ...]
) -> None:
    order = np.lexsort((stamp_ns, camera, frame))
    is_twice = (np.diff(frame[order]) == 0) & (np.diff(camera[order]) == 0)
    if not is_twice.any():
        return
    first = int(np.flatnonzero(is_twice)[0])
    earlier, later = int(stamp_ns[order[first]]), int(stamp_ns[order[first + 1]])
    index = int(camera[order[first]])
    name = camera_names[index] if camera_names else str(index)
    raise InputError(
        f"camera {name!r} has detections at {earlier} ns and {later} ns in one instant (gaps up to {tolerance_ns} ns "
        f"are bridged); {int(is_twice.sum())} such cases",
        advice="Give a smaller tolerance of grouping. If the cameras run without a common trigger, their stamps fill "
        "the frame interval and no tolerance separates the instants.",
    )
