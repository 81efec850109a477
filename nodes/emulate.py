"""`spotcal emulate`: emulated instruments on ptys and TCP ports, for anyone's program to talk to."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from lrf_stereo.synthetic import paper_scene
from network_calib.errors import InputError
from nodes.simulated.emulator import Emulator
from nodes.simulated.emulator_server import EmulatorServer
from nodes.simulated.mti_device import MtiDevice, MtiModel
from nodes.simulated.platform import SimulatedPlatform
from nodes.simulated.scip_device import ScipDevice
from nodes.simulated.scip_model import URG_04LX, UST_10LX
from nodes.simulated.tilt_unit_device import AxisModel, TiltUnitDevice
from nodes.simulation.emulated_session import write_camera_session

INSTRUMENTS = ("urg", "ptu", "mti", "platform")
# The paper's tilts need more than the -907 steps of a D46-17: the unit is taken to be mounted pitched.
TILT_AXIS = AxisModel(-1200, 604, play=1.0)
# Beside the stereo pair.
N_ROOM_CAMERAS = 3


@dataclass(frozen=True, slots=True)
class EmulatedDevices:
    """Emulators that share one room, by name."""

    platform: SimulatedPlatform
    by_name: dict[str, Emulator]


def emulated_devices(*, seed: int, is_newer: bool = False) -> EmulatedDevices:
    """The paper's platform in its simulated room; `is_newer`: a network scanner and an MTData2 IMU in their place."""
    tilt_unit = TiltUnitDevice(tilt=TILT_AXIS)
    scene = paper_scene(rng=np.random.default_rng(seed), n_spots_per_tilt=1, n_room_cameras=N_ROOM_CAMERAS)
    model = UST_10LX if is_newer else URG_04LX
    platform = SimulatedPlatform(scene, tilt_unit, seed=seed, steps=model.steps)
    imu = MtiDevice(platform.motion, rng=np.random.default_rng([seed, 1]), model=MtiModel(is_successor=is_newer))
    return EmulatedDevices(platform, {"urg": ScipDevice(platform.scan_at, model=model), "ptu": tilt_unit, "mti": imu})


def run_emulators(
    name: str,
    folder: Path,
    *,
    is_tcp: bool,
    is_newer: bool,
    seed: int,
    console: Console,
    session: Path | None = None,
    wait: Callable[[EmulatorServer], None] | None = None,
) -> None:
    """Serve until interrupted.

    Args:
        name: one of INSTRUMENTS; `platform` serves all three, which share their room.
        folder: where links to the ptys are made.
        is_tcp: serve on TCP ports of this machine instead.
        is_newer: the successors of scanner and IMU.
        seed: of the room and all noise.
        console: told the addresses.
        session: folder that gets, at the end, what cameras of the same room saw meanwhile; of `platform` only.
        wait: returns when it is enough; for tests.

    Raises:
        InputError: no such instrument, or a session without a tilt unit that moves.
    """
    if name not in INSTRUMENTS:
        raise InputError(f"emulate {name}: expected one of {', '.join(INSTRUMENTS)}")
    if session is not None and name != "platform":
        raise InputError(f"emulate {name} --session: there is a spot to see only where platform is emulated")
    names = ("urg", "ptu", "mti") if name == "platform" else (name,)
    devices = emulated_devices(seed=seed, is_newer=is_newer)
    server = EmulatorServer()
    if not is_tcp:
        folder.mkdir(parents=True, exist_ok=True)
    for each in names:
        emulator = devices.by_name[each]
        address = server.add_tcp(emulator) if is_tcp else server.add_pty(emulator, folder / each)
        console.print(f"{each}  {address}", markup=False, soft_wrap=True)
    wall_zero_s = time.time() - server.now_s
    try:
        with server:
            (wait or _forever)(server)
    finally:
        if session is not None:
            write_camera_session(devices.platform, session, end_s=server.now_s, wall_zero_s=wall_zero_s)
            console.print(f"cameras  {session}", markup=False, soft_wrap=True)


def _forever(server: EmulatorServer) -> None:
    while server.error is None:
        time.sleep(0.2)
    raise server.error
