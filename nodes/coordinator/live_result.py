"""What a calibration in the middle of a session tells; small enough to travel between processes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LiveResult:
    """Of one try.

    Attributes:
        not_yet: why there is no calibration yet; empty where there is one.
        advice: what to do about that.
        n_instants: that two cameras or more saw.
        n_used: of them, solved for.
        sigma: predicted standard deviation of the worst camera's centre when all instants are used; `unit`.
        worst: the camera that it is of.
        unit: "m", or "unit" where nothing tells metres.
        emptiest: where in the room the fewest spots were, in words; empty where nobody can tell.
        seconds: that the try took.
    """

    not_yet: str = ""
    advice: str = ""
    n_instants: int = 0
    n_used: int = 0
    sigma: float = float("nan")
    worst: str = ""
    unit: str = "m"
    emptiest: str = ""
    seconds: float = 0.0
