"""The model of room.toml: what may stand where. Checked as a whole, so that all faults are told at once."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, PositiveInt, model_validator

from network_calib.cameras import LensModel


def _twice(value: object) -> object:
    """One number stands for x and y."""
    return [value, value] if isinstance(value, int | float) and not isinstance(value, bool) else value


Positive = Annotated[FiniteFloat, Field(gt=0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
Name = Annotated[str, Field(min_length=1)]
Xyz = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Pair = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
PositivePair = Annotated[list[Positive], Field(min_length=2, max_length=2), BeforeValidator(_twice)]
Side = Annotated[PositiveInt, Field(le=100_000)]
LensName = Literal["none", "k1", "k1_k2", "k1_k2_p1_p2", "fisheye"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class SigmaConfig(_Strict):
    """Standard deviations of given intrinsics, px; distortion without unit."""

    focal: Positive
    centre: Positive
    distortion: Positive | None = None


class CameraConfig(_Strict):
    """One [[cameras]] entry. What is left out is taken from the recording.

    Attributes:
        name: as in the recording.
        size: width, height, px.
        lens: lens model.
        intrinsics: how far what is given (here or by the recording) is trusted.
        focal: focal length in px, one number or x and y.
        centre: principal point, px; the image centre when left out.
        distortion: as many terms as the lens model has.
        sigma: how well the given numbers are known.
        group: cameras of one group share their intrinsics.
    """

    name: Name
    size: Annotated[list[Side], Field(min_length=2, max_length=2)] | None = None
    lens: LensName | None = None
    intrinsics: Literal["unknown", "initial", "fixed"] | None = None
    focal: PositivePair | None = None
    centre: Pair | None = None
    distortion: Annotated[list[FiniteFloat], Field(max_length=4)] | None = None
    sigma: SigmaConfig | None = None
    group: Name | None = None

    @model_validator(mode="after")
    def _check(self) -> CameraConfig:
        given = [name for name in ("centre", "distortion") if getattr(self, name) is not None]
        if given and self.focal is None:
            raise ValueError(f"{', '.join(given)} given without focal")
        if self.focal is not None and self.intrinsics in (None, "unknown"):
            raise ValueError('focal is given, so intrinsics must be "initial" or "fixed"')
        n_terms = LensModel(self.lens or "k1_k2_p1_p2").n_distortion
        if self.distortion is not None and len(self.distortion) != n_terms:
            model = self.lens or "k1_k2_p1_p2 (the default)"
            raise ValueError(f"distortion has {len(self.distortion)} terms, but lens {model} has {n_terms}")
        if self.focal is not None and self.intrinsics == "fixed" and (self.centre is None or self.distortion is None):
            raise ValueError("fixed intrinsics need focal, centre and distortion")
        if self.sigma is not None and self.intrinsics != "initial":
            raise ValueError('sigma is given, so intrinsics must be "initial"')
        if self.sigma is not None and self.sigma.distortion is None and n_terms:
            raise ValueError("sigma needs distortion, because the lens has distortion terms")
        return self


class StereoAnchor(_Strict):
    """The stereo pair and its baseline."""

    kind: Literal["stereo"]
    cameras: Annotated[list[Name], Field(min_length=2, max_length=2)]
    baseline_m: Positive
    sigma_m: Annotated[FiniteFloat, Field(ge=0)] = 0.0


class DistanceAnchor(_Strict):
    """A measured distance between two camera centres."""

    kind: Literal["distance"]
    cameras: Annotated[list[Name], Field(min_length=2, max_length=2)]
    distance_m: Positive
    sigma_m: Annotated[FiniteFloat, Field(ge=0)] = 0.0


class CentresAnchor(_Strict):
    """Measured camera centres; left out, those of the recording."""

    kind: Literal["centres"]
    centres: Annotated[dict[Name, Xyz], Field(min_length=3)] | None = None


class PointConfig(_Strict):
    """A spot that rested on a known place in one frame."""

    frame: Annotated[int, Field(ge=0)]
    xyz: Xyz


class PointsAnchor(_Strict):
    """Spots at known places."""

    kind: Literal["points"]
    points: Annotated[list[PointConfig], Field(min_length=3)]


class NoAnchor(_Strict):
    """No metric information: the first two cameras are one unit apart."""

    kind: Literal["none"]


AnchorConfig = Annotated[
    StereoAnchor | DistanceAnchor | CentresAnchor | PointsAnchor | NoAnchor, Field(discriminator="kind")
]


class OptionsConfig(_Strict):
    """How to solve; see `network_calib.room_setup.Options`."""

    start: Literal["auto", "factorisation", "anchor"] | None = None
    rejection: Annotated[FiniteFloat, Field(ge=1)] | None = None
    holdout_share: Annotated[FiniteFloat, Field(ge=0, le=0.5)] | None = None
    n_repeats: Annotated[int, Field(ge=1, le=100)] | None = None


class WorldConfig(_Strict):
    """The world frame.

    Attributes:
        floor_frames: frames in which the spot rested on the floor; the world is levelled by them.
    """

    floor_frames: list[Annotated[int, Field(ge=0)]] = []


class TimingConfig(_Strict):
    """Grouping of a table without frame numbers.

    Attributes:
        tolerance_ms: largest gap between neighbouring stamps of one instant.
    """

    tolerance_ms: Positive | None = None


class InstrumentConfig(_Strict):
    """What an LRF may be wrong by, as standard deviations; 0 holds a number at its nominal value.

    Attributes:
        tilt_gain: angle turned over angle reported, relative.
        range_bias_m: of every range.
        range_scale: relative; a baseline must tell metres, or the ranges say nothing of it.
        bearing_zero_deg: of the scan's front.
        clock_offset_ms: of the scanner's stamps against those of the cameras.
    """

    tilt_gain: NotNegative = 0.0
    range_bias_m: NotNegative = 0.0
    range_scale: NotNegative = 0.0
    bearing_zero_deg: NotNegative = 0.0
    clock_offset_ms: NotNegative = 0.0


class LrfConfig(_Strict):
    """One [[lrfs]] entry.

    Attributes:
        name: as in lrf.csv.
        sigma: what the instrument may be wrong by; nothing when left out.
    """

    name: Name
    sigma: InstrumentConfig = InstrumentConfig()


class RoomConfig(_Strict):
    """room.toml."""

    cameras: list[CameraConfig] = []
    lrfs: list[LrfConfig] = []
    anchor: AnchorConfig = NoAnchor(kind="none")
    options: OptionsConfig = OptionsConfig()
    world: WorldConfig = WorldConfig()
    timing: TimingConfig = TimingConfig()

    @property
    def tolerance_ns(self) -> int | None:
        """Grouping tolerance, ns; None for the default."""
        return None if self.timing.tolerance_ms is None else max(round(self.timing.tolerance_ms * 1e6), 1)

    @model_validator(mode="after")
    def _check(self) -> RoomConfig:
        names = [camera.name for camera in self.cameras]
        lrf_names = [lrf.name for lrf in self.lrfs]
        for kind, given in (("camera names", names), ("names of LRFs", lrf_names)):
            twice = sorted({name for name in given if given.count(name) > 1})
            if twice:
                raise ValueError(f"{kind} given twice: {', '.join(twice)}")
        if isinstance(self.anchor, StereoAnchor | DistanceAnchor) and self.anchor.cameras[0] == self.anchor.cameras[1]:
            raise ValueError(f"anchor.cameras names {self.anchor.cameras[0]!r} twice, expected two cameras")
        return self
