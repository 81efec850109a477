"""What a session holds of laser range finders, beside the spots of the cameras."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lrf_stereo.lrf_priors import Instruments, InstrumentSigma
from lrf_stereo.samples import LrfSpots, TiltSettings
from network_calib.errors import InputError


@dataclass(frozen=True, slots=True)
class LrfSession:
    """The LRFs of a session with all that they saw.

    Attributes:
        names: S names, in the order of the scanner indices.
        spots: sightings of the spot; frames are those of the cameras.
        settings: tilt settings of all scanners.
        instrument: what the scanners may be wrong by, one for all or one for each; nothing by default.
    """

    names: tuple[str, ...]
    spots: LrfSpots
    settings: TiltSettings
    instrument: Instruments = field(default_factory=InstrumentSigma)

    def __post_init__(self) -> None:
        if not self.names or len(set(self.names)) != len(self.names):
            raise InputError(f"LRF names {list(self.names)}, expected one or more, each once")
        if set(self.settings.scanner.tolist()) != set(range(len(self.names))):
            raise InputError(f"{len(self.names)} LRFs need tilt settings each, got {self.settings.scanner.tolist()}")
        n_settings = len(self.settings.angle_rad)
        setting = self.spots.setting
        if len(setting) and not 0 <= setting.min() <= setting.max() < n_settings:
            raise InputError(f"LRF sightings at tilt settings {setting.min()}..{setting.max()} of {n_settings}")
        # The joint solve counts on it.
        pairs, count = np.unique(np.stack([self.spots.frame, setting]), axis=1, return_counts=True)
        if (count > 1).any():
            frame, twice = pairs[:, int(np.flatnonzero(count > 1)[0])].tolist()
            name = self.names[int(self.settings.scanner[twice])]
            raise InputError(
                f"LRF {name!r} has two sightings in frame {frame} at one tilt setting, expected at most one",
                advice="Keep the likeliest candidate of each crossing.",
            )
