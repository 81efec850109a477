"""Batches of one camera, from one boot of its node or several, as one recording of it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from network_calib.observations import IntArray
from nodes.bus import spotcal_pb2 as pb
from nodes.camera.camera_detections import CameraDetections
from nodes.camera.detect_camera import MAX_SIGMA_PX
from nodes.frames import StampOrigin

# Four years at 30 frames a second; what stands further apart is no clock's, and numbers must stay within 64 bits.
MAX_STEP = 2**32
# Best first, as in nodes.frames; who does not say where stamps come from has none.
_ORIGINS = tuple(StampOrigin)
_ORIGIN = {
    pb.STAMP_ORIGIN_UNKNOWN: StampOrigin.ORDER,
    pb.STAMP_ORIGIN_CAMERA: StampOrigin.CAMERA,
    pb.STAMP_ORIGIN_DRIVER: StampOrigin.DRIVER,
    pb.STAMP_ORIGIN_TABLE: StampOrigin.TABLE,
    pb.STAMP_ORIGIN_FILE: StampOrigin.FILE,
    pb.STAMP_ORIGIN_ARRIVAL: StampOrigin.ARRIVAL,
    pb.STAMP_ORIGIN_ORDER: StampOrigin.ORDER,
}


@dataclass(frozen=True, slots=True)
class _Run:
    """Frames of one source between two starts of it: their numbers rise.

    Attributes:
        batches: in order.
        sequence: (F,) as the source counted.
        stamp_ns: (F,).
    """

    batches: tuple[pb.SpotBatch, ...]
    sequence: IntArray
    stamp_ns: IntArray


def join_cameras(batches: Iterable[pb.SpotBatch], refused: Counter[str]) -> tuple[CameraDetections, ...]:
    """One recording for each camera, in the natural order of the names (C2 before C10).

    Args:
        batches: of all cameras, those of a boot together and in order.
        refused: counts batches of a picture size that the camera mostly does not have.
    """
    of_camera: defaultdict[str, list[pb.SpotBatch]] = defaultdict(list)
    for batch in batches:
        of_camera[batch.camera].append(batch)
    return tuple(_joined(name, of_camera[name], refused) for name in sorted(of_camera, key=natural_key))


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorts names by their text and, where they count, by number."""
    import re

    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(0, int(part), part) if part[0].isdecimal() else (1, 0, part) for part in parts]


def _joined(name: str, batches: Sequence[pb.SpotBatch], refused: Counter[str]) -> CameraDetections:
    sizes = Counter((batch.width_px, batch.height_px) for batch in batches)
    size_px = min(sizes, key=lambda size: (-sizes[size], size))
    if len(sizes) > 1:
        refused["spots: width_px, height_px: not the camera's"] += len(batches) - sizes[size_px]
    runs = sorted(
        _runs([batch for batch in batches if (batch.width_px, batch.height_px) == size_px]),
        key=lambda run: (run.stamp_ns[0], run.batches[0].header.node, run.batches[0].header.boot),
    )
    ordered = [batch for run in runs for batch in run.batches]
    picture, spots = _spots(ordered)
    nodes = dict.fromkeys(batch.header.node for batch in ordered)
    return CameraDetections(
        name=name,
        source=f"{name} of {', '.join(nodes)}",
        size_px=size_px,
        rate_hz=next((batch.rate_hz for batch in reversed(ordered) if batch.rate_hz), None),
        origin=max((_ORIGIN[batch.origin] for batch in ordered), key=_ORIGINS.index),
        sequence=_continued([run.sequence for run in runs], [run.stamp_ns for run in runs]),
        stamp_ns=np.concatenate([run.stamp_ns for run in runs]),
        picture=picture,
        px=spots[:, :2],
        sigma_px=spots[:, 2],
        score=spots[:, 3],
        n_dropped=_dropped(ordered),
        notes=(f"{name}: started {len(runs)} times",) if len(runs) > 1 else (),
    )


def _runs(batches: Sequence[pb.SpotBatch]) -> list[_Run]:
    """Split where the node started anew, or its source did: there the numbers fall."""
    parts: list[list[pb.SpotBatch]] = []
    for batch in batches:
        last = parts[-1][-1] if parts else None
        continues = (
            last is not None
            and (last.header.node, last.header.boot) == (batch.header.node, batch.header.boot)
            and last.frame_sequence[-1] < batch.frame_sequence[0]
        )
        if continues:
            parts[-1].append(batch)
        else:
            parts.append([batch])
    return [_run_of(part) for part in parts]


def _run_of(batches: Sequence[pb.SpotBatch]) -> _Run:
    sequence = np.array([number for batch in batches for number in batch.frame_sequence], dtype=np.int64)
    stamp_ns = np.array([stamp for batch in batches for stamp in batch.frame_stamp_ns], dtype=np.int64)
    return _Run(tuple(batches), sequence, stamp_ns)


def _continued(sequences: Sequence[IntArray], stamps_ns: Sequence[IntArray]) -> IntArray:
    """(F,) numbers that go on over restarts: by the time that passed, in frames, and by one at least.

    Where stamps are a clock's they decide which frames belong together, and numbers need only be different; elsewhere
    this is the best guess at how many frames passed unseen.
    """
    period_ns = _period_ns(sequences, stamps_ns)
    numbers = [sequences[0]]
    for k in range(1, len(sequences)):
        passed = int(stamps_ns[k][0] - stamps_ns[k - 1][-1])
        step = min(max(1, round(passed / period_ns)), MAX_STEP) if period_ns else 1
        numbers.append(sequences[k] - sequences[k][0] + numbers[-1][-1] + step)
    return np.concatenate(numbers)


def _period_ns(sequences: Sequence[IntArray], stamps_ns: Sequence[IntArray]) -> float:
    """Median time from one number to the next; 0 where no run has two frames, or time stands still."""
    steps = [np.diff(stamp) / np.diff(number) for number, stamp in zip(sequences, stamps_ns, strict=True)]
    joined = np.concatenate(steps)
    return max(float(np.median(joined)), 0.0) if len(joined) else 0.0


def _spots(batches: Sequence[pb.SpotBatch]) -> tuple[IntArray, np.ndarray]:
    """(K,) frames, and (K, 4) x, y, sigma, score, of the candidates that `detect_camera` would keep."""
    pictures, columns, n_frames = [], [], 0
    for batch in batches:
        pictures.append(np.array(batch.spot_frame, dtype=np.int64) + n_frames)
        columns.append(np.array([batch.x_px, batch.y_px, batch.sigma_px, batch.score], dtype=np.float64).reshape(4, -1))
        n_frames += len(batch.frame_sequence)
    picture, spots = np.concatenate(pictures), np.concatenate(columns, axis=1).T
    is_kept = spots[:, 2] <= MAX_SIGMA_PX
    return picture[is_kept], np.ascontiguousarray(spots[is_kept])


def _dropped(batches: Sequence[pb.SpotBatch]) -> int:
    """Each boot counts from its own start."""
    most: dict[tuple[str, bytes], int] = {}
    for batch in batches:
        boot = batch.header.node, batch.header.boot
        most[boot] = max(batch.n_dropped, most.get(boot, 0))
    return sum(most.values())
