"""The LRF tilted by hand: from gyroscope samples, how far it was turned, and since when it stands still.

The gyroscope has a bias of the size of a slow turn. What tells rest from turning is that a hand never turns evenly: the
rate is averaged over pieces of PIECE_S, and where those of the last `still_s` agree to within the sensor's noise, about
a mean that may be the bias, it rests. Turns add up only while it does not, so that they
do not drift.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from lrf_stereo.tilt import ImuNoise, gravity_tilts
from network_calib.errors import InputError
from network_calib.observations import FloatArray
from nodes.devices.mti import ImuSample

PIECE_S = 0.1
# Of the noise of a piece: one false alarm in half a million pieces of three axes, a week.
N_SIGMA = 6.0
# So evenly for so long turns no hand: a bias, however large.
CERTAINLY_STILL_S = 5.0
# The bias drifts slowly; followed faster, it would follow the slow begin of a turn.
BIAS_MEMORY_S = 20.0
# A turn begins slowly: this long before it shows, the LRF stood still for certain.
ONSET_S = 0.5
# Samples so far apart are of two recordings.
MAX_GAP_S = 0.5


@dataclass(frozen=True, slots=True)
class HandTiltOptions:
    """When a tilt by hand counts as done.

    Attributes:
        noise: of the IMU.
        still_s: how long it must have been still.
        min_turn_rad: how far it must have been turned since the last tilt.
        near_rad: before the first tilt: so near to the angle that was asked for, it need not be turned at all.
        bump_rad: a turn that spoils what is being acquired.
        max_bias_rad_s: of the gyroscope; 1 deg/s is published of an MTi-G.
    """

    noise: ImuNoise = field(default_factory=ImuNoise)
    still_s: float = 1.5
    min_turn_rad: float = float(np.radians(3.0))
    near_rad: float = float(np.radians(2.0))
    bump_rad: float = float(np.radians(0.3))
    max_bias_rad_s: float = float(np.radians(2.0))

    @property
    def still_rad_s(self) -> float:
        """How far a piece's mean rate may be from that of the others while it is still."""
        return N_SIGMA * self.noise.gyro_rad_s_sqrt_hz / float(np.sqrt(PIECE_S))


@dataclass(frozen=True, slots=True)
class _Piece:
    begin_s: float
    duration_s: float
    rate_rad_s: FloatArray
    acceleration_m_s2: FloatArray


class HandTilt:
    """Watches one LRF; feed it every sample.

    Args:
        options: when a tilt counts as done.
        axis_in_imu: (3,) the tilt axis in the IMU's axes.
    """

    def __init__(self, options: HandTiltOptions | None = None, *, axis_in_imu: FloatArray) -> None:
        self.options = options or HandTiltOptions()
        self._axis = axis_in_imu
        self._samples: list[ImuSample] = []
        n_pieces = round(self.options.still_s / PIECE_S)
        self._pieces: deque[_Piece] = deque(maxlen=n_pieces)
        self._bias: FloatArray | None = None
        self._steady_s = 0.0
        self._still_since_s: float | None = None
        self._turn = np.zeros(3)
        self._turning_since_s: float | None = None

    def begin(self) -> None:
        """Count turns from here."""
        self._turn = np.zeros(3)
        self._turning_since_s = None

    def add(self, sample: ImuSample) -> None:
        """Take a sample; its times must grow."""
        if self._samples and sample.device_s - self._samples[-1].device_s > MAX_GAP_S:
            self._samples.clear()
            self._pieces.clear()
            self._still_since_s, self._steady_s = None, 0.0
        self._samples.append(sample)
        if sample.device_s - self._samples[0].device_s >= PIECE_S:
            self._take(self._samples[:-1], self._samples[-1].device_s - self._samples[0].device_s)
            self._samples = [sample]

    @property
    def still_since_s(self) -> float | None:
        """Since when it stands still, on this machine's clock; None while it does not."""
        return self._still_since_s

    @property
    def turned_rad(self) -> float:
        """By how much it was turned since `begin`."""
        return float(np.linalg.norm(self._turn))

    @property
    def left_s(self) -> float | None:
        """Until when it surely stood as at `begin`, on this machine's clock; None while it was not turned."""
        return None if self._turning_since_s is None else self._turning_since_s - ONSET_S

    @property
    def tilt_rad(self) -> float | None:
        """The tilt as gravity shows it; None while it does not stand still, or where gravity does not show it."""
        if self._still_since_s is None:
            return None
        up = np.mean([piece.acceleration_m_s2 for piece in self._pieces], axis=0)
        try:
            tilts = gravity_tilts(np.stack([up, up]), np.arange(2.0), np.zeros(2, np.int64), axis_in_imu=self._axis)
        except InputError:
            return None
        return float(tilts.angle_rad[0])

    def has_arrived(self, target_rad: float, *, is_first: bool) -> bool:
        """Whether it was tilted and let go. Before the first tilt it may stand there already."""
        if self._still_since_s is None:
            return False
        if self.turned_rad >= self.options.min_turn_rad:
            return True
        tilt = self.tilt_rad if is_first else None
        return tilt is not None and abs(tilt - target_rad) <= self.options.near_rad

    @property
    def is_bumped(self) -> bool:
        """Whether it was turned since `begin` by so much that it stands at another tilt now."""
        return self.turned_rad > self.options.bump_rad

    def _take(self, samples: list[ImuSample], duration_s: float) -> None:
        rate = np.mean([sample.rate_rad_s for sample in samples], axis=0)
        force = np.mean([sample.acceleration_m_s2 for sample in samples], axis=0)
        piece = _Piece(samples[0].arrival_s, duration_s, rate, force)
        self._pieces.append(piece)
        over_bias = rate if self._bias is None else rate - self._bias
        is_turning = bool(np.abs(over_bias).max() > self._turning_rad_s)
        if is_turning and self._turning_since_s is None:
            self._turning_since_s = piece.begin_s
        # The slow end of a turn belongs to it.
        if is_turning or (self._bias is not None and self._still_since_s is None):
            self._turn = self._turn + duration_s * over_bias
        self._judge(duration_s)

    @property
    def _turning_rad_s(self) -> float:
        """Rates over the bias that are a turn's; while the bias is unknown, it could be one."""
        unknown = self.options.max_bias_rad_s if self._bias is None else 0.0
        return self.options.still_rad_s + unknown

    def _judge(self, duration_s: float) -> None:
        """Whether it is still now, and by which bias."""
        rates = np.array([piece.rate_rad_s for piece in self._pieces])
        mean, limit = rates.mean(axis=0), self.options.still_rad_s
        is_full = len(self._pieces) == self._pieces.maxlen
        is_steady = is_full and float(np.abs(rates - mean).max()) <= limit
        self._steady_s = self._steady_s + duration_s if is_steady else 0.0
        known = np.zeros(3) if self._bias is None else self._bias
        # A mean of n pieces scatters by 1 / sqrt(n) of one piece; twice that leaves room for a bias that drifts.
        largest = self.options.max_bias_rad_s if self._bias is None else 2 * limit / np.sqrt(len(rates))
        is_bias = float(np.abs(mean - known).max()) <= largest
        if not (is_steady and is_bias) and self._steady_s < CERTAINLY_STILL_S:
            self._still_since_s = None
            return
        follows = min(duration_s / BIAS_MEMORY_S, 1.0) if is_bias and self._bias is not None else 1.0
        self._bias = known + follows * (mean - known)
        if self._still_since_s is None:
            self._still_since_s = self._pieces[0].begin_s
