"""What a node's journal holds of an acquisition that was cut off: the tilts that were finished are not done again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from lrf_stereo.tilt import Tilts, fuse_tilts, gravity_tilts, step_tilts
from network_calib.errors import InputError
from network_calib.observations import FloatArray
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Kind, parse_observation
from nodes.devices.mti import ImuSample
from nodes.devices.tilt_unit import TiltDrive, TiltUnit
from nodes.journal import Journal
from nodes.lrf.imu_log import ImuLog
from nodes.lrf.tilt_of_session import SETTLE_S, SessionTilts

MAX_BYTES = 2**62


@dataclass(frozen=True, slots=True)
class Rest:
    """The LRF at one tilt.

    Attributes:
        begin_s: when it had come to rest, Unix time.
        end_s: until when it surely rested.
        steps: of the tilt unit; None where there is none.
    """

    begin_s: float
    end_s: float
    steps: int | None


@dataclass(slots=True)
class Journalled:
    """Of one session.

    Attributes:
        rests: of the tilts that were finished, in order.
        n_crossings: at all of them.
        is_complete: the angles of all tilts were published too.
        imu: its samples, by boot of the node: each has a device clock of its own.
    """

    rests: list[Rest] = field(default_factory=list)
    n_crossings: int = 0
    is_complete: bool = False
    imu: dict[bytes, ImuLog] = field(default_factory=dict)


def read_journalled(journal: Journal, session: str) -> Journalled:
    """What a session's rows say. A tilt is finished when all its crossings stand there: they come when it ends."""
    out = Journalled()
    arrived: dict[int, pb.TiltSample] = {}
    last_s: dict[int, float] = {}
    n_left: dict[int, int] = {}
    for kind, payload in _rows(journal, session):
        match kind:
            case Kind.TILT:
                sample = pb.TiltSample.FromString(payload)
                arrived[sample.setting] = sample
                n_left.pop(sample.setting, None)
            case Kind.LRF_SPOT:
                spot = pb.LrfSpot.FromString(payload)
                out.n_crossings += 1
                n_left[spot.setting] = n_left.get(spot.setting, spot.n_spots) - 1
                last_s[spot.setting] = max(last_s.get(spot.setting, 0.0), 1e-9 * spot.stamp_ns)
            case Kind.TILTS:
                out.is_complete = True
            case Kind.IMU:
                batch = pb.ImuBatch.FromString(payload)
                log = out.imu.setdefault(batch.header.boot, ImuLog())
                for sample in _samples(batch):
                    log.add(sample)
            case _:
                pass
    while len(out.rests) in arrived and n_left.get(len(out.rests), 1) <= 0:
        sample = arrived[len(out.rests)]
        steps = sample.steps if sample.has_steps else None
        out.rests.append(Rest(1e-9 * sample.header.stamp_ns, last_s[len(out.rests)], steps))
    return out


def joined_tilts(journalled: Journalled, *, tilt: TiltDrive, axis_in_imu: FloatArray) -> SessionTilts:
    """Angles of the tilts of an acquisition that was cut off and gone on with.

    From steps and gravity, each tilt by itself: nobody measured how the LRF turned while the node was away.

    Raises:
        InputError: there is neither tilt unit nor IMU, or the IMU did not see a tilt at rest.
    """
    by_steps = _by_steps(journalled.rests, tilt)
    by_gravity = _by_gravity(journalled, axis_in_imu) if journalled.imu else None
    if by_steps is None and by_gravity is None:
        raise InputError("the acquisition was cut off, and without tilt unit and IMU nothing tells its tilts")
    fused = fuse_tilts(steps=by_steps, gravity=by_gravity)
    note = ("the acquisition was cut off: its tilts rest on no gyroscope",)
    if not fused.is_consistent and by_gravity is not None:
        doubt = (
            f"the tilt unit's steps contradict gravity (chi2 {fused.chi2:.0f} for {fused.n_dof}): gravity is believed"
        )
        return SessionTilts(by_gravity, ("gravity",), (*note, doubt))
    names = (("steps", by_steps), ("gravity", by_gravity))
    return SessionTilts(fused, tuple(name for name, tilts in names if tilts is not None), note)


def _by_steps(rests: list[Rest], tilt: TiltDrive) -> Tilts | None:
    steps = [rest.steps for rest in rests if rest.steps is not None]
    if not isinstance(tilt, TiltUnit) or len(steps) < len(rests):
        return None
    mounting = tilt.options
    return step_tilts(
        np.array(steps),
        arcsec_per_step=tilt.info.arcsec_per_step,
        zero_count=mounting.zero_steps,
        tilt_sign=mounting.tilt_sign,
    )


def _by_gravity(journalled: Journalled, axis_in_imu: FloatArray) -> Tilts:
    series = [one for log in journalled.imu.values() if (one := log.series()) is not None]
    stamp_s = np.concatenate([one.stamp_s for one in series])
    setting = np.full(len(stamp_s), -1, dtype=np.int64)
    for k, rest in enumerate(journalled.rests):
        setting[(stamp_s >= rest.begin_s + SETTLE_S) & (stamp_s <= rest.end_s)] = k
    force_m_s2 = np.concatenate([one.acceleration_m_s2 for one in series])
    return gravity_tilts(force_m_s2, stamp_s, setting, axis_in_imu=axis_in_imu)


def _samples(batch: pb.ImuBatch) -> Iterator[ImuSample]:
    rate, force = np.reshape(batch.rate_rad_s, (-1, 3)), np.reshape(batch.acceleration_m_s2, (-1, 3))
    for k, sequence in enumerate(batch.sample):
        yield ImuSample(sequence, batch.device_s[k], 1e-9 * batch.arrival_ns[k], rate[k], force[k])


def _rows(journal: Journal, session: str) -> Iterator[tuple[Kind, bytes]]:
    """Kind and payload of a session's rows, in the order in which they were written."""
    for span in journal.spans(session):
        for _, key, payload in journal.rows(session, span.boot, span.first, span.last, max_bytes=MAX_BYTES):
            parsed = parse_observation(key)
            if parsed is not None:
                yield parsed.kind, payload
