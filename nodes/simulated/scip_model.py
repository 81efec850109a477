"""What emulated scanners say of themselves: the replies of a recorded URG-04LX, and of a newer network model."""

from __future__ import annotations

from dataclasses import dataclass

from lrf_stereo.scanner import ScanSteps


@dataclass(frozen=True, slots=True)
class ScipModel:
    """One model.

    Attributes:
        version: lines of VV.
        name: of PP.
        steps: its steps.
        wakes_in_scip1: answers SCIP 1 until it is told `SCIP2.0`.
        has_intensity: knows ME and GE, and with several echoes a beam ND, NE, HD and HE.
        reply_tick_s: commands are answered at multiples of this; the scan tick on the URG-04LX.
        clock_gain: sensor seconds per second.
        bytes_per_s: of its line.
        speeds: of its RS-232 side, in baud, that SS takes; the first is the one it wakes up with. None: it has no such
            side.
    """

    version: tuple[str, ...]
    name: str
    steps: ScanSteps
    wakes_in_scip1: bool
    has_intensity: bool
    reply_tick_s: float
    clock_gain: float
    bytes_per_s: float
    speeds: tuple[int, ...]

    def parameters(self) -> tuple[str, ...]:
        """Lines of PP."""
        steps = self.steps
        return (
            f"MODL:{self.name}",
            f"DMIN:{round(1e3 * steps.range_min_m)}",
            f"DMAX:{round(1e3 * steps.range_max_m)}",
            f"ARES:{steps.steps_per_turn}",
            f"AMIN:{steps.first_step}",
            f"AMAX:{steps.last_step}",
            f"AFRT:{steps.front_step}",
            f"SCAN:{round(60 / steps.turn_s)}",
        )


URG_04LX = ScipModel(
    version=(
        "VEND:Hokuyo Automatic Co.,Ltd.",
        "PROD:SOKUIKI Sensor URG-04LX",
        "FIRM:3.1.04(02/Aug./2007)",
        "PROT:SCIP 2.0",
        "SERI:H0706400",
    ),
    name="URG-04LX(Hokuyo Automatic Co.,Ltd.)",
    steps=ScanSteps(),
    wakes_in_scip1=True,
    has_intensity=False,
    reply_tick_s=0.1,
    clock_gain=1 + 1300e-6,
    bytes_per_s=1e6,
    speeds=(19200, 57600, 115200, 250000, 500000, 750000),
)
UST_10LX = ScipModel(
    version=(
        "VEND:Hokuyo Automatic Co.,Ltd.",
        "PROD:UST-10LX",
        "FIRM:CE0001A11(2014-Nov)",
        "PROT:SCIP 2.2",
        "SERI:H1450000",
    ),
    name="UST-10LX",
    steps=ScanSteps(
        front_step=540,
        steps_per_turn=1440,
        first_step=0,
        last_step=1080,
        range_min_m=0.02,
        range_max_m=30.0,
        turn_s=0.025,
    ),
    wakes_in_scip1=False,
    has_intensity=True,
    reply_tick_s=0.005,
    clock_gain=1 + 50e-6,
    bytes_per_s=1e7,
    speeds=(),
)
