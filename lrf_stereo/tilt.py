"""The tilt angle, with its covariance, from gyroscope, gravity and step count: each alone or fused (section III-B).

The paper integrates the gyroscope alone. A gyroscope sees only differences of angle, and they drift; gravity does not
drift but has an unknown zero (the base need not be level); a tilt unit's step count is the finest, until it loses
steps. Only differences of angle matter to the calibration, so a common zero of one source against another is estimated
and thrown away.

Signs: a tilt above zero turns the LRF's forward axis down, right-handed about the tilt axis (y left in the paper).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from network_calib.errors import InputError
from network_calib.observations import FloatArray, IntArray

ARCSEC_RAD = float(np.deg2rad(1 / 3600))
GRAVITY_M_S2 = 9.81
PAPER_AXIS = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of an inertial sensor; the defaults are published figures of an Xsens MTi-G.

    Attributes:
        gyro_rad_s_sqrt_hz: white noise density of the rate, 0.05 deg/s/sqrt(Hz).
        acceleration_m_s2_sqrt_hz: white noise density of the acceleration, 0.12 m/s/sqrt(h).
        gravity_repeatability_rad: what a gravity angle still varies by after averaging, 0.2 deg.
    """

    gyro_rad_s_sqrt_hz: float = float(np.deg2rad(0.05))
    acceleration_m_s2_sqrt_hz: float = 0.12 / 60
    gravity_repeatability_rad: float = float(np.deg2rad(0.2))


@dataclass(frozen=True, slots=True)
class Tilts:
    """Angles of T tilt settings.

    Attributes:
        angle_rad: (T,).
        covariance_rad2: (T, T). Zero is where the source has it: step zero, level, or else the first setting, which
            then has no variance.
        chi2: how much the fused sources disagree; 0 for one source.
        n_dof: expected value of `chi2`.
    """

    angle_rad: FloatArray
    covariance_rad2: FloatArray
    chi2: float = 0.0
    n_dof: int = 0

    @property
    def sigma_rad(self) -> FloatArray:
        return np.sqrt(np.diag(self.covariance_rad2))

    @property
    def is_consistent(self) -> bool:
        """Whether the sources agree: lost steps or a bumped sensor give False. Honest sources do once in 1000."""
        return self.n_dof == 0 or self.chi2 <= float(chi2_distribution.ppf(0.999, self.n_dof))

    def relative_to(self, setting: int) -> Tilts:
        """The same angles counted from one setting, which then has no variance: all that the calibration can use."""
        change = np.eye(len(self.angle_rad))
        change[:, setting] -= 1
        return replace(
            self, angle_rad=change @ self.angle_rad, covariance_rad2=change @ self.covariance_rad2 @ change.T
        )


@dataclass(frozen=True, slots=True)
class Turns:
    """Differences of angle between T settings in order of time, as a gyroscope gives them.

    Attributes:
        turn_rad: (T - 1,) angle of setting k + 1 less that of setting k.
        covariance_rad2: (T - 1, T - 1); neighbours are correlated, because they share a rest.
    """

    turn_rad: FloatArray
    covariance_rad2: FloatArray


def step_tilts(
    count: npt.ArrayLike, *, arcsec_per_step: float = 185.1428, zero_count: float = 0.0, tilt_sign: int = -1
) -> Tilts:
    """Angles from a tilt unit's positions (T,); sigma is that of rounding to a step, step / sqrt(12).

    Args:
        count: (T,) positions.
        arcsec_per_step: the unit's resolution, its reply to `TR`.
        zero_count: the position that is called tilt zero.
        tilt_sign: -1 where positions grow upwards, as on the Directed Perception units; +1 where they grow downwards.

    Raises:
        InputError: the sign is not +1 or -1, or the resolution is not positive.
    """
    if tilt_sign not in (-1, 1) or not arcsec_per_step > 0:
        raise InputError(f"tilt sign {tilt_sign} must be 1 or -1 and resolution {arcsec_per_step} arcsec positive")
    position = np.atleast_1d(np.asarray(count, dtype=np.float64))
    step_rad = arcsec_per_step * ARCSEC_RAD
    variance = np.full(len(position), step_rad**2 / 12)
    return Tilts(tilt_sign * step_rad * (position - zero_count), np.diag(variance))


def gravity_tilts(
    acceleration_m_s2: FloatArray,
    stamp_s: FloatArray,
    setting: IntArray,
    *,
    axis_in_imu: FloatArray = PAPER_AXIS,
    noise: ImuNoise | None = None,
) -> Tilts:
    """Angles about the tilt axis from the accelerometer at rest: zero is where gravity has no forward part.

    Args:
        acceleration_m_s2: (M, 3) specific force, +9.81 upwards at rest, in the IMU's axes (x forward, z up).
        stamp_s: (M,) times.
        setting: (M,) tilt setting at rest, 0..T-1 in order of time; -1 while moving.
        axis_in_imu: (3,) tilt axis.
        noise: of the sensor; an MTi-G by default.

    Raises:
        InputError: a setting has no samples or was not at rest (mean force off 9.81 by 5 %), or the axis stands within
            10 degrees of the vertical, where gravity does not see the tilt.
    """
    sensor = noise or ImuNoise()
    rests = _rests(stamp_s, setting)
    up = np.stack([acceleration_m_s2[rest].mean(axis=0) for rest in rests])
    strength = np.linalg.norm(up, axis=1)
    if (np.abs(strength / GRAVITY_M_S2 - 1) > 0.05).any():
        k = int(np.abs(strength / GRAVITY_M_S2 - 1).argmax())
        raise InputError(f"mean acceleration in tilt setting {k} is {strength[k]:.2f} m/s2: the sensor was not at rest")
    axis = axis_in_imu / np.linalg.norm(axis_in_imu)
    # Tilt zero: up lies along `vertical`. A tilt a leaves up = cos(a) vertical - sin(a) forward in the turned sensor.
    vertical = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    seen = np.linalg.norm(up - (up @ axis)[:, None] * axis, axis=1)
    if np.linalg.norm(vertical) < np.sin(np.deg2rad(10)) or (seen / strength < np.sin(np.deg2rad(10))).any():
        raise InputError("the tilt axis is within 10 degrees of the vertical: gravity does not show the tilt")
    vertical /= np.linalg.norm(vertical)
    angle = np.arctan2(-(up @ np.cross(axis, vertical)), up @ vertical)
    duration = np.array([len(rest) for rest in rests]) * _period(stamp_s)
    white = sensor.acceleration_m_s2_sqrt_hz / seen
    return Tilts(angle, np.diag(sensor.gravity_repeatability_rad**2 + white**2 / duration))


def gyro_turns(
    stamp_s: FloatArray, rate_rad_s: FloatArray, setting: IntArray, *, noise: ImuNoise | None = None
) -> Turns:
    """Integrate the rate about the tilt axis between rests, less the bias learnt in the rest before and after.

    Two rests of equal length cancel a bias that drifts linearly. The result is linear in the samples, so its covariance
    follows from their white noise exactly: for a move of m seconds between rests of r seconds each,
    density^2 (m + m^2 / (2 r)).

    Args:
        stamp_s: (M,) times, increasing.
        rate_rad_s: (M,) turn rate about the tilt axis.
        setting: (M,) tilt setting at rest, 0..T-1 in order of time; -1 while moving.
        noise: of the sensor; an MTi-G by default.

    Raises:
        InputError: fewer than two settings, a setting without samples or out of order, times that do not increase, or
            samples missing from a move.
    """
    rests = _rests(stamp_s, setting)
    if len(rests) < 2:
        raise InputError(f"a gyroscope measures turns between two tilt settings or more, got {len(rests)}")
    period = _period(stamp_s)
    operator = np.zeros((len(rests) - 1, len(stamp_s)))
    for k, (before, after) in enumerate(pairwise(rests)):
        first, last = int(before[-1]), int(after[0])
        interval = np.diff(stamp_s[first : last + 1])
        if interval.max() > 2.5 * period:
            raise InputError(
                f"{interval.max():.3f} s without gyroscope samples in the move to tilt setting {k + 1}, where one is "
                f"expected every {period:.3f} s: the turn cannot be integrated"
            )
        operator[k, first:last] += interval / 2
        operator[k, first + 1 : last + 1] += interval / 2
        # Each rest gives its own mean, weighed equally: weighing by length would let a drift through.
        for rest in (before, after):
            operator[k, rest] -= 0.5 * interval.sum() / len(rest)
    variance = (noise or ImuNoise()).gyro_rad_s_sqrt_hz ** 2 / period
    return Turns(operator @ rate_rad_s, variance * operator @ operator.T)


def fuse_tilts(*, steps: Tilts | None = None, gravity: Tilts | None = None, gyro: Turns | None = None) -> Tilts:
    """Weighted least squares of all settings' angles from any of the three sources.

    Zero is the step count's where there is one, else gravity's, else the first setting. Against the step count, the
    zero of gravity is one more unknown.

    Raises:
        InputError: no source, or sources of different numbers of settings.
    """
    sizes = {len(source.angle_rad) for source in (steps, gravity) if source} | (
        {len(gyro.turn_rad) + 1} if gyro else set()
    )
    if len(sizes) != 1:
        raise InputError(f"tilt sources must have one number of settings, got {sorted(sizes) or 'no source'}")
    n = sizes.pop()
    # Unknowns: the angles, and the zero of gravity against the step count.
    n_unknowns = n + int(steps is not None and gravity is not None)
    rows: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for tilts in (steps, gravity):
        if tilts is not None:
            zero = np.full((n, n_unknowns - n), float(tilts is gravity))
            rows.append((np.column_stack([np.eye(n), zero]), tilts.angle_rad, tilts.covariance_rad2))
    if gyro is not None:
        rows.append((np.diff(np.eye(n, n_unknowns), axis=0), gyro.turn_rad, gyro.covariance_rad2))
    return _least_squares(rows, n, is_first_zero=steps is None and gravity is None)


def _least_squares(rows: list[tuple[FloatArray, FloatArray, FloatArray]], n: int, *, is_first_zero: bool) -> Tilts:
    """The first n unknowns of stacked (design, value, covariance); the first unknown is 0 by definition if asked."""
    white = [np.linalg.inv(np.linalg.cholesky(covariance)) for _, _, covariance in rows]
    design = np.concatenate([w @ part for w, (part, _, _) in zip(white, rows, strict=True)])
    value = np.concatenate([w @ part for w, (_, part, _) in zip(white, rows, strict=True)])
    free = np.arange(int(is_first_zero), design.shape[1])
    inverse = np.linalg.inv(design[:, free].T @ design[:, free])
    solution, covariance = np.zeros(design.shape[1]), np.zeros((design.shape[1],) * 2)
    solution[free], covariance[np.ix_(free, free)] = inverse @ (design[:, free].T @ value), inverse
    chi2 = float(((value - design @ solution) ** 2).sum())
    return Tilts(solution[:n], covariance[:n, :n], chi2, len(value) - len(free))


def _rests(stamp_s: FloatArray, setting: IntArray) -> list[IntArray]:
    """Sample indices of each setting's rest; refuses what is not settings 0..T-1 one after another."""
    if len(stamp_s) != len(setting) or (np.diff(stamp_s) <= 0).any():
        raise InputError("inertial samples need one setting each and times that increase")
    resting = setting[setting >= 0]
    n = int(resting.max()) + 1 if len(resting) else 0
    rests = [np.flatnonzero(setting == k) for k in range(n)]
    if (np.diff(resting) < 0).any() or any(len(rest) < 2 for rest in rests):
        counts = [len(rest) for rest in rests]
        raise InputError(f"tilt settings must come in order with 2 samples at rest or more each, got {counts}")
    return rests


def _period(stamp_s: FloatArray) -> float:
    return float(np.median(np.diff(stamp_s)))
