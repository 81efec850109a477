"""What has been seen so far: by camera and part of its picture, by pair of cameras, by LRF. Counting only.

Kept within a budget: where there are many frames with a spot, every second, fourth, ... quarter of a second of the
session is kept, the same ones of all cameras, and common instants are counted for all from these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from network_calib.observations import FloatArray, IntArray
from nodes.bus import spotcal_pb2 as pb
from nodes.camera.camera_detections import CameraDetections
from nodes.frames import StampOrigin

COLUMNS, ROWS = 8, 6
SLOT_NS = 250_000_000
MAX_KEPT_FRAMES = 40_000
# One quarter of a second in four minutes; who needs it thinner sends stamps that are no clock's.
MAX_STRIDE = 1024
# Names come from the bus; no site has so many.
MAX_NAMES = 4096
# A frame full of sparks has more candidates than are of use to a first look.
MAX_CANDIDATES = 4
# Expanded at once when pairs of frames are counted.
MAX_EXPANDED = 1_000_000
_ORIGINS = (None, *(StampOrigin(name) for name in ("camera", "driver", "table", "file", "arrival", "order")))


@dataclass(frozen=True, slots=True)
class SeenFrame:
    """A frame with a spot: number, stamp, and its candidates (n, 4): x_px, y_px, sigma_px, score."""

    sequence: int
    stamp_ns: int
    spots: tuple[tuple[float, float, float, float], ...]


@dataclass(slots=True)
class CameraSeen:
    """What one camera has seen.

    Attributes:
        name: of the camera.
        node: that it belongs to.
        size_px: width and height.
        rate_hz: nominal; None where the camera does not tell.
        origin: of its stamps.
        n_frames: watched.
        n_seen: of them with a spot.
        n_dropped: that the source knows it lost.
        newest_ns: stamp of the newest frame.
        cells: (ROWS, COLUMNS) best candidates by part of the picture.
        kept: by stamp, of the kept quarters of seconds.
    """

    name: str
    node: str
    size_px: tuple[int, int]
    rate_hz: float | None
    origin: StampOrigin
    n_frames: int = 0
    n_seen: int = 0
    n_dropped: int = 0
    newest_ns: int = 0
    cells: IntArray = field(default_factory=lambda: np.zeros((ROWS, COLUMNS), dtype=np.int64))
    kept: dict[int, SeenFrame] = field(default_factory=dict)

    @property
    def coverage(self) -> float:
        """Share of the picture's cells with a spot, 0..1."""
        return float((self.cells > 0).mean())


@dataclass(slots=True)
class LrfSeen:
    """What one LRF has given.

    Attributes:
        name: of the LRF.
        node: that it belongs to.
        n_scans: received.
        crossings: by number of the tilt.
        tilt_rad: by number of the tilt.
        is_fused: all its tilts were sent, so it is through.
    """

    name: str
    node: str
    n_scans: int = 0
    crossings: dict[int, int] = field(default_factory=dict)
    tilt_rad: dict[int, float] = field(default_factory=dict)
    is_fused: bool = False


class Coverage:
    """Of a session. Not for several threads: the owner holds a lock."""

    def __init__(self, *, max_kept_frames: int = MAX_KEPT_FRAMES) -> None:
        self.cameras: dict[str, CameraSeen] = {}
        self.lrfs: dict[str, LrfSeen] = {}
        self.stride = 1
        self._n_kept = 0
        self._max_kept = max_kept_frames

    def add(self, message: object, *, node: str) -> None:
        """One observation, as received: each only once, in any order."""
        if isinstance(message, pb.SpotBatch):
            self._add_spots(message, node)
        elif isinstance(message, pb.LrfScan | pb.LrfSpot | pb.TiltSample | pb.TiltSettings):
            self._add_lrf(message, node)

    def detections(self) -> tuple[CameraDetections, ...]:
        """The kept frames of every camera that saw a spot, in the order of their names, as the solve takes them."""
        seeing = (self.cameras[name] for name in sorted(self.cameras))
        return tuple(_detections(camera) for camera in seeing if camera.kept)

    def stamps(self) -> tuple[tuple[str, ...], IntArray, IntArray]:
        """Names of the cameras, and stamp and camera of every kept frame with a spot."""
        names = tuple(sorted(self.cameras))
        per_camera = [np.fromiter(self.cameras[name].kept, dtype=np.int64) for name in names]
        camera = [np.full(len(stamps), c) for c, stamps in enumerate(per_camera)]
        empty = np.zeros(0, dtype=np.int64)
        return names, np.concatenate([empty, *per_camera]), np.concatenate([empty, *camera])

    def _add_spots(self, batch: pb.SpotBatch, node: str) -> None:
        camera = self._camera(batch, node)
        if camera is None:
            return
        camera.n_frames += len(batch.frame_sequence)
        camera.n_dropped = max(camera.n_dropped, batch.n_dropped)
        camera.newest_ns = max(camera.newest_ns, *batch.frame_stamp_ns)
        by_frame: dict[int, list[tuple[float, float, float, float]]] = {}
        for row in zip(batch.spot_frame, batch.x_px, batch.y_px, batch.sigma_px, batch.score, strict=True):
            spots = by_frame.setdefault(row[0], [])
            if len(spots) < MAX_CANDIDATES:
                spots.append(row[1:])
        for frame, spots in by_frame.items():
            camera.n_seen += 1
            camera.cells[_cell(spots[0][0], spots[0][1], camera.size_px)] += 1
            seen = SeenFrame(batch.frame_sequence[frame], batch.frame_stamp_ns[frame], tuple(spots))
            self._keep(camera, seen)

    def _keep(self, camera: CameraSeen, seen: SeenFrame) -> None:
        is_full = self._n_kept >= self._max_kept and self.stride >= MAX_STRIDE
        if is_full or (seen.stamp_ns // SLOT_NS) % self.stride or seen.stamp_ns in camera.kept:
            return
        camera.kept[seen.stamp_ns] = seen
        self._n_kept += 1
        while self._n_kept > self._max_kept and self.stride < MAX_STRIDE:
            self._thin()

    def _thin(self) -> None:
        self.stride *= 2
        for camera in self.cameras.values():
            gone = [stamp_ns for stamp_ns in camera.kept if (stamp_ns // SLOT_NS) % self.stride]
            for stamp_ns in gone:
                del camera.kept[stamp_ns]
        self._n_kept = sum(len(camera.kept) for camera in self.cameras.values())

    def _camera(self, batch: pb.SpotBatch, node: str) -> CameraSeen | None:
        """None for pictures of another size than before: they are not of one camera."""
        size_px = (batch.width_px, batch.height_px)
        camera = self.cameras.get(batch.camera)
        if camera is None and len(self.cameras) < MAX_NAMES:
            origin = _ORIGINS[batch.origin] or StampOrigin.ARRIVAL
            camera = CameraSeen(batch.camera, node, size_px, batch.rate_hz or None, origin)
            self.cameras[batch.camera] = camera
        return camera if camera is not None and camera.size_px == size_px else None

    def _add_lrf(self, message: pb.LrfScan | pb.LrfSpot | pb.TiltSample | pb.TiltSettings, node: str) -> None:
        lrf = self.lrfs.get(message.lrf)
        if lrf is None:
            if len(self.lrfs) >= MAX_NAMES:
                return
            lrf = self.lrfs[message.lrf] = LrfSeen(message.lrf, node)
        if isinstance(message, pb.LrfScan):
            lrf.n_scans += 1
        elif isinstance(message, pb.LrfSpot):
            lrf.crossings[message.setting] = lrf.crossings.get(message.setting, 0) + 1
        elif isinstance(message, pb.TiltSample):
            lrf.tilt_rad[message.setting] = message.tilt_rad
        else:
            lrf.is_fused = True


def common_instants(stamp_ns: IntArray, camera: IntArray, n_cameras: int, *, half_frame_ns: int) -> IntArray:
    """How many frames of two cameras lie within half a frame of each other.

    Args:
        stamp_ns: (K,) of frames with a spot, in any order.
        camera: (K,) index.
        n_cameras: C.
        half_frame_ns: of the fastest camera.

    Returns:
        (C, C) symmetric counts; the diagonal counts a camera's own frames.
    """
    counts = np.zeros(n_cameras * n_cameras, dtype=np.int64)
    order = np.argsort(stamp_ns, kind="stable")
    stamps, cameras = stamp_ns[order], camera[order]
    end = np.searchsorted(stamps, stamps + half_frame_ns, side="right")
    n_after = end - np.arange(len(stamps)) - 1
    parts = np.cumsum(n_after) // MAX_EXPANDED
    for part in np.unique(parts):
        rows = np.flatnonzero(parts == part)
        first = np.repeat(rows, n_after[rows])
        begin = np.cumsum(n_after[rows]) - n_after[rows]
        second = first + 1 + np.arange(len(first)) - np.repeat(begin, n_after[rows])
        counts += np.bincount(cameras[first] * n_cameras + cameras[second], minlength=len(counts))
    table = counts.reshape(n_cameras, n_cameras)
    table = table + table.T
    np.fill_diagonal(table, np.bincount(cameras, minlength=n_cameras))
    return table


def islands_of(shared: IntArray, *, minimum: int) -> list[tuple[int, ...]]:
    """Groups of cameras joined by so many common instants, the largest first, then by first camera."""
    from scipy.sparse.csgraph import connected_components

    n_islands, label = connected_components(shared >= minimum, directed=False)
    groups = [tuple(int(c) for c in np.flatnonzero(label == i)) for i in range(n_islands)]
    return sorted(groups, key=lambda group: (-len(group), group))


def shortest_frame_ns(cameras: Sequence[CameraSeen]) -> int:
    """Of the nominal rates; that of 30 frames a second where none is known."""
    rates = [camera.rate_hz for camera in cameras if camera.rate_hz]
    return round(1e9 / max(rates, default=30.0))


def _cell(x_px: float, y_px: float, size_px: tuple[int, int]) -> tuple[int, int]:
    column = int((x_px + 0.5) * COLUMNS / size_px[0])
    row = int((y_px + 0.5) * ROWS / size_px[1])
    return min(max(row, 0), ROWS - 1), min(max(column, 0), COLUMNS - 1)


def _detections(camera: CameraSeen) -> CameraDetections:
    frames = sorted(camera.kept.values(), key=lambda frame: frame.stamp_ns)
    table: FloatArray = np.array([spot for frame in frames for spot in frame.spots]).reshape(-1, 4)
    return CameraDetections(
        name=camera.name,
        source=camera.node,
        size_px=camera.size_px,
        rate_hz=camera.rate_hz,
        origin=camera.origin,
        sequence=np.array([frame.sequence for frame in frames], dtype=np.int64),
        stamp_ns=np.array([frame.stamp_ns for frame in frames], dtype=np.int64),
        picture=np.repeat(np.arange(len(frames)), [len(frame.spots) for frame in frames]),
        px=table[:, :2],
        sigma_px=table[:, 2],
        score=table[:, 3],
        n_dropped=camera.n_dropped,
    )
