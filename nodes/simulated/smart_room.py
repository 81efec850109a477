"""The simulated smart room as separate processes see it: its folder, and a camera in it as a frame source.

`FOLDER/world.json` says what room it is and when its time began, `FOLDER/events.jsonl` what has happened since (see
`smart_room_events`). A camera is opened by `simulated:FOLDER#C0`, at the pace of a live one, or by
`simulated:FOLDER#C0?every`: then no frame is left out, though late, so that another run sees the very same frames.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import parse_qsl

from network_calib.errors import InputError
from nodes.frames import FrameSource, PixelFormat
from nodes.simulated.rendering.rendered_camera import FrameClock, RenderedCamera
from nodes.simulated.rendering.room_scene import RoomScene
from nodes.simulated.rendering.sensor import SensorModel
from nodes.simulated.rendering.spot_image import Ball
from nodes.simulated.smart_room_events import EventFile
from nodes.simulated.smart_room_geometry import SmartRoom
from nodes.simulated.smart_room_person import SmartRoomPerson
from nodes.simulated.smart_room_source import SmartRoomSource

PREFIX, WORLD_FILE = "simulated:", "world.json"
DEFAULT_RATE_HZ = 20.0
EXPOSURE_S = 0.004
# A ball of 4 cm, bright enough for a short exposure, in a room that is lit evenly.
SCENE = RoomScene(ball=Ball(diameter_m=0.04, radiance=1.6, limb_exponent=0.5), light=1.2)
SENSOR = SensorModel(pixel_format=PixelFormat.BGR, exposure_s=EXPOSURE_S)


@dataclass(frozen=True, slots=True)
class World:
    """What all processes agree on.

    Attributes:
        seed: of the room and all noise.
        start_s: when its time began, seconds of the Unix epoch; frame k of every camera is exposed k / rate_hz later.
        rate_hz: frames a second.
    """

    seed: int
    start_s: float
    rate_hz: float = DEFAULT_RATE_HZ


def write_world(folder: Path, world: World) -> None:
    """Make a new world: its folder holds no events yet.

    Raises:
        InputError: a rate that is not positive.
    """
    if not world.rate_hz > 0:
        raise InputError(f"rate_hz is {world.rate_hz}, expected more than 0")
    folder.mkdir(parents=True, exist_ok=True)
    EventFile(folder).path.unlink(missing_ok=True)
    (folder / WORLD_FILE).write_text(json.dumps(asdict(world)) + "\n", encoding="utf-8")


def read_world(folder: Path) -> World:
    """Read `world.json`.

    Raises:
        InputError: it is missing, or holds something else.
    """
    path = folder / WORLD_FILE
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
        return World(int(fields["seed"]), float(fields["start_s"]), float(fields["rate_hz"]))
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror}", advice="`spotcal demo` makes such a folder."
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} describes no smart room: {error!r}") from None


def person_of(folder: Path, world: World) -> SmartRoomPerson:
    """The person of a folder's world."""
    return SmartRoomPerson(SmartRoom.of(world.seed), EventFile(folder), start_s=world.start_s, rate_hz=world.rate_hz)


def rendered_camera(person: SmartRoomPerson, name: str, world: World) -> RenderedCamera:
    """A camera of the room, whose frame 0 is exposed at the world's start.

    Raises:
        InputError: the room has no such camera.
    """
    cameras = SmartRoom.of(world.seed).cameras
    if name not in cameras.names:
        raise InputError(f"the smart room has no camera {name!r}, expected one of {', '.join(cameras.names)}")
    clock = FrameClock(rate_hz=world.rate_hz, start_ns=round(world.start_s * 1e6) * 1000)
    index = cameras.names.index(name)
    return RenderedCamera(cameras, index, person, scene=SCENE, sensor=SENSOR, seed=world.seed, clock=clock)


def open_simulated(
    text: str, *, clock_s: Callable[[], float] = time.time, sleep: Callable[[float], None] = time.sleep
) -> FrameSource:
    """Open a camera of a smart room.

    Args:
        text: `simulated:FOLDER#CAMERA`: live; frames that come too late are dropped and counted. With `?every` behind
            it every frame from number 0 on is delivered, none before its time; with `?every&first=K` from number K on.
        clock_s: the wall clock.
        sleep: waits for so many seconds.

    Raises:
        InputError: a text of another form, no such folder, or no such camera.
    """
    folder_text, hash_sign, camera_text = text.removeprefix(PREFIX).partition("#")
    name, _, query = camera_text.partition("?")
    if not (text.startswith(PREFIX) and folder_text and hash_sign and name):
        raise InputError(f"{text!r} is no simulated camera, expected such as simulated:FOLDER#C0")
    first = _first(query, text)
    folder = Path(folder_text)
    world = read_world(folder)
    person = person_of(folder, world)
    camera = rendered_camera(person, name, world)
    return SmartRoomSource(camera, person.refresh, start_s=world.start_s, first=first, clock_s=clock_s, sleep=sleep)


def _first(query: str, text: str) -> int | None:
    """First frame of a source that delivers every one; None for a live one."""
    if not query:
        return None
    fields = dict(parse_qsl(query, keep_blank_values=True))
    first = fields.pop("first", "0")
    if fields != {"every": ""} or not first.isdecimal():
        raise InputError(f"{text!r}: {query!r} is not known, expected every or every&first=NUMBER")
    return int(first)
