"""Key expressions: built and parsed here, and nowhere else.

    B = spotcal/@v1/<site>
    B/node/<node>/obs/<kind>          observations, journalled
    B/node/<node>/@replay/rows        queryable: rows of the journal
    B/node/<node>/@replay/summary     queryable: what the journal holds of a session
    B/node/<node>/status              each second
    B/live/node/<node>/<role>         liveliness token: data flows
    B/cmd/<node>/<verb>               queryable: commands
    B/session/state                   of the coordinator
    B/result/calibration              newest calibration
    B/svc/result/calibration          queryable: the same, for those who came late
    B/svc/project, locate, bearings   queryables: projection service
    B/proj/<camera>                   every scan in a camera; below it /foxglove, the same for viewers

`**` matches no part that begins with `@`: versions and journals stay out of everybody's subscriptions.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

from network_calib.errors import InputError

PREFIX = "spotcal/@v1"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


class Kind(StrEnum):
    """What an observation key carries; each is journalled."""

    SPOTS = "spots"
    LRF_INFO = "lrf_info"
    LRF_SCAN = "lrf_scan"
    LRF_SPOT = "lrf_spot"
    TILT = "tilt"
    TILTS = "tilts"
    IMU = "imu"
    EVENT = "event"


class Verb(StrEnum):
    """What a node may be told."""

    START = "start"
    STOP = "stop"
    RELEARN = "relearn"
    SNAPSHOT = "snapshot"
    EXPOSURE = "exposure"
    TILTS = "tilts"
    NEXT = "next"


class Role(StrEnum):
    """What a node is."""

    CAMERA = "camera"
    LRF = "lrf"


@dataclass(frozen=True, slots=True)
class ObservationKey:
    """A parsed `B/node/<node>/obs/<kind>`."""

    site: str
    node: str
    kind: Kind


@dataclass(frozen=True, slots=True)
class LiveKey:
    """A parsed `B/live/node/<node>/<role>`."""

    site: str
    node: str
    role: Role


def check_name(name: str, *, of: str) -> str:
    """The name, when it may stand in a key.

    Raises:
        InputError: it may not.
    """
    if NAME.fullmatch(name) is None:
        raise InputError(
            f"{of} {name!r} cannot stand in a key",
            advice="Use letters, digits, '_', '-' and '.', beginning with a letter or digit, 64 at most.",
        )
    return name


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one site.

    Raises:
        InputError: a site or node name that cannot stand in a key.
    """

    site: str

    def __post_init__(self) -> None:
        check_name(self.site, of="site")

    @property
    def base(self) -> str:
        return f"{PREFIX}/{self.site}"

    def observation(self, node: str, kind: Kind) -> str:
        return f"{self.base}/node/{check_name(node, of='node')}/obs/{kind}"

    @property
    def all_observations(self) -> str:
        return f"{self.base}/node/*/obs/*"

    def observations_of(self, kind: Kind) -> str:
        return f"{self.base}/node/*/obs/{kind}"

    def replay_rows(self, node: str) -> str:
        return f"{self.base}/node/{check_name(node, of='node')}/@replay/rows"

    def replay_summary(self, node: str) -> str:
        return f"{self.base}/node/{check_name(node, of='node')}/@replay/summary"

    @property
    def all_summaries(self) -> str:
        return f"{self.base}/node/*/@replay/summary"

    def status(self, node: str) -> str:
        return f"{self.base}/node/{check_name(node, of='node')}/status"

    @property
    def all_status(self) -> str:
        return f"{self.base}/node/*/status"

    def live(self, node: str, role: Role) -> str:
        return f"{self.base}/live/node/{check_name(node, of='node')}/{role}"

    @property
    def all_live(self) -> str:
        return f"{self.base}/live/node/*/*"

    def command(self, node: str, verb: Verb) -> str:
        return f"{self.base}/cmd/{check_name(node, of='node')}/{verb}"

    def all_commands(self, node: str) -> str:
        return f"{self.base}/cmd/{check_name(node, of='node')}/*"

    @property
    def session_state(self) -> str:
        return f"{self.base}/session/state"

    @property
    def calibration(self) -> str:
        return f"{self.base}/result/calibration"

    @property
    def calibration_service(self) -> str:
        return f"{self.base}/svc/result/calibration"

    @property
    def project_service(self) -> str:
        return f"{self.base}/svc/project"

    @property
    def locate_service(self) -> str:
        return f"{self.base}/svc/locate"

    @property
    def bearings_service(self) -> str:
        return f"{self.base}/svc/bearings"

    def projection(self, camera: str) -> str:
        return f"{self.base}/proj/{check_name(camera, of='camera')}"

    def projection_annotations(self, camera: str) -> str:
        return f"{self.projection(camera)}/foxglove"


def parse_observation(key: str) -> ObservationKey | None:
    """The parts of an observation's key; None for any other key."""
    match key.split("/"):
        case ["spotcal", "@v1", site, "node", node, "obs", kind] if _are_names(site, node) and kind in tuple(Kind):
            return ObservationKey(site, node, Kind(kind))
    return None


def parse_status(key: str) -> str | None:
    """The node of a status key; None for any other key."""
    match key.split("/"):
        case ["spotcal", "@v1", site, "node", node, "status"] if _are_names(site, node):
            return node
    return None


def parse_live(key: str) -> LiveKey | None:
    """The parts of a liveliness token; None for any other key."""
    match key.split("/"):
        case ["spotcal", "@v1", site, "live", "node", node, role] if _are_names(site, node) and role in tuple(Role):
            return LiveKey(site, node, Role(role))
    return None


def parse_verb(key: str) -> Verb | None:
    """What a command's key asks for; None for any other key."""
    match key.split("/"):
        case ["spotcal", "@v1", _, "cmd", _, verb] if verb in tuple(Verb):
            return Verb(verb)
    return None


def _are_names(*names: str) -> bool:
    return all(NAME.fullmatch(name) is not None for name in names)
