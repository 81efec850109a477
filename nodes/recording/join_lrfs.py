"""What each LRF told of its last acquisition: the tilts, and the spots that crossed its plane at them."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from network_calib.observations import FloatArray, IntArray
from nodes.bus import spotcal_pb2 as pb
from nodes.recording.join_cameras import natural_key

LrfMessage = pb.LrfInfo | pb.LrfSpot | pb.TiltSample | pb.TiltSettings


@dataclass(frozen=True, slots=True)
class LrfSpotColumns:
    """M crossings of the spot through the scan plane.

    Attributes:
        stamp_ns: (M,) on the clock of the LRF's node.
        setting: (M,) number of the tilt, an index into the record's angles.
        range_m: (M,).
        bearing_rad: (M,).
        range_sigma_m: (M,).
        bearing_sigma_rad: (M,).
        out_of_plane_sigma_m: (M,).
        bias_bound_m: (M,) above 0 where the spot was seen on one side of the plane only.
    """

    stamp_ns: IntArray
    setting: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    range_sigma_m: FloatArray
    bearing_sigma_rad: FloatArray
    out_of_plane_sigma_m: FloatArray
    bias_bound_m: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @classmethod
    def of(cls, spots: Sequence[pb.LrfSpot]) -> LrfSpotColumns:
        """From messages, in order."""
        return cls(
            stamp_ns=np.array([spot.stamp_ns for spot in spots], dtype=np.int64),
            setting=np.array([spot.setting for spot in spots], dtype=np.int64),
            range_m=_floats([spot.range_m for spot in spots]),
            bearing_rad=_floats([spot.bearing_rad for spot in spots]),
            range_sigma_m=_floats([spot.range_sigma_m for spot in spots]),
            bearing_sigma_rad=_floats([spot.bearing_sigma_rad for spot in spots]),
            out_of_plane_sigma_m=_floats([spot.out_of_plane_sigma_m for spot in spots]),
            bias_bound_m=_floats([spot.bias_bound_m for spot in spots]),
        )


@dataclass(frozen=True, slots=True)
class LrfRecord:
    """One LRF's last acquisition.

    Attributes:
        name: of the LRF.
        info: what the scanner is; None: it never said.
        spots: crossings.
        angle_rad: (T,) tilts; empty where the acquisition did not come to its end.
        covariance_rad2: (T, T) of them.
        sources: what the tilts were measured with.
        notes: one sentence each.
    """

    name: str
    info: pb.LrfInfo | None
    spots: LrfSpotColumns
    angle_rad: FloatArray
    covariance_rad2: FloatArray
    sources: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(slots=True)
class _Acquisition:
    """From the first tilt to the last, of one boot, which began at `boot_ns`; tilts are numbered upwards."""

    boot: tuple[str, bytes]
    boot_ns: int = 0
    setting: int = -1
    spots: list[pb.LrfSpot] = field(default_factory=list)
    tilts: pb.TiltSettings | None = None


def join_lrfs(messages: Iterable[LrfMessage], refused: Counter[str]) -> tuple[LrfRecord, ...]:
    """One record for each LRF that told anything, in the natural order of the names.

    Args:
        messages: of all LRFs, those of a boot together and in order, boots in the order of time.
        refused: counts spots of settings that have no tilt.
    """
    of_lrf: defaultdict[str, list[LrfMessage]] = defaultdict(list)
    for message in messages:
        of_lrf[message.lrf].append(message)
    return tuple(_record(name, of_lrf[name], refused) for name in sorted(of_lrf, key=natural_key))


def _record(name: str, messages: Sequence[LrfMessage], refused: Counter[str]) -> LrfRecord:
    infos = [message for message in messages if isinstance(message, pb.LrfInfo)]
    acquisitions = _acquisitions(messages)
    ended = [one for one in acquisitions if one.tilts is not None]
    counted = (ended or acquisitions or [_Acquisition(("", b""))])[-1]
    notes = [] if ended else [f"{name}: the acquisition did not come to its end, so there are no tilts"]
    if len(acquisitions) > 1:
        notes.append(f"{name}: {len(acquisitions)} acquisitions were begun; the last one that ended counts")
    own = [info for info in infos if _boot(info) == counted.boot]
    tilts = counted.tilts or pb.TiltSettings()
    n_tilts = len(tilts.angle_rad)
    spots = [spot for spot in counted.spots if spot.setting < n_tilts or not ended]
    if len(spots) < len(counted.spots):
        refused["lrf_spot: setting: without a tilt"] += len(counted.spots) - len(spots)
    return LrfRecord(
        name=name,
        info=next(reversed(own or infos), None),
        spots=LrfSpotColumns.of(spots),
        angle_rad=_floats(tilts.angle_rad),
        covariance_rad2=_floats(tilts.covariance_rad2).reshape(n_tilts, n_tilts),
        sources=tuple(tilts.sources),
        notes=(*tilts.notes, *notes),
    )


def _acquisitions(messages: Sequence[LrfMessage]) -> list[_Acquisition]:
    """A new one begins with a boot, or where the number of the tilt falls back."""
    acquisitions: list[_Acquisition] = []
    boot_ns: dict[tuple[str, bytes], int] = {}
    for message in messages:
        boot, stamp_ns = _boot(message), message.header.stamp_ns
        boot_ns[boot] = min(stamp_ns, boot_ns.get(boot, stamp_ns))
    for message in messages:
        if isinstance(message, pb.LrfInfo):
            continue
        boot = _boot(message)
        if not acquisitions or acquisitions[-1].boot != boot or _begins_anew(acquisitions[-1], message):
            acquisitions.append(_Acquisition(boot, boot_ns[boot]))
        current = acquisitions[-1]
        if isinstance(message, pb.TiltSettings):
            current.tilts = message
        else:
            current.setting = max(current.setting, message.setting)
            if isinstance(message, pb.LrfSpot):
                current.spots.append(message)
    return sorted(acquisitions, key=lambda one: one.boot_ns)


def _begins_anew(current: _Acquisition, message: LrfMessage) -> bool:
    """The platform never turns back within an acquisition; the first tilt again is a new one once it has results."""
    if not isinstance(message, pb.TiltSample):
        return False
    has_results = bool(current.spots) or current.tilts is not None
    return message.setting < current.setting or (message.setting == 0 and has_results)


def _boot(message: LrfMessage) -> tuple[str, bytes]:
    return message.header.node, message.header.boot


def _floats(values: Iterable[float]) -> FloatArray:
    return np.array(list(values), dtype=np.float64)
