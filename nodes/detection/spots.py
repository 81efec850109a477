"""What the detector is asked and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


class Channel(StrEnum):
    """Which light is looked at. AUTO takes the channel in which the spot stands out most, once it has been seen."""

    AUTO = "auto"
    RED = "red"
    GREEN = "green"
    BLUE = "blue"
    LUMA = "luma"


@dataclass(frozen=True, slots=True)
class DetectorOptions:
    """How the detector works.

    Attributes:
        channel: the light of the pointer; an infrared pointer before a monochrome camera: luma.
        channel_weights: blue, green, red weights instead of a named channel; they sum to 1.
        mask: (h, w) True where spots may be; None: everywhere.
        n_learning_frames: frames of the empty scene before the first detection; 0 when `background` was learnt before.
        max_candidates: at most so many spots a frame, best first.
        max_radius_px: a spot's bright core is not larger; larger changes are people, doors and lights.
        exposure_s: exposure time where the frames do not tell it; only for the advice on smear.
    """

    channel: Channel = Channel.AUTO
    channel_weights: tuple[float, float, float] | None = None
    mask: BoolArray | None = None
    n_learning_frames: int = 50
    max_candidates: int = 4
    max_radius_px: float = 24.0
    exposure_s: float | None = None


@dataclass(frozen=True, slots=True)
class Spot:
    """One candidate for the spot in one frame.

    Attributes:
        px: (2,) position x, y; the centre of the top-left pixel is (0, 0). Of a smeared spot: the middle of the smear,
            which is where the spot was at mid-exposure.
        covariance_px2: (2, 2) of `px`: noise of the pixels through the fit; wider along a smear.
        score: 0..1, how like the pointer's spot this is; candidates of one frame are ordered by it.
        peak: fitted height over the background, in units of the full scale of the sensor; above 1 when saturated.
        width_px: fitted standard deviation of the profile across the smear.
        smear_px: length of the smear; 0 where the spot stood still as far as can be told.
        is_saturated: samples at full scale lie in the spot; they were not trusted as brightness.
    """

    px: FloatArray
    covariance_px2: FloatArray
    score: float
    peak: float
    width_px: float
    smear_px: float
    is_saturated: bool

    @property
    def sigma_px(self) -> float:
        """One standard deviation per axis that stands for the covariance: the root of its mean variance."""
        return float(np.sqrt(np.trace(self.covariance_px2) / 2))


class DetectorState(StrEnum):
    """What the detector was doing in a frame."""

    LEARNING = "learning"  # the background is not known yet
    WATCHING = "watching"
    RELEARNING = "relearning"  # the light changed: the background is being learnt anew


@dataclass(frozen=True, slots=True)
class Detections:
    """What one frame held.

    Attributes:
        sequence: of the frame.
        stamp_ns: of the frame.
        state: spots are found only while WATCHING.
        spots: best first; empty when there is none.
    """

    sequence: int
    stamp_ns: int
    state: DetectorState
    spots: tuple[Spot, ...] = field(default_factory=tuple)


class AdviceKind(StrEnum):
    """What may be better about the picture."""

    SATURATED = "saturated"
    TOO_DIM = "too_dim"
    BACKGROUND_TOO_BRIGHT = "background_too_bright"
    SMEARED = "smeared"
    UNSTEADY_LIGHT = "unsteady_light"
    NOTHING_SEEN = "nothing_seen"


@dataclass(frozen=True, slots=True)
class Advice:
    """One thing to change, in words for the person at the camera.

    Attributes:
        kind: for programs.
        message: what was seen, with its number, and what to do: "the spot is saturated in 83 % of frames: lower the
            exposure to about a third".
    """

    kind: AdviceKind
    message: str
