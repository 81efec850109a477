"""What a scanner says of itself."""

from __future__ import annotations

from dataclasses import dataclass

from lrf_stereo.scanner import ScanSteps
from nodes.devices.errors import DeviceError
from nodes.devices.scip_line import ScipLine


@dataclass(frozen=True, slots=True)
class ScannerInfo:
    """What the scanner says of itself.

    Attributes:
        product: name of the model.
        serial: serial number.
        firmware: version.
        protocol: such as "SCIP 2.0".
        steps: its steps, reach and speed.
        status: its own words on its health.
        line_speed: of its RS-232 side, in its own words; empty where it has none.
    """

    product: str
    serial: str
    firmware: str
    protocol: str
    steps: ScanSteps
    status: str
    line_speed: str


def read_info(line: ScipLine) -> ScannerInfo:
    """Ask for all of it.

    Raises:
        DeviceError: no answer, or parameters that make no sense.
    """
    version, parameters, state = line.parameters("VV"), line.parameters("PP"), line.parameters("II")
    return ScannerInfo(
        product=version.get("PROD", parameters.get("MODL", "unknown")),
        serial=version.get("SERI", "unknown"),
        firmware=version.get("FIRM", "unknown"),
        protocol=version.get("PROT", "unknown"),
        steps=_steps(line.name, parameters),
        status=state.get("STAT", "unknown"),
        line_speed=state.get("SBPS", ""),
    )


def _steps(name: str, parameters: dict[str, str]) -> ScanSteps:
    try:
        value = {key: int(parameters[key]) for key in ("ARES", "AMIN", "AMAX", "AFRT", "SCAN", "DMIN", "DMAX")}
    except (KeyError, ValueError) as error:
        raise DeviceError(f"{name}: the scanner's parameters lack a number: {error}") from error
    is_sane = (
        0 < value["ARES"] <= 65536
        and 0 <= value["AMIN"] < value["AMAX"] < value["ARES"]
        and 0 < value["SCAN"] <= 60000
        and 0 < value["DMIN"] < value["DMAX"]
    )
    if not is_sane:
        raise DeviceError(f"{name}: the scanner's parameters make no sense: {value}")
    return ScanSteps(
        front_step=value["AFRT"],
        steps_per_turn=value["ARES"],
        first_step=value["AMIN"],
        last_step=value["AMAX"],
        range_min_m=value["DMIN"] / 1e3,
        range_max_m=value["DMAX"] / 1e3,
        turn_s=60 / value["SCAN"],
    )
