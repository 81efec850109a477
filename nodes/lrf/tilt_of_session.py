"""Tilt angles of an acquisition: the tilt unit's steps, the gyroscope through every move, gravity at every rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lrf_stereo.tilt import PAPER_AXIS, ImuNoise, Tilts, Turns, fuse_tilts, gravity_tilts, gyro_turns, step_tilts
from network_calib.errors import InputError
from network_calib.observations import FloatArray, IntArray

# So much of a rest beside a move tells the gyroscope's bias: longer rests drift more than they average.
BIAS_REST_S = 10.0
# A platform that has just stopped still swings.
SETTLE_S = 1.0


@dataclass(frozen=True, slots=True)
class ImuSeries:
    """M samples of an IMU.

    Attributes:
        stamp_s: (M,) times on this machine's clock.
        rate_rad_s: (M, 3) rate of turn.
        acceleration_m_s2: (M, 3) specific force.
    """

    stamp_s: FloatArray
    rate_rad_s: FloatArray
    acceleration_m_s2: FloatArray


@dataclass(frozen=True, slots=True)
class StepCounts:
    """What a tilt unit reported.

    Attributes:
        steps: (T,) positions.
        arcsec_per_step: resolution.
        zero_steps: position that is tilt zero.
        tilt_sign: -1 where positions grow upwards.
    """

    steps: IntArray | FloatArray
    arcsec_per_step: float
    zero_steps: int = 0
    tilt_sign: int = -1


@dataclass(frozen=True, slots=True)
class SessionTilts:
    """Tilts, and what they rest on.

    Attributes:
        tilts: angles and covariance of T settings.
        sources: which sources they were made of.
        notes: what was left out, and why.
    """

    tilts: Tilts
    sources: tuple[str, ...]
    notes: tuple[str, ...] = ()


def session_tilts(
    rests_s: Sequence[tuple[float, float]],
    *,
    steps: StepCounts | None = None,
    imu: ImuSeries | None = None,
    axis_in_imu: FloatArray = PAPER_AXIS,
    noise: ImuNoise | None = None,
    with_gravity: bool = True,
) -> SessionTilts:
    """Fuse what there is. Where the steps contradict the IMU, the unit lost steps, and the IMU alone is believed.

    Args:
        rests_s: T times (begin, end) of the rests, in order.
        steps: of the tilt unit, if there is one.
        imu: if there is one.
        axis_in_imu: (3,) the tilt axis in the IMU's axes.
        noise: of the IMU.
        with_gravity: whether the accelerometer is believed; not on a platform that shakes.

    Raises:
        InputError: neither steps nor IMU, or IMU samples that do not cover the moves.
    """
    if steps is None and imu is None:
        raise InputError("no tilt unit and no IMU: nothing tells the tilt angles")
    by_steps = None
    if steps is not None:
        by_steps = step_tilts(
            steps.steps, arcsec_per_step=steps.arcsec_per_step, zero_count=steps.zero_steps, tilt_sign=steps.tilt_sign
        )
    if imu is None or len(rests_s) < 2:
        if by_steps is None:
            raise InputError("one tilt setting and no tilt unit: nothing to measure")
        return SessionTilts(by_steps, ("steps",))
    gravity = None
    if with_gravity:
        gravity = gravity_tilts(
            imu.acceleration_m_s2, imu.stamp_s, _labels(imu.stamp_s, rests_s), axis_in_imu=axis_in_imu, noise=noise
        )
    sources = (*(("gravity",) if with_gravity else ()), "gyroscope")
    gyro = _moves(imu, rests_s, axis_in_imu / np.linalg.norm(axis_in_imu), noise)
    by_imu = fuse_tilts(gravity=gravity, gyro=gyro)
    if by_steps is None:
        return SessionTilts(by_imu, sources, _doubts(by_imu))
    fused = fuse_tilts(steps=by_steps, gravity=gravity, gyro=gyro)
    if fused.is_consistent:
        return SessionTilts(fused, ("steps", *sources))
    note = (
        f"the tilt unit's steps contradict the IMU (chi2 {fused.chi2:.0f} for {fused.n_dof}): the unit lost steps, or "
        "the IMU moved on its mount; the angles are the IMU's alone"
    )
    return SessionTilts(by_imu, sources, (note, *_doubts(by_imu)))


def _doubts(by_imu: Tilts) -> tuple[str, ...]:
    if by_imu.is_consistent:
        return ()
    return (f"gyroscope and gravity contradict each other (chi2 {by_imu.chi2:.0f} for {by_imu.n_dof})",)


def _labels(stamp_s: FloatArray, rests_s: Sequence[tuple[float, float]]) -> IntArray:
    """(M,) number of the rest that a sample belongs to, -1 in between."""
    out = np.full(len(stamp_s), -1, dtype=np.int64)
    for k, (begin_s, end_s) in enumerate(rests_s):
        out[(stamp_s >= begin_s + SETTLE_S) & (stamp_s <= end_s)] = k
    return out


def _moves(imu: ImuSeries, rests_s: Sequence[tuple[float, float]], axis: FloatArray, noise: ImuNoise | None) -> Turns:
    """Each move by itself, between the ends of the rests beside it: so no rest is shared, and the turns independent."""
    turns = []
    for before, after in pairwise(rests_s):
        # Half of a short rest each, where two moves share it.
        begin_s = max(before[1] - BIAS_REST_S, (before[0] + SETTLE_S + before[1]) / 2)
        end_s = min(after[0] + SETTLE_S + BIAS_REST_S, (after[0] + SETTLE_S + after[1]) / 2)
        rows = (imu.stamp_s >= begin_s) & (imu.stamp_s <= end_s)
        stamp_s = imu.stamp_s[rows]
        setting = np.where(stamp_s <= before[1], 0, np.where(stamp_s >= after[0] + SETTLE_S, 1, -1))
        turns.append(gyro_turns(stamp_s, imu.rate_rad_s[rows] @ axis, setting, noise=noise))
    return Turns(
        np.concatenate([turn.turn_rad for turn in turns]),
        np.diag(np.concatenate([np.diag(turn.covariance_rad2) for turn in turns])),
    )
