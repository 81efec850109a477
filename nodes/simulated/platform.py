"""The physics that the emulated scanner, tilt unit and IMU share: one room, one tilt, one person with the spot.

The tilt unit's angle turns the scanner and the IMU. The person stays away while the unit moves and while the background
is learnt, then raises and lowers the spot through the scan plane, at one place after another that both cameras of the
stereo pair see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import LrfScene, spots_on_plane
from lrf_stereo.synthetic_scans import Capsule, ScannedRoom, ScanNoise
from lrf_stereo.tilt import GRAVITY_M_S2
from network_calib.observations import FloatArray, IntArray

N_PLACES = 64
# A rod of 3 mm: thicker ones are seen by the scanner at two metres and taken for parts of the spot.
ROD_RADIUS_M, ARM_RADIUS_M = 0.0015, 0.045
# The spot's ball and its rod are in the hand, and the arm hangs below.
ROD_M, ARM_M = 0.35, 0.5


@dataclass(frozen=True, slots=True)
class Waving:
    """How the person moves the spot.

    Attributes:
        away_s: time after the tilt unit came to rest for which the person stays out of sight.
        period_s: from one lowest point to the next.
        amplitude_m: of the height over the scan plane.
        moving_part: part of the period, at its end, in which the person goes on to the next place.
    """

    away_s: float = 5.0
    period_s: float = 8.0
    amplitude_m: float = 0.12
    moving_part: float = 0.15


class Tilting(Protocol):
    """What tilts scanner and IMU: a tilt unit, or a person."""

    def tilt_rad(self, time_s: npt.ArrayLike) -> FloatArray:
        """True tilt at times of any shape."""
        ...

    def rests_since_s(self, time_s: float) -> float:
        """Since when it stands where it was asked to; infinite while it does not."""
        ...


class SimulatedPlatform:
    """The room as the instruments find it at any time.

    Args:
        scene: truth of cameras, scanner and walls; its spots are not used.
        tilting: what the scanner and the IMU follow.
        seed: of everything that is drawn; places and noise depend on it and on time alone.
        steps: of the scanner.
        noise: of the scanner.
        waving: of the person.
    """

    def __init__(
        self,
        scene: LrfScene,
        tilting: Tilting,
        *,
        seed: int,
        steps: ScanSteps | None = None,
        noise: ScanNoise | None = None,
        waving: Waving | None = None,
    ) -> None:
        self.scene, self._tilting, self._seed = scene, tilting, seed
        self._room = ScannedRoom.of(scene, rng=np.random.default_rng(seed), steps=steps, noise=noise)
        self._waving = waving or Waving()
        self._places = _Places(scene, seed)
        self._down_in_world = _down_in_world(scene)
        self._imu = _ImuPose.of(0.0, scene)

    def tilt_rad(self, time_s: float) -> float:
        """True tilt."""
        return float(self._tilting.tilt_rad(time_s))

    def spot_in_world(self, time_s: float) -> FloatArray | None:
        """(3,) centre of the spot; None while the person is away."""
        waving = self._waving
        since_s = time_s - self._tilting.rests_since_s(time_s) - waving.away_s
        if not 0 <= since_s < math.inf:
            return None
        cycle, part = divmod(since_s / waving.period_s, 1.0)
        tilt = self.tilt_rad(time_s)
        here, there = self._places.at(tilt, int(cycle)), self._places.at(tilt, int(cycle) + 1)
        # A smooth step from place to place at the lowest part of the wave.
        on = float(np.clip((part - 1 + waving.moving_part) / waving.moving_part, 0.0, 1.0))
        in_plane = here + (there - here) * (on * on * (3 - 2 * on))
        normal = self.scene.scanner.world_from_lrf_at(tilt).rotation.as_matrix()[:, 2]
        return in_plane - waving.amplitude_m * math.cos(2 * math.pi * part) * normal

    def bodies_at(self, time_s: float) -> tuple[Capsule, ...]:
        """The ball, its rod and the arm; nothing while the person is away."""
        spot = self.spot_in_world(time_s)
        if spot is None:
            return ()
        hand = spot + ROD_M * self._down_in_world
        elbow = hand + ARM_M * self._down_in_world
        return Capsule.ball(spot), Capsule(spot, hand, ROD_RADIUS_M), Capsule(hand, elbow, ARM_RADIUS_M)

    def scan_at(self, begin_s: float) -> IntArray:
        """(B,) readings of the turn that begins at a time; bodies are where they are when the mirror sees the spot."""
        steps, scanner = self._room.steps, self.scene.scanner
        middle_s = begin_s + float(steps.beam_time_s(0.0))
        spot, seen_s = self.spot_in_world(middle_s), middle_s
        if spot is not None:
            _, bearing, _ = scanner.measure(spot[None], self.tilt_rad(middle_s))
            seen_s = begin_s + float(steps.beam_time_s(bearing[0]))
        return self._room.readings_mm(self.tilt_rad(seen_s), self.bodies_at(seen_s), rng=self._rng(begin_s))

    def motion(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Rate of turn (3,) rad/s and specific force (3,) m/s2 in the IMU's axes, which are the LRF's."""
        half_s = 5e-4
        before, after = self._tilting.tilt_rad(np.array([time_s - half_s, time_s + half_s]))
        self._imu = self._imu.at(self.tilt_rad(time_s), self.scene)
        imu = self._imu
        return imu.axis_in_imu * float(after - before) / (2 * half_s), -GRAVITY_M_S2 * imu.down_in_imu

    def detections_px(self, time_s: float, *, sigma_px: float = 0.3) -> FloatArray:
        """(C, 2) where the cameras see the spot; NaN where one does not."""
        cameras, spot = self.scene.cameras, self.spot_in_world(time_s)
        if spot is None:
            return np.full((len(cameras), 2), np.nan)
        index = np.arange(len(cameras))
        px, is_valid = cameras.img_from_world(index, np.tile(spot, (len(cameras), 1)))
        px = px + sigma_px * self._rng(time_s).standard_normal(px.shape)
        return np.where((is_valid & cameras.is_in_image(index, px))[:, None], px, np.nan)

    def _rng(self, time_s: float) -> np.random.Generator:
        """Noise that depends on the seed and the time alone, whoever asks first."""
        return np.random.default_rng([self._seed, round(time_s * 1e6) & (1 << 62) - 1])


def _down_in_world(scene: LrfScene) -> FloatArray:
    return -scene.room.world_from_room.rotation.apply(np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True)
class _ImuPose:
    """The tilt axis and the vertical in the IMU's axes; asked for at every sample, and the same while it rests."""

    tilt_rad: float
    axis_in_imu: FloatArray
    down_in_imu: FloatArray

    @classmethod
    def of(cls, tilt_rad: float, scene: LrfScene) -> _ImuPose:
        imu_from_world = scene.scanner.world_from_lrf_at(tilt_rad).rotation.inv()
        axis = imu_from_world.apply(scene.scanner.axis_direction_in_world)
        return cls(tilt_rad, axis, imu_from_world.apply(_down_in_world(scene)))

    def at(self, tilt_rad: float, scene: LrfScene) -> _ImuPose:
        return self if tilt_rad == self.tilt_rad else self.of(tilt_rad, scene)


@dataclass(slots=True)
class _Places:
    """Places in the scan plane that both cameras see, by tilt; drawn once for every tilt at which the unit rests."""

    scene: LrfScene
    seed: int
    known: dict[int, FloatArray] = field(default_factory=dict)

    def at(self, tilt_rad: float, number: int) -> FloatArray:
        """(3,) the place of a number, over and over."""
        # The unit rests at whole steps, which are coarser than this.
        key = round(tilt_rad * 1e5)
        if key not in self.known:
            rng = np.random.default_rng([self.seed, key & 0xFFFFFFFF])
            scene = self.scene
            self.known[key] = spots_on_plane(scene.cameras, scene.scanner, tilt_rad, N_PLACES, room=scene.room, rng=rng)
        return self.known[key][number % N_PLACES]
