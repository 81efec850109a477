"""The models of site.toml, camera.toml and lrf.toml: what may stand where. Angles in degrees, as people write them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt, model_validator

from nodes.bus.keys import NAME
from nodes.config_model import Positive, RoomConfig, Side
from nodes.site.passwords import refuse_plain

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"


def _named(text: str) -> str:
    if NAME.fullmatch(text) is None:
        raise ValueError(
            f"{text!r} cannot be a name here; use letters, digits, '_', '-' and '.', beginning with a letter or digit, "
            "64 at most"
        )
    return text


def _endpoint(text: str) -> str:
    protocol, slash, address = text.partition("/")
    if not (protocol and slash and ":" in address):
        raise ValueError(f"{text!r} is no address of a router; expected such as {DEFAULT_ROUTER}")
    return text


BusName = Annotated[str, AfterValidator(_named)]
Endpoint = Annotated[str, AfterValidator(_endpoint)]
Text = Annotated[str, Field(min_length=1)]
TiltDeg = Annotated[FiniteFloat, Field(ge=-90, le=90)]
TiltsDeg = Annotated[list[TiltDeg], Field(min_length=1, max_length=100)]
NCrossings = Annotated[int, Field(ge=1, le=1000)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class TlsConfig(_Strict):
    """Certificates on the bus, PEM files; needed where the bus leaves one machine.

    Attributes:
        ca: of the site.
        certificate: of this program.
        key: of the certificate; the file, never the key itself.
    """

    ca: Text
    certificate: Text
    key: Text


class NodeEntry(_Strict):
    """One [[nodes]] entry of a site: a node that is expected to be there.

    Attributes:
        name: as in the node's own configuration.
        role: what it is.
    """

    name: BusName
    role: Literal["camera", "lrf"] = "camera"


class SessionConfig(_Strict):
    """How a session goes.

    Attributes:
        background_s: the empty room, at the beginning.
        target_sigma_mm: waving is enough when the centre of every camera is known to this, as predicted.
        min_waving_s: but not before.
        max_waving_s: and in any case then.
        tilts_deg: of every LRF, one after the other.
        crossings: of the scan plane at every tilt.
    """

    background_s: Positive = 4.0
    target_sigma_mm: Positive = 2.0
    min_waving_s: Annotated[FiniteFloat, Field(ge=0)] = 20.0
    max_waving_s: Positive = 600.0
    tilts_deg: TiltsDeg = [2.0, 12.0, 23.0]
    crossings: NCrossings = 12

    @model_validator(mode="after")
    def _check(self) -> SessionConfig:
        if self.min_waving_s > self.max_waving_s:
            raise ValueError(f"min_waving_s = {self.min_waving_s:g} is above max_waving_s = {self.max_waving_s:g}")
        return self


class SiteConfig(RoomConfig):
    """site.toml: everything of a room.toml, and what the coordinator needs.

    Attributes:
        name: of the site, first part of all keys.
        router: addresses of its routers; the first that answers is taken.
        tls: None where the bus stays on one machine.
        data: folder of the sessions; relative to site.toml in the file, and as it is here after `load_site`.
        nodes: that are expected.
        session: how a session goes.
    """

    name: BusName
    router: list[Endpoint] = Field(default=[DEFAULT_ROUTER], min_length=1)
    tls: TlsConfig | None = None
    data: Text = "sessions"
    nodes: list[NodeEntry] = Field(default=[])
    session: SessionConfig = SessionConfig()

    @model_validator(mode="after")
    def _check_nodes(self) -> SiteConfig:
        _refuse_twice("names of nodes", [node.name for node in self.nodes])
        return self


class NodeConfig(_Strict):
    """What every node's configuration holds.

    Attributes:
        node: its name; no other of the site has it.
        site: name of the site.
        router: addresses of the site's routers; the first that answers is taken.
        tls: None where the bus stays on one machine.
        journal: file of what the node observed; relative to the configuration in the file.
    """

    node: BusName
    site: BusName
    router: list[Endpoint] = Field(default=[DEFAULT_ROUTER], min_length=1)
    tls: TlsConfig | None = None
    journal: Text


class CameraSourceConfig(_Strict):
    """One [[cameras]] entry of a camera node.

    Attributes:
        name: of the camera, as in site.toml.
        source: what is opened; see `nodes.devices.cameras.open_source`. A password is referred to, not written.
        channel: the light of the pointer.
        mask: image that is black where no spot may be.
        n_learning: frames of the empty room from which the background is learnt.
        max_candidates: spots kept of each frame.
        exposure_ms: exposure time, where the camera does not tell it: only for the advice on smear.
        size: V4L2: width, height to ask for.
        rate_hz: V4L2: frames a second to ask for.
    """

    name: BusName
    source: Annotated[Text, AfterValidator(refuse_plain)]
    channel: Literal["auto", "red", "green", "blue", "luma"] = "auto"
    mask: Text | None = None
    n_learning: Annotated[PositiveInt, Field(ge=12, le=10_000)] = 50
    max_candidates: Annotated[int, Field(ge=1, le=50)] = 4
    exposure_ms: Positive | None = None
    size: Annotated[list[Side], Field(min_length=2, max_length=2)] | None = None
    rate_hz: Positive | None = None


class CameraNodeConfig(NodeConfig):
    """camera.toml: a node with one or several cameras.

    Attributes:
        batch_ms: frames of so long travel together.
        cameras: its cameras.
    """

    batch_ms: Annotated[FiniteFloat, Field(ge=20, le=1000)] = 80.0
    cameras: Annotated[list[CameraSourceConfig], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self) -> CameraNodeConfig:
        _refuse_twice("names of cameras", [camera.name for camera in self.cameras])
        return self


class LrfDeviceConfig(_Strict):
    """The [lrf] table of an LRF node.

    Attributes:
        name: of the LRF, as in site.toml.
        scanner: serial port such as /dev/ttyACM0, or tcp://host:port.
        tilt_unit: likewise; None where somebody tilts the LRF by hand.
        imu: likewise; None: there is none.
        axis: the tilt axis in the IMU's axes.
        tilt_sign: of the tilt unit: -1 where positions grow upwards, 1 where it hangs upside down.
        zero_steps: position of the tilt unit that is called tilt zero.
        tilts_deg: where the command names none.
        crossings: at every tilt, where the command does not say.
        max_crossings: at every tilt: enough, whatever the accuracy.
        plane_sigma_mm: so many crossings more that the scan plane is known to this.
        rest_s: at rest before the empty room is learnt.
        n_background: scans of the empty room.
        ball_mm: diameter of the spot.
    """

    name: BusName
    scanner: Text
    tilt_unit: Text | None = None
    imu: Text | None = None
    axis: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] = [0.0, 1.0, 0.0]
    tilt_sign: Literal[-1, 1] = -1
    zero_steps: int = 0
    tilts_deg: TiltsDeg = [2.0, 12.0, 23.0]
    crossings: NCrossings = 12
    max_crossings: NCrossings = 60
    plane_sigma_mm: Positive = 4.0
    rest_s: Annotated[FiniteFloat, Field(ge=0, le=60)] = 3.0
    n_background: Annotated[int, Field(ge=2, le=10_000)] = 20
    ball_mm: Annotated[FiniteFloat, Field(ge=5, le=200)] = 40.0

    @model_validator(mode="after")
    def _check(self) -> LrfDeviceConfig:
        if self.tilt_unit is None and self.imu is None:
            raise ValueError("neither tilt_unit nor imu is given: nothing would tell the tilt angles")
        length = sum(value**2 for value in self.axis) ** 0.5
        if abs(length - 1) > 0.01:
            raise ValueError(f"axis has length {length:.3g}, expected 1")
        if self.crossings > self.max_crossings:
            raise ValueError(f"crossings = {self.crossings} is above max_crossings = {self.max_crossings}")
        return self


class LrfNodeConfig(NodeConfig):
    """lrf.toml: a node with one LRF."""

    lrf: LrfDeviceConfig


def _refuse_twice(what: str, names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{what} given twice: {', '.join(twice)}")
