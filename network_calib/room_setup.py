"""What the user knows before the calibration: each camera, the anchor of the metric scale, the world frame, options."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from network_calib.cameras import LensModel
from network_calib.observations import FloatArray


class Knowledge(StrEnum):
    """How far given intrinsics are trusted."""

    UNKNOWN = "unknown"
    INITIAL = "initial"
    FIXED = "fixed"


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """One camera as known beforehand.

    Attributes:
        name: unique name.
        size_px: image width, height.
        lens: lens model to estimate, or of the given intrinsics.
        knowledge: whether `intrinsics` are absent, a prior, or held fixed.
        intrinsics: the eight numbers of `network_calib.cameras`, or None when unknown.
        intrinsics_sigma: standard deviations of a prior; None takes the defaults of `priors.py`.
        group: cameras with the same group name share one set of intrinsics.
    """

    name: str
    size_px: tuple[int, int]
    lens: LensModel = LensModel.K1_K2_P1_P2
    knowledge: Knowledge = Knowledge.UNKNOWN
    intrinsics: FloatArray | None = None
    intrinsics_sigma: FloatArray | None = None
    group: str | None = None

    def nominal_intrinsics(self) -> FloatArray:
        """(8,) the given intrinsics, or a nominal camera: focal length = longer side, centre of the image."""
        if self.intrinsics is not None:
            return np.asarray(self.intrinsics, dtype=np.float64)
        width, height = self.size_px
        focal = float(max(width, height))
        return np.array([focal, focal, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class UnitScale:
    """No metric information: the distance between the first two cameras is one unit."""


@dataclass(frozen=True, slots=True)
class KnownDistance:
    """A measured distance between two camera centres: the stereo baseline, or a tape measure.

    Attributes:
        camera_a: name.
        camera_b: name.
        distance_m: between the two projection centres.
        sigma_m: standard deviation of the measurement.
        is_stereo_pair: the two form the stereo pair from which the network may be grown.
    """

    camera_a: str
    camera_b: str
    distance_m: float
    sigma_m: float = 0.0
    is_stereo_pair: bool = False


@dataclass(frozen=True, slots=True)
class KnownCentres:
    """Measured camera centres: they fix scale and world frame (a similarity, nothing is bent to fit).

    Attributes:
        names: n >= 3 camera names.
        centres_in_world_m: (n, 3).
    """

    names: tuple[str, ...]
    centres_in_world_m: FloatArray


@dataclass(frozen=True, slots=True)
class KnownPoints:
    """Spot positions of known coordinates, by frame: they fix scale and world frame.

    Attributes:
        frames: n >= 3 frame numbers in which the spot rested on a known point.
        points_in_world_m: (n, 3).
    """

    frames: tuple[int, ...]
    points_in_world_m: FloatArray


Anchor = UnitScale | KnownDistance | KnownCentres | KnownPoints


@dataclass(frozen=True, slots=True)
class Options:
    """How to solve.

    Attributes:
        start: "auto", "factorisation" or "anchor".
        rejection: an observation whose normalised residual (2 dof) exceeds this many sigma is an outlier.
        holdout_share: share of the frames, in contiguous segments, kept out of one extra fit to test it.
        n_repeats: how many seeds the repeat spread is taken over (1 = no repeat).
        floor_frames: frames in which the spot rested on the floor; when given the world is levelled: z up, z = 0 on
            the floor, origin below the first camera.
    """

    start: str = "auto"
    rejection: float = 4.0
    holdout_share: float = 0.2
    n_repeats: int = 3
    floor_frames: tuple[int, ...] = field(default=())
