"""A site of real processes, cameras of the simulated room, of which any may be killed and started again.

The cameras deliver every frame, though late: so a second site in the same world sees the very same frames.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import sys
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import tomli_w

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Kind, parse_observation
from nodes.camera.session_marks import SUFFIX
from nodes.coordinator.phases import Phase
from nodes.coordinator.session_folder import SessionFolder
from nodes.demo_files import N_BACKGROUND, PLANE_SIGMA_MM, REST_S
from nodes.demo_processes import Child, Children
from nodes.journal import Journal
from nodes.recording.reader import rows
from nodes.simulated.smart_room import World, read_world, write_world
from nodes.simulated.smart_room_events import EventFile, Wave
from nodes.simulated.smart_room_geometry import LRF_NAME, SIZE_PX, SmartRoom
from tests.nodes.bus.buses import free_endpoint

SITE, SESSION = "faults", "S1"
SPOTCAL = (sys.executable, "-c", "from nodes.cli import main; main()")
INSTRUMENTS = (sys.executable, "-m", "nodes.simulated.smart_room_lrf")
PORTS = {"scanner": "urg", "tilt_unit": "ptu", "imu": "mti"}
ROUTER, COORDINATOR, LRF = "router", "coordinator", "lrf"
N_CROSSINGS = 8
BACKGROUND_S, N_LEARNING = 1.0, 15
# From writing the wave down to its beginning: all processes have read of it by then.
REACTION_S = 1.2
# Nobody presses a key for so long: waving ends when the harness says so.
LONG_S = 3000.0


@dataclass(frozen=True, slots=True)
class Size:
    """Of a site and its session.

    Attributes:
        n_cameras: that are there, each with a node of its own.
        rate_hz: frames a second.
        wave_s: how long the person waves.
        tilts_deg: of the LRF; empty: there is none.
    """

    n_cameras: int
    rate_hz: float
    wave_s: float
    tilts_deg: tuple[float, ...] = ()


@dataclass(slots=True)
class FaultSite:
    """The programs of one site, and what they leave; `with` ends them all.

    Attributes:
        folder: of configuration, journals, logs and sessions.
        world: folder of the simulated room; may be another site's.
        size: of it.
        pressed: terminal at which the coordinator listens for keys.
    """

    folder: Path
    world: Path
    size: Size
    endpoint: str = field(default_factory=free_endpoint)
    running: dict[str, Child] = field(default_factory=dict)
    n_starts: Counter[str] = field(default_factory=Counter)
    _children: Children | None = None
    _terminal: int | None = None
    _other_ends: list[int] = field(default_factory=list)

    @property
    def cameras(self) -> dict[str, str]:
        """Camera of each camera node."""
        names = SmartRoom.of(read_world(self.world).seed).cameras.names[: self.size.n_cameras]
        return {f"camera-{name}": name for name in names}

    @property
    def nodes(self) -> tuple[str, ...]:
        return (*self.cameras, *((LRF,) if self.size.tilts_deg else ()))

    @property
    def programs(self) -> tuple[str, ...]:
        """All that may be killed."""
        return (ROUTER, COORDINATOR, *self.nodes)

    @property
    def session(self) -> SessionFolder:
        return SessionFolder(self.folder / "sessions" / SESSION)

    @property
    def phase(self) -> Phase:
        """As the coordinator saved it last."""
        saved = self.session.load()
        return Phase.IDLE if saved is None else saved.phase

    def journal(self, node: str) -> Path:
        return self.folder / f"{node}.journal"

    def start(self, name: str) -> None:
        """Start a program, again or for the first time."""
        assert self._children is not None
        self.n_starts[name] += 1
        log = f"{name}-{self.n_starts[name]}"
        match name:
            case "router":
                command = (*SPOTCAL, "router", "--listen", self.endpoint)
            case "coordinator":
                command = self._at_terminal(
                    (
                        *SPOTCAL,
                        "coordinator",
                        "--config",
                        str(self.folder / "site.toml"),
                        "--auto",
                        "--session",
                        SESSION,
                    )
                )
            case "lrf":
                command = (*SPOTCAL, "lrf", "--config", str(self.folder / "lrf.toml"))
            case _:
                command = (*SPOTCAL, "camera", "--config", str(self.folder / f"{name}.toml"))
        self.running[name] = self._children.start(log, command)

    def kill(self, name: str) -> None:
        """SIGKILL, of the program alone: what it started has to see for itself."""
        child = self.running.pop(name)
        child.process.kill()
        child.process.wait()

    def is_running(self, name: str) -> bool:
        return name in self.running and self.running[name].process.poll() is None

    def press(self, key: str) -> None:
        """A key at the coordinator's terminal; nobody may be there."""
        if self._terminal is not None and COORDINATOR in self.running:
            with suppress(OSError):
                os.write(self._terminal, key.encode())

    def wave(self) -> None:
        """The person begins to wave soon, on the grid of the cameras."""
        world = read_world(self.world)
        frame = math.ceil((time.time() + REACTION_S - world.start_s) * world.rate_hz)
        EventFile(self.world).append(Wave(world.start_s + frame / world.rate_hz, self.size.wave_s))

    def end_of_wave(self) -> int | None:
        """The first frame after the wave; None before there is one."""
        world = read_world(self.world)
        waves = [event for event in EventFile(self.world).new() if isinstance(event, Wave)]
        if not waves:
            return None
        return math.ceil((waves[-1].begin_s + waves[-1].seconds - world.start_s) * world.rate_hz)

    def newest_frame(self, node: str) -> int:
        """Of what the node journalled; -1 before anything."""
        found = query(
            self.journal(node), "SELECT payload FROM rows WHERE kind = ? ORDER BY row DESC LIMIT 1", Kind.SPOTS
        )
        return pb.SpotBatch.FromString(found[0][0]).frame_sequence[-1] if found else -1

    def has_seen_all(self) -> bool:
        """Whether every camera node journalled the whole wave."""
        end = self.end_of_wave()
        return end is not None and all(self.newest_frame(node) >= end for node in self.cameras)

    def told(self) -> str:
        """The ends of all logs, for whoever looks for the reason of a failure."""
        logs = sorted((self.folder / "logs").glob("*.log"))
        texts = {log.stem: log.read_text(encoding="utf-8", errors="replace").strip()[-1500:] for log in logs}
        return "\n".join(f"--- {name}\n{text}" for name, text in texts.items())

    def _at_terminal(self, command: tuple[str, ...]) -> tuple[str, ...]:
        """A session's leader that opens a terminal has it for its own; so the shell, which becomes the program."""
        if self._terminal is not None:
            os.close(self._terminal)
        self._terminal, other_end = os.openpty()
        name = os.ttyname(other_end)
        # A terminal of which nobody holds the other end is gone; the program opens it only later.
        self._other_ends.append(other_end)
        return ("/bin/sh", "-c", 'tty=$1; shift; exec "$@" <"$tty"', "sh", name, *command)

    def __enter__(self) -> Self:
        logs = self.folder / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        self._children = Children(logs)
        if self.size.tilts_deg:
            # Devices are no programs of the site: these are not killed.
            self._children.start("instruments", (*INSTRUMENTS, str(self.world)))
            while not all((self.world / port).exists() for port in PORTS.values()):
                self._children.check()
                time.sleep(0.05)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._children is not None:
            self._children.close()
        for end in (*self._other_ends, *(() if self._terminal is None else (self._terminal,))):
            os.close(end)
        self._other_ends, self._terminal = [], None


def new_site(folder: Path, size: Size, *, seed: int) -> FaultSite:
    """A site in a world of its own."""
    world = folder / "world"
    write_world(world, World(seed, round(time.time() + 1.0, 3), size.rate_hz))
    return _written(FaultSite(folder, world, size))


def site_as(folder: Path, other: FaultSite) -> FaultSite:
    """A site whose cameras begin the session with the same frames of the same world as another's did."""
    site = _written(FaultSite(folder, other.world, other.size))
    for node in site.cameras:
        with Journal(site.journal(node)) as journal:
            journal.session = SESSION
        marks = other.journal(node).with_name(other.journal(node).name + SUFFIX)
        site.journal(node).with_name(marks.name).write_bytes(marks.read_bytes())
    return site


def query(path: Path, text: str, *values: object) -> list[tuple[bytes, ...]]:
    """Of a journal, from outside of the node; nothing where the file is not there yet."""
    if not path.is_file():
        return []
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=10.0)
    try:
        return connection.execute(text, values).fetchall()
    except sqlite3.OperationalError:  # its tables are not there yet
        return []
    finally:
        connection.close()


def journalled(site: FaultSite) -> Counter[tuple[str, bytes]]:
    """Key and payload of all that the nodes wrote down of the session."""
    text = "SELECT rows.key, rows.payload FROM rows JOIN runs USING (run) WHERE runs.session = ?"
    return Counter(
        (str(key), payload) for node in site.nodes for key, payload in query(site.journal(node), text, SESSION)
    )


def recorded(site: FaultSite) -> Counter[tuple[str, bytes]]:
    """Key and payload of all observations in the finished recording."""
    found = rows(site.session.path / "session.mcap")
    return Counter((row.key, row.payload) for row in found if parse_observation(row.key) is not None)


def numbers_of(calibration: Path) -> dict[str, object]:
    """A calibration without the time at which it was made."""
    document = json.loads(calibration.read_text(encoding="utf-8"))
    del document["provenance"]["created_utc"]
    return document


def _written(site: FaultSite) -> FaultSite:
    site.folder.mkdir(parents=True, exist_ok=True)
    room = SmartRoom.of(read_world(site.world).seed)
    names, lenses = room.cameras.names[: site.size.n_cameras], room.cameras.lenses
    document = {
        "name": SITE,
        "router": [site.endpoint],
        "nodes": [{"name": node, "role": "lrf" if node == LRF else "camera"} for node in site.nodes],
        "cameras": [
            {"name": name, "size": list(SIZE_PX), "lens": lens.value} for name, lens in zip(names, lenses, strict=False)
        ],
        "anchor": {"kind": "stereo", "cameras": list(names[:2]), "baseline_m": room.baseline_m},
        "session": {"background_s": BACKGROUND_S, "min_waving_s": LONG_S, "max_waving_s": LONG_S},
    }
    if site.size.tilts_deg:
        document["lrfs"] = [{"name": LRF_NAME}]
        document["session"] |= {"tilts_deg": list(site.size.tilts_deg), "crossings": N_CROSSINGS}
        (site.folder / "lrf.toml").write_text(tomli_w.dumps(_lrf(site)), encoding="utf-8")
    (site.folder / "site.toml").write_text(tomli_w.dumps(document), encoding="utf-8")
    for node, camera in site.cameras.items():
        source = f"simulated:{site.world.absolute()}#{camera}?every"
        document = {
            "node": node,
            "site": SITE,
            "router": [site.endpoint],
            "journal": site.journal(node).name,
            "cameras": [{"name": camera, "source": source, "n_learning": N_LEARNING}],
        }
        (site.folder / f"{node}.toml").write_text(tomli_w.dumps(document), encoding="utf-8")
    return site


def _lrf(site: FaultSite) -> dict[str, object]:
    return {
        "node": LRF,
        "site": SITE,
        "router": [site.endpoint],
        "journal": site.journal(LRF).name,
        "lrf": {
            "name": LRF_NAME,
            **{key: str((site.world / port).absolute()) for key, port in PORTS.items()},
            "crossings": N_CROSSINGS,
            "plane_sigma_mm": PLANE_SIGMA_MM,
            "rest_s": REST_S,
            "n_background": N_BACKGROUND,
        },
    }
