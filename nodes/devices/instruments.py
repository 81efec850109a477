"""Which instruments are on the serial ports: every port is asked in every protocol, politely."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from nodes.devices import mti, scip, tilt_unit
from nodes.devices.errors import DeviceError
from nodes.devices.transport import Transport, open_transport


class Instrument(StrEnum):
    """Kinds of instruments."""

    SCANNER = "laser scanner"
    TILT_UNIT = "tilt unit"
    IMU = "IMU"


@dataclass(frozen=True, slots=True)
class FoundInstrument:
    """A port, and what is on it.

    Attributes:
        address: as other commands take it.
        port: what the system says of the port itself.
        kind: None where nothing answered, or the port could not be opened.
        description: what the instrument says of itself, or why there is none.
    """

    address: str
    port: str
    kind: Instrument | None
    description: str


def serial_ports() -> list[tuple[str, str]]:
    """Addresses of the serial ports of this machine, and what the system says of each."""
    from serial.tools import list_ports

    return [(port.device, port.description or "") for port in sorted(list_ports.comports())]


def identify(address: str, port: str = "") -> FoundInstrument:
    """Ask whatever is at an address what it is; takes some seconds where nothing answers."""
    problem = ""
    for kind, baud, default_port, ask in _PROTOCOLS:
        try:
            with open_transport(address, baud=baud, default_port=default_port) as line:
                return FoundInstrument(address, port, kind, ask(line))
        except DeviceError as error:
            problem = error.message.removeprefix(f"{address}: ")
            # A port that cannot even be opened answers in no other protocol.
            if not problem.startswith("no answer"):
                break
    return FoundInstrument(address, port, None, problem)


def _ask_scanner(line: Transport) -> str:
    info = scip.Scip(line).identify()
    reach = f"{info.steps.n_measured} beams, {info.steps.range_max_m:g} m, {1 / info.steps.turn_s:g} Hz"
    return f"{info.product}, serial {info.serial}, {info.protocol}; {reach}"


def _ask_imu(line: Transport) -> str:
    return f"Xsens MTi, device {mti.Mti(line).identify()}"


def _ask_tilt_unit(line: Transport) -> str:
    unit = tilt_unit.TiltUnit(line)
    info = unit.start()
    return f"{info.version}; {info.arcsec_per_step:g} arcsec a step, steps {info.low_steps} to {info.high_steps}"


_PROTOCOLS: tuple[tuple[Instrument, int, int, Callable[[Transport], str]], ...] = (
    (Instrument.SCANNER, scip.BAUD, scip.TCP_PORT, _ask_scanner),
    (Instrument.IMU, mti.BAUD, scip.TCP_PORT, _ask_imu),
    (Instrument.TILT_UNIT, tilt_unit.BAUD, tilt_unit.TCP_PORT, _ask_tilt_unit),
)
