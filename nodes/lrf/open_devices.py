"""The instruments of an LRF node, opened as its configuration says: all or none."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

from nodes.devices import mti, scip, tilt_unit
from nodes.devices.transport import Transport, open_transport
from nodes.lrf_node import LrfDevices
from nodes.site.model import LrfDeviceConfig


def open_devices(config: LrfDeviceConfig, stack: ExitStack, *, clock: Callable[[], float]) -> LrfDevices:
    """Scanner, tilt unit and IMU, started; the stack closes their lines.

    Raises:
        DeviceError: one cannot be opened or does not answer.
    """

    def open_scanner() -> Transport:
        return open_transport(config.scanner, baud=scip.BAUD, default_port=scip.TCP_PORT)

    scanner = scip.Scip(stack.enter_context(open_scanner()), clock=clock)
    scanner.start()
    drive: tilt_unit.TiltDrive = tilt_unit.NullTiltUnit()
    if config.tilt_unit is not None:
        line = open_transport(config.tilt_unit, baud=tilt_unit.BAUD, default_port=tilt_unit.TCP_PORT)
        mounting = tilt_unit.TiltUnitOptions(tilt_sign=config.tilt_sign, zero_steps=config.zero_steps)
        unit = tilt_unit.TiltUnit(stack.enter_context(line), options=mounting, clock=clock)
        unit.start()
        drive = unit
    imu: mti.Imu = mti.NullImu()
    if config.imu is not None:
        line = open_transport(config.imu, baud=mti.BAUD, default_port=scip.TCP_PORT)
        imu = mti.Mti(stack.enter_context(line), clock=clock)
        imu.start()
    return LrfDevices(scanner, drive, imu, open_scanner)
