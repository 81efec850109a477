"""The tilt of one LRF at any time, from what its node publishes: rests, moves in between, and gyroscope samples.

At rest the tilt is what the tilt unit told, or, once the angles of all tilts were fused, what they say. A move begins
with the node's word that it does and ends with the next rest. Within it the gyroscope is integrated, held at both ends
once the move is over; without a gyroscope a move that is over is bridged by a straight line, and one that is not is
not known. Stamps are those of the node's clock, which scans, samples and rests share.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lrf_stereo.tilt import ARCSEC_RAD, PAPER_AXIS, ImuNoise
from network_calib.observations import FloatArray, IntArray
from nodes.bus import spotcal_pb2 as pb
from nodes.projection.gyro_trace import GyroTrace

# Rounding to a step of the tilt unit, step / sqrt(12); the resolution is that of the Directed Perception units.
STEP_SIGMA_RAD = 185.1428 * ARCSEC_RAD / np.sqrt(12)
# Tilted by hand, the LRF stands where the person let go, about where the node asked for.
HAND_SIGMA_RAD = float(np.radians(3.0))
MAX_RESTS = 512
S_NS = 10**9


@dataclass(slots=True)
class Rest:
    """The LRF at one tilt.

    Attributes:
        begin_ns: when it had come to rest.
        setting: number of the tilt.
        session: that it belongs to.
        tilt_rad: where it stands.
        sigma_rad: standard deviation of that.
        end_ns: when it was told to move on; None while it stands, or where nobody told.
    """

    begin_ns: int
    setting: int
    session: str
    tilt_rad: float
    sigma_rad: float
    end_ns: int | None = None


class TiltTrack:
    """Of one LRF; messages go in as they come. Not for two threads at a time.

    Args:
        axis_in_imu: (3,) the tilt axis in the IMU's axes.
        noise: of the IMU.
    """

    def __init__(self, *, axis_in_imu: FloatArray = PAPER_AXIS, noise: ImuNoise | None = None) -> None:
        self._gyro = GyroTrace(axis_in_imu, noise or ImuNoise())
        self._rests: list[Rest] = []

    def rest(self, sample: pb.TiltSample) -> None:
        """It has come to rest. What is older than the last rest is of another time, and is passed over."""
        begin_ns = sample.header.stamp_ns
        if self._rests and begin_ns <= self._rests[-1].begin_ns:
            return
        sigma_rad = STEP_SIGMA_RAD if sample.has_steps else HAND_SIGMA_RAD
        self._rests.append(Rest(begin_ns, sample.setting, sample.header.session, sample.tilt_rad, sigma_rad))
        del self._rests[:-MAX_RESTS]

    def leave(self, stamp_ns: int) -> None:
        """It moves from now on, or may."""
        if self._rests and self._rests[-1].end_ns is None:
            self._rests[-1].end_ns = max(stamp_ns, self._rests[-1].begin_ns)

    def settle(self, settings: pb.TiltSettings) -> None:
        """The angles of all tilts of a session were fused: they take the place of what the unit told."""
        sigma_rad = np.sqrt(np.maximum(np.array(settings.covariance_rad2)[:: len(settings.angle_rad) + 1], 0.0))
        for rest in self._rests:
            if rest.session == settings.header.session and rest.setting < len(settings.angle_rad):
                rest.tilt_rad, rest.sigma_rad = settings.angle_rad[rest.setting], float(sigma_rad[rest.setting])

    def turn(self, batch: pb.ImuBatch) -> None:
        """Gyroscope samples."""
        self._gyro.add(batch)

    def at(self, stamp_ns: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Tilts and their standard deviations at times (N,), rad; NaN where nothing is known."""
        stamps = np.atleast_1d(np.asarray(stamp_ns, dtype=np.int64))
        tilt_rad, sigma_rad = np.full(stamps.shape, np.nan), np.full(stamps.shape, np.nan)
        if not (len(self._rests) and len(stamps)):
            return tilt_rad, sigma_rad
        first = max(self._index_at(int(stamps.min())), 0)
        for k in range(first, self._index_at(int(stamps.max())) + 1):
            rest = self._rests[k]
            after = self._rests[k + 1] if k + 1 < len(self._rests) else None
            is_here = (stamps >= rest.begin_ns) & (
                stamps < (np.iinfo(np.int64).max if after is None else after.begin_ns)
            )
            is_still = is_here & (stamps <= self._end_ns(rest, after))
            tilt_rad[is_still], sigma_rad[is_still] = rest.tilt_rad, rest.sigma_rad
            moving = np.flatnonzero(is_here & ~is_still)
            if len(moving):
                tilt_rad[moving], sigma_rad[moving] = self._between(rest, after, stamps[moving])
        return tilt_rad, sigma_rad

    def _index_at(self, stamp_ns: int) -> int:
        return bisect_right(self._rests, stamp_ns, key=lambda rest: rest.begin_ns) - 1

    @staticmethod
    def _end_ns(rest: Rest, after: Rest | None) -> int:
        """Until when it surely stood. Where nobody told and it stood elsewhere afterwards, only its begin is sure."""
        if rest.end_ns is not None:
            return rest.end_ns
        return np.iinfo(np.int64).max if after is None else rest.begin_ns

    def _between(self, rest: Rest, after: Rest | None, stamps: IntArray) -> tuple[FloatArray, FloatArray]:
        """While it moves."""
        begin_ns = self._end_ns(rest, after)
        turned = None
        if rest.end_ns is not None:
            turned = self._gyro.turned(rest.begin_ns, begin_ns, stamps)
        if after is None:
            if turned is None:
                return np.full(len(stamps), np.nan), np.full(len(stamps), np.nan)
            return rest.tilt_rad + turned.angle_rad, np.hypot(rest.sigma_rad, turned.sigma_rad)
        share = (stamps - begin_ns) / max(after.begin_ns - begin_ns, 1)
        ends = np.hypot((1 - share) * rest.sigma_rad, share * after.sigma_rad)
        missing_rad = after.tilt_rad - rest.tilt_rad
        shape, noise = 0.0, 0.0
        if turned is not None:
            whole = self._gyro.turned(rest.begin_ns, begin_ns, np.array([after.begin_ns]))
            if whole is not None and np.isfinite(whole.angle_rad[0]) and np.isfinite(turned.angle_rad).all():
                missing_rad -= whole.angle_rad[0]
                shape = turned.angle_rad
                # Held at both ends, what the noise adds up to is a bridge.
                noise = whole.sigma_rad[0] * np.sqrt(share * (1 - share))
        # Whatever way was taken from one end to the other without turning back, it lies between them: at the ends it is
        # known, in the middle it is anywhere, like an even distribution over what is missing.
        anywhere = 4 * share * (1 - share) * np.abs(missing_rad) / np.sqrt(12)
        return rest.tilt_rad + shape + share * missing_rad, np.sqrt(ends**2 + noise**2 + anywhere**2)
