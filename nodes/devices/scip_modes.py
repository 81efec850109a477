"""What can be asked of a scan: distances in two lengths, the strength of echoes, several echoes a beam."""

from __future__ import annotations

from enum import Enum

from lrf_stereo.scanner import ScanSteps

LONGEST_SHORT_M = 4.095


class ScanMode(Enum):
    """What every beam of a scan tells. Of several echoes the driver takes the first.

    The values are the commands for a stream and for one scan.
    """

    DISTANCES = ("MD", "GD")
    # Two characters a beam instead of three: a third less on a slow line, and nothing beyond 4.095 m.
    SHORT_DISTANCES = ("MS", "GS")
    INTENSITY = ("ME", "GE")
    ECHOES = ("ND", "HD")
    ECHOES_INTENSITY = ("NE", "HE")

    @property
    def n_characters(self) -> int:
        """Of each number."""
        return 2 if self is ScanMode.SHORT_DISTANCES else 3

    @property
    def has_intensity(self) -> bool:
        """Whether the strength of the echo follows every distance."""
        return self in (ScanMode.INTENSITY, ScanMode.ECHOES_INTENSITY)

    def stream_request(self, steps: ScanSteps) -> str:
        """Every step, every scan, until it is stopped."""
        return f"{self.value[0]}{steps.first_step:04d}{steps.last_step:04d}00000"

    def single_request(self, steps: ScanSteps) -> str:
        """Every step of the latest scan."""
        return f"{self.value[1]}{steps.first_step:04d}{steps.last_step:04d}00"
