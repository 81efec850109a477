"""The folder of the demonstration: its simulated world, and the configuration files of all its programs."""

from __future__ import annotations

import shutil
import socket
import time
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from network_calib.errors import InputError
from nodes.simulated.smart_room import WORLD_FILE, World, write_world
from nodes.simulated.smart_room_geometry import LRF_NAME, SIZE_PX, SmartRoom

SITE, SESSION = "demo", "demo"
# The world's time begins when all programs have surely started to look for it.
WORLD_DELAY_S = 1.0
BACKGROUND_S, MIN_WAVING_S, MAX_WAVING_S, TARGET_SIGMA_MM = 4.0, 30.0, 120.0, 2.0
TILTS_DEG, N_CROSSINGS = (2.0, 12.0, 23.0), 12
# The platform of the smart room stands still at once, and its person comes back after `smart_room_person.AWAY_S`.
REST_S, N_BACKGROUND = 1.3, 15
PLANE_SIGMA_MM = 4.0
MADE = ("world", "nodes", "journals", "logs", "sessions")


@dataclass(frozen=True, slots=True)
class DemoFiles:
    """Where everything is.

    Attributes:
        out: folder of it all.
        endpoint: of the router.
        cameras: configuration files of the camera nodes, by node.
    """

    out: Path
    endpoint: str
    cameras: dict[str, Path]

    @property
    def world(self) -> Path:
        """Folder of the simulated room."""
        return self.out / "world"

    @property
    def site(self) -> Path:
        """Configuration of the site."""
        return self.out / "site.toml"

    @property
    def lrf(self) -> Path:
        """Configuration of the LRF node."""
        return self.out / "nodes" / "lrf.toml"

    @property
    def logs(self) -> Path:
        """Folder of what the programs said."""
        return self.out / "logs"

    @property
    def session(self) -> Path:
        """Folder of the session."""
        return self.out / "sessions" / SESSION


def write_demo(out: Path, *, seed: int, rate_hz: float) -> DemoFiles:
    """Make the folder; what an earlier demonstration left in it is removed.

    Raises:
        InputError: the folder holds something that no demonstration made.
    """
    _clear(out)
    room = SmartRoom.of(seed)
    files = DemoFiles(
        out=out,
        endpoint=f"tcp/127.0.0.1:{_free_port()}",
        cameras={f"camera-{name}": out / "nodes" / f"camera-{name}.toml" for name in room.cameras.names},
    )
    for name in MADE:
        (out / name).mkdir(parents=True, exist_ok=True)
    write_world(files.world, World(seed, round(time.time() + WORLD_DELAY_S, 3), rate_hz))
    files.site.write_text(_site(files, room), encoding="utf-8")
    for (node, path), camera in zip(files.cameras.items(), room.cameras.names, strict=True):
        path.write_text(_camera(files, node, camera), encoding="utf-8")
    files.lrf.write_text(_lrf(files), encoding="utf-8")
    return files


def _clear(out: Path) -> None:
    there = [name for name in MADE if (out / name).exists()]
    if there and not (out / "world" / WORLD_FILE).is_file():
        raise InputError(f"{out} holds {', '.join(there)} that no demonstration made", advice="Name another --out.")
    for name in there:
        shutil.rmtree(out / name)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def _site(files: DemoFiles, room: SmartRoom) -> str:
    """What the user of the room knows: image sizes, lens models, the pair's baseline; no intrinsics."""
    cameras = room.cameras
    return tomli_w.dumps(
        {
            "name": SITE,
            "router": [files.endpoint],
            "data": "sessions",
            "nodes": [*({"name": node, "role": "camera"} for node in files.cameras), {"name": "lrf", "role": "lrf"}],
            "cameras": [
                {"name": name, "size": list(SIZE_PX), "lens": lens.value}
                for name, lens in zip(cameras.names, cameras.lenses, strict=True)
            ],
            "lrfs": [{"name": LRF_NAME}],
            "anchor": {"kind": "stereo", "cameras": list(cameras.names[:2]), "baseline_m": room.baseline_m},
            "session": {
                "background_s": BACKGROUND_S,
                "target_sigma_mm": TARGET_SIGMA_MM,
                "min_waving_s": MIN_WAVING_S,
                "max_waving_s": MAX_WAVING_S,
                "tilts_deg": list(TILTS_DEG),
                "crossings": N_CROSSINGS,
            },
        }
    )


def _camera(files: DemoFiles, node: str, camera: str) -> str:
    return tomli_w.dumps(
        {
            "node": node,
            "site": SITE,
            "router": [files.endpoint],
            "journal": f"../journals/{node}.journal",
            "cameras": [{"name": camera, "source": f"simulated:../world#{camera}"}],
        }
    )


def _lrf(files: DemoFiles) -> str:
    # A serial port's address is its path as it is: links beside this file would be looked for elsewhere.
    ports = {key: str((files.world / name).absolute()) for key, name in _PORTS.items()}
    return tomli_w.dumps(
        {
            "node": "lrf",
            "site": SITE,
            "router": [files.endpoint],
            "journal": "../journals/lrf.journal",
            "lrf": {
                "name": LRF_NAME,
                **ports,
                "crossings": N_CROSSINGS,
                "plane_sigma_mm": PLANE_SIGMA_MM,
                "rest_s": REST_S,
                "n_background": N_BACKGROUND,
            },
        }
    )


_PORTS = {"scanner": "urg", "tilt_unit": "ptu", "imu": "mti"}
