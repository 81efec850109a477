"""A whole emulated platform in virtual time, with its drivers started."""

from dataclasses import dataclass

import numpy as np

from lrf_stereo.synthetic import paper_scene
from nodes.devices.mti import Imu, Mti, NullImu
from nodes.devices.scip import Scip
from nodes.devices.tilt_unit import NullTiltUnit, TiltDrive, TiltUnit
from nodes.lrf_node import LrfDevices
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from nodes.simulated.mti_device import MtiDevice
from nodes.simulated.platform import SimulatedPlatform, Waving
from nodes.simulated.scip_device import ScipDevice
from nodes.simulated.tilt_unit_device import AxisModel, TiltUnitDevice


@dataclass
class EmulatedPlatform:
    clock: VirtualClock
    room: SimulatedPlatform
    tilt_device: TiltUnitDevice
    devices: LrfDevices


def emulated(*, seed=1, waving=None, faults=None, has_imu=True, has_tilt_unit=True, play=2.0) -> EmulatedPlatform:
    """Started devices; `faults` are those of the scanner's line."""
    clock = VirtualClock()
    tilt_device = TiltUnitDevice(tilt=AxisModel(-1200, 604, play=play))
    scene = paper_scene(rng=np.random.default_rng(seed), n_spots_per_tilt=1)
    room = SimulatedPlatform(scene, tilt_device, seed=seed, waving=waving or Waving(away_s=4.5, period_s=6.0))
    scanner_device = ScipDevice(room.scan_at)

    def open_scanner() -> LoopbackTransport:
        return LoopbackTransport(scanner_device, clock, faults=faults)

    scanner = Scip(open_scanner(), clock=clock)
    scanner.start()
    tilt: TiltDrive = NullTiltUnit()
    if has_tilt_unit:
        tilt = TiltUnit(LoopbackTransport(tilt_device, clock), clock=clock)
        tilt.start()
    imu: Imu = NullImu()
    if has_imu:
        imu = Mti(LoopbackTransport(MtiDevice(room.motion, rng=np.random.default_rng(seed)), clock), clock=clock)
    imu.start()
    return EmulatedPlatform(clock, room, tilt_device, LrfDevices(scanner, tilt, imu, open_scanner))
