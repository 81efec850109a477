"""A whole emulated platform in virtual time, with its drivers started."""

from dataclasses import dataclass

import numpy as np

from lrf_stereo.synthetic import paper_scene
from nodes.devices.mti import Imu, Mti, NullImu
from nodes.devices.scip import Scip
from nodes.devices.tilt_unit import NullTiltUnit, TiltDrive, TiltUnit
from nodes.lrf.acquisition import Phase, Progress
from nodes.lrf_node import LrfDevices
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from nodes.simulated.mti_device import MtiDevice
from nodes.simulated.platform import SimulatedPlatform, Tilting, Waving
from nodes.simulated.scip_device import ScipDevice
from nodes.simulated.tilt_unit_device import AxisModel, TiltUnitDevice
from nodes.simulated.tilting_person import TiltingPerson


@dataclass
class EmulatedPlatform:
    clock: VirtualClock
    room: SimulatedPlatform
    tilt_device: TiltUnitDevice
    devices: LrfDevices


@dataclass
class HandTiltedPlatform:
    """Scanner and IMU only; the person does what the progress says."""

    clock: VirtualClock
    room: SimulatedPlatform
    person: TiltingPerson
    devices: LrfDevices
    tilts_rad: tuple[float, ...]
    n_asked: int = 0

    def heed(self, progress: Progress) -> None:
        """To be told of progress: asks the person once for every tilt."""
        if progress.phase is Phase.MOVING and progress.setting == self.n_asked:
            self.person.ask(self.tilts_rad[self.n_asked], self.clock())
            self.n_asked += 1


def emulated(*, seed=1, waving=None, faults=None, has_imu=True, has_tilt_unit=True, play=2.0) -> EmulatedPlatform:
    """Started devices; `faults` are those of the scanner's line."""
    clock = VirtualClock()
    tilt_device = TiltUnitDevice(tilt=AxisModel(-1200, 604, play=play))
    room = _room(tilt_device, seed, waving or Waving(away_s=4.5, period_s=6.0))
    tilt: TiltDrive = NullTiltUnit()
    if has_tilt_unit:
        tilt = TiltUnit(LoopbackTransport(tilt_device, clock), clock=clock)
        tilt.start()
    return EmulatedPlatform(clock, room, tilt_device, _devices(room, clock, tilt, seed, faults, has_imu=has_imu))


def hand_tilted(tilts_rad, *, seed=1, hand=None, begin_rad=0.0) -> HandTiltedPlatform:
    """Started devices, and a person who stays away until the background is learnt."""
    clock = VirtualClock()
    person = TiltingPerson(np.random.default_rng([seed, 7]), hand=hand, begin_rad=begin_rad)
    room = _room(person, seed, Waving(away_s=8.0, period_s=6.0))
    devices = _devices(room, clock, NullTiltUnit(), seed, None, has_imu=True)
    return HandTiltedPlatform(clock, room, person, devices, tuple(tilts_rad))


def _room(tilting: Tilting, seed, waving) -> SimulatedPlatform:
    scene = paper_scene(rng=np.random.default_rng(seed), n_spots_per_tilt=1)
    return SimulatedPlatform(scene, tilting, seed=seed, waving=waving)


def _devices(room, clock, tilt, seed, faults, *, has_imu) -> LrfDevices:
    scanner_device = ScipDevice(room.scan_at)

    def open_scanner() -> LoopbackTransport:
        return LoopbackTransport(scanner_device, clock, faults=faults)

    scanner = Scip(open_scanner(), clock=clock)
    scanner.start()
    imu: Imu = NullImu()
    if has_imu:
        imu = Mti(LoopbackTransport(MtiDevice(room.motion, rng=np.random.default_rng(seed)), clock), clock=clock)
    imu.start()
    return LrfDevices(scanner, tilt, imu, open_scanner)
