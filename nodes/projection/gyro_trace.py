"""How far a gyroscope turned about the tilt axis, from its last samples, with the bias of the rest before."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from lrf_stereo.tilt import ImuNoise
from network_calib.observations import FloatArray, IntArray
from nodes.bus import spotcal_pb2 as pb

KEPT = 16384  # samples: at 100 Hz nearly three minutes, longer than any move
# The clocks of sensor and node are held together by the least delayed sample of so many batches, 10 s.
N_DELAYS = 100
# A platform that has just stopped still swings, and the bias is that of the last seconds before the move.
SETTLE_NS, BIAS_NS = 10**9, 10 * 10**9
MIN_BIAS_SAMPLES = 20
# Samples come in batches of 0.1 s; so long after the last one it may have gone on as it did.
AHEAD_S = 0.3
MAX_GAP_S = 0.05
S_NS = 10**9


@dataclass(frozen=True, slots=True)
class Turned:
    """(N,) angles turned about the tilt axis since a moment, and their standard deviations; NaN where not known."""

    angle_rad: FloatArray
    sigma_rad: FloatArray


class GyroTrace:
    """The last samples of one IMU.

    Args:
        axis_in_imu: (3,) the tilt axis in the IMU's axes.
        noise: of the IMU.
    """

    def __init__(self, axis_in_imu: FloatArray, noise: ImuNoise) -> None:
        self._axis, self._noise = axis_in_imu / np.linalg.norm(axis_in_imu), noise
        self._boot = b""
        self._device_s, self._rate, self._n = np.empty(2 * KEPT), np.empty(2 * KEPT), 0
        self._delays_s: deque[float] = deque(maxlen=N_DELAYS)
        self._epoch_ns = 0

    def add(self, batch: pb.ImuBatch) -> None:
        """Take the samples of a batch. A sensor that began to count anew begins a new trace."""
        device_s = np.array(batch.device_s)
        is_anew = self._n and (batch.header.boot != self._boot or device_s[0] <= self._device_s[self._n - 1])
        if is_anew or not self._n:
            self._boot, self._n, self._epoch_ns = batch.header.boot, 0, batch.arrival_ns[0]
            self._delays_s.clear()
        if self._n + len(device_s) > len(self._device_s):
            kept = slice(self._n - KEPT, self._n)
            self._device_s[:KEPT], self._rate[:KEPT], self._n = self._device_s[kept], self._rate[kept], KEPT
        rows = slice(self._n, self._n + len(device_s))
        self._device_s[rows] = device_s
        self._rate[rows] = np.reshape(batch.rate_rad_s, (-1, 3)) @ self._axis
        self._n += len(device_s)
        arrival_s = (np.array(batch.arrival_ns) - self._epoch_ns) / S_NS
        self._delays_s.append(float((arrival_s - device_s).min()))

    def turned(self, rest_begin_ns: int, rest_end_ns: int, stamp_ns: IntArray) -> Turned | None:
        """Turned since `rest_end_ns`, at later times (N,); None where the rest before it tells no bias.

        The gyroscope's white noise adds up as in `lrf_stereo.tilt.gyro_turns`: density^2 (m + m^2 / r) for a move of m
        seconds after a rest of r. After the last sample the rate is taken to go on, give or take as much again.
        """
        bias = self._bias(rest_begin_ns, rest_end_ns)
        if bias is None:
            return None
        bias_rad_s, rest_s = bias
        time_s = self._time_s()
        begin_s, ask_s = (rest_end_ns - self._epoch_ns) / S_NS, (stamp_ns - self._epoch_ns) / S_NS
        rows = slice(max(int(np.searchsorted(time_s, begin_s)) - 1, 0), self._n)
        times, rate = time_s[rows], self._rate[rows] - bias_rad_s
        if len(times) < 2:
            return None
        steps = np.diff(times)
        angle = np.concatenate([[0.0], np.cumsum(steps * (rate[1:] + rate[:-1]) / 2)])
        ahead_s = np.maximum(ask_s - times[-1], 0.0)
        at_begin = np.interp(begin_s, times, angle)
        turned = np.interp(ask_s, times, angle) - at_begin + ahead_s * rate[-1]
        moved_s = np.maximum(ask_s - begin_s, 0.0)
        variance = self._noise.gyro_rad_s_sqrt_hz**2 * (moved_s + moved_s**2 / rest_s)
        variance += (ahead_s * rate[-1]) ** 2
        gap = np.flatnonzero(steps > MAX_GAP_S)
        known_until_s = times[gap[0]] if len(gap) else times[-1]
        is_unknown = ask_s > known_until_s + AHEAD_S
        if len(gap):
            is_unknown |= ask_s > times[gap[0]]
        return Turned(np.where(is_unknown, np.nan, turned), np.where(is_unknown, np.nan, np.sqrt(variance)))

    def _bias(self, rest_begin_ns: int, rest_end_ns: int) -> tuple[float, float] | None:
        """Mean rate at the end of a rest, and over how many seconds it was taken."""
        if not self._n:
            return None
        begin_ns = max(rest_begin_ns + SETTLE_NS, rest_end_ns - BIAS_NS)
        time_s = self._time_s()
        first, last = np.searchsorted(time_s, [(stamp - self._epoch_ns) / S_NS for stamp in (begin_ns, rest_end_ns)])
        if last - first < MIN_BIAS_SAMPLES:
            return None
        return float(self._rate[first:last].mean()), float(time_s[last - 1] - time_s[first])

    def _time_s(self) -> FloatArray:
        """(n,) times of the samples on the node's clock, counted from the epoch."""
        return self._device_s[: self._n] + min(self._delays_s)
