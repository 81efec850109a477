"""The instruments of the simulated smart room: `python -m nodes.simulated.smart_room_lrf FOLDER`.

Emulated scanner, tilt unit and IMU on the ptys FOLDER/urg, FOLDER/ptu and FOLDER/mti, in one process of their own. When
the tilt unit comes to rest or begins to move, this is told to the other processes as an event of the world.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.observations import FloatArray
from nodes.simulated.emulator import Emulator
from nodes.simulated.emulator_server import EmulatorServer
from nodes.simulated.mti_device import MtiDevice
from nodes.simulated.platform import SimulatedPlatform
from nodes.simulated.scip_device import ScipDevice
from nodes.simulated.smart_room import World, person_of, read_world
from nodes.simulated.smart_room_events import EventFile, Move, Rest
from nodes.simulated.smart_room_geometry import SmartRoom
from nodes.simulated.smart_room_person import SmartRoomPerson
from nodes.simulated.tilt_unit_device import AxisModel, TiltUnitDevice

TILT_AXIS = AxisModel(-907, 604, play=1.0)


class SmartRoomPlatform(SimulatedPlatform):
    """The platform in the smart room, whose person follows the world's events.

    Args:
        room: the truth.
        person: where the spot is.
        tilt_unit: what the scanner and the IMU follow.
        zero_s: the world's time at the instruments' time 0.
    """

    def __init__(self, room: SmartRoom, person: SmartRoomPerson, tilt_unit: TiltUnitDevice, *, zero_s: float) -> None:
        super().__init__(room.scene, tilt_unit, seed=room.seed)
        self._person, self._zero_s = person, zero_s

    def spot_in_world(self, time_s: float) -> FloatArray | None:
        """(3,) centre of the spot; None while the person is away."""
        self._person.refresh()
        return self._person.spot_in_world(time_s + self._zero_s)


class ReportingTiltUnit:
    """The tilt unit's emulator, which tells the world when the unit rests and moves; see `Emulator`.

    Args:
        unit: the unit.
        events: told.
        zero_s: the Unix epoch's time at the instruments' time 0.
    """

    def __init__(self, unit: TiltUnitDevice, events: EventFile, *, zero_s: float) -> None:
        self._unit, self._events, self._zero_s = unit, events, zero_s
        self._told_s = math.inf

    def connect(self, now_s: float) -> None:
        """See `Emulator`."""
        self._unit.connect(now_s)

    def disconnect(self, now_s: float) -> None:
        """See `Emulator`."""
        self._unit.disconnect(now_s)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `Emulator`."""
        self._unit.receive(data, now_s)
        self._tell(now_s)

    def send(self, now_s: float) -> bytes:
        """See `Emulator`."""
        self._tell(now_s)
        return self._unit.send(now_s)

    def next_due_s(self) -> float:
        """See `Emulator`."""
        return self._unit.next_due_s()

    def _tell(self, now_s: float) -> None:
        since_s = self._unit.rests_since_s(now_s)
        if since_s == self._told_s:
            return
        if math.isfinite(self._told_s):
            self._events.append(Move(now_s + self._zero_s))
        if math.isfinite(since_s):
            self._events.append(Rest(since_s + self._zero_s, float(self._unit.tilt_rad(now_s))))
        self._told_s = since_s


def smart_room_emulators(folder: Path, world: World, *, zero_s: float) -> dict[str, Emulator]:
    """Scanner, tilt unit and IMU by the names of their ptys; `zero_s`: Unix epoch's time at the instruments' time 0."""
    unit = TiltUnitDevice(tilt=TILT_AXIS)
    person = person_of(folder, world)
    platform = SmartRoomPlatform(SmartRoom.of(world.seed), person, unit, zero_s=zero_s - world.start_s)
    return {
        "urg": ScipDevice(platform.scan_at),
        "ptu": ReportingTiltUnit(unit, EventFile(folder), zero_s=zero_s),
        "mti": MtiDevice(platform.motion, rng=np.random.default_rng([world.seed, 1])),
    }


def serve(folder: Path, stop: threading.Event) -> None:
    """Serve until `stop` is set.

    Raises:
        InputError: the folder holds no world.
    """
    world = read_world(folder)
    server = EmulatorServer()
    emulators = smart_room_emulators(folder, world, zero_s=time.time() - server.now_s)
    for name, emulator in emulators.items():
        print(name, server.add_pty(emulator, folder / name), flush=True)
    with server:
        while server.error is None and not stop.is_set():
            stop.wait(0.2)
    if server.error is not None:
        raise server.error


def main() -> int:
    """Serve until SIGTERM or SIGINT."""
    if len(sys.argv) != 2:
        print("usage: python -m nodes.simulated.smart_room_lrf FOLDER", file=sys.stderr)
        return 2
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        serve(Path(sys.argv[1]), stop)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
