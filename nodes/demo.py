"""The demonstration: a whole simulated smart room as separate processes, calibrated and compared with its truth."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from network_calib.errors import SpotcalError
from network_calib.formats.calibration_json import load
from network_calib.result import Calibration
from nodes.demo_files import SESSION, DemoFiles, write_demo
from nodes.demo_person import DemoPerson
from nodes.demo_processes import Child, Children
from nodes.demo_truth import compare_cameras, compare_lrf, lrf_truth_table, truth_table, verdict_of
from nodes.devices.errors import DeviceError
from nodes.simulated.smart_room import DEFAULT_RATE_HZ, read_world
from nodes.simulated.smart_room_events import EventFile, Move, Rest
from nodes.simulated.smart_room_geometry import SmartRoom
from nodes.site.until_signal import until_signal

TICK_S = 0.2
ROUTER_S, PORTS_S, SESSION_S = 30.0, 30.0, 480.0
SPOTCAL = (sys.executable, "-c", "from nodes.cli import main; main()")
INSTRUMENTS = (sys.executable, "-m", "nodes.simulated.smart_room_lrf")
PORTS = ("urg", "ptu", "mti")

_Say = Callable[[str], None]
_Condition = Callable[[], bool]


class InterruptedDemoError(SpotcalError):
    """The user asked the demonstration to end."""


def run_demo(out: Path, *, seed: int, console: Console) -> bool:
    """Start the room's programs, play the person, compare the result with the truth.

    Args:
        out: folder of everything that is left.
        seed: of the room and all noise.
        console: told what goes on; the coordinator's lines pass through.

    Returns:
        Whether everything was reached.

    Raises:
        SpotcalError: a program ended, or the session did not come to its end.
    """
    begin_s = time.monotonic()
    files = write_demo(out, seed=seed, rate_hz=DEFAULT_RATE_HZ)
    with until_signal() as stop:
        _run_session(files, stop=stop, say=lambda line: _say(console, line))
    calibration = load(files.session / "calibration.json")
    is_reached = show_truth(calibration, files.world, console)
    _say(console, f"The whole took {time.monotonic() - begin_s:.0f} s. In {files.session}:")
    for path in sorted(path for path in files.session.iterdir() if path.is_file()):
        _say(console, f"  {path.name}  ({path.stat().st_size / 1e6:.1f} MB)")
    return is_reached


def show_truth(calibration: Calibration, world: Path, console: Console) -> bool:
    """Tables and verdict; whether everything was reached."""
    room = SmartRoom.of(read_world(world).seed)
    cameras = compare_cameras(calibration, room.cameras)
    tilts_rad = tilts_of(world)
    lrfs = [compare_lrf(calibration, lrf, room.cameras, room.scanner, tilts_rad) for lrf in calibration.lrfs]
    verdict = verdict_of(calibration, cameras, lrfs)
    console.print(truth_table(cameras))
    console.print(f"Hold-out: {calibration.quality.holdout.rms_px:.3f} px RMS", highlight=False)
    console.print(lrf_truth_table(lrfs))
    console.print(verdict.text, soft_wrap=True)
    return not verdict.missed


def tilts_of(world: Path) -> tuple[float, ...]:
    """True tilts at which the unit stayed; where it only came by on its way, it moved on at once."""
    turns = [event for event in EventFile(world).new() if isinstance(event, Rest | Move)]
    after = [*turns[1:], None]
    pairs = zip(turns, after, strict=True)
    return tuple(
        rest.tilt_rad
        for rest, then in pairs
        if isinstance(rest, Rest) and (then is None or then.time_s - rest.time_s > 1.0)
    )


def _run_session(files: DemoFiles, *, stop: threading.Event, say: _Say) -> None:
    """From the first program's start to the last one's end.

    Raises:
        SpotcalError: a program ended, the session did not come to its end, or the user interrupted it.
    """
    with Children(files.logs) as children:
        say(f"starting router, {len(files.cameras)} cameras, LRF and coordinator; logs in {files.logs}")
        children.start("router", (*SPOTCAL, "router", "--listen", files.endpoint))
        children.start("instruments", (*INSTRUMENTS, str(files.world)))
        for node, config in files.cameras.items():
            children.start(node, (*SPOTCAL, "camera", "--config", str(config)))
        _wait(lambda: _is_listening(files.endpoint), ROUTER_S, "the router", children, stop)
        _wait(lambda: all((files.world / port).exists() for port in PORTS), PORTS_S, "instruments", children, stop)
        children.start("lrf", (*SPOTCAL, "lrf", "--config", str(files.lrf)))
        coordinator = children.start(
            "coordinator",
            (*SPOTCAL, "coordinator", "--config", str(files.site), "--auto", "--session", SESSION),
            echo=lambda line: say(f"  {line}"),
        )
        _play(files, children, coordinator, stop)
        coordinator.join()
        if coordinator.process.returncode != 0:
            raise DeviceError(
                f"the coordinator ended with status {coordinator.process.returncode}:\n{coordinator.tail()}",
                advice=f"What the other programs said is in {files.logs}.",
            )
        say("ending all programs")


def _play(files: DemoFiles, children: Children, coordinator: Child, stop: threading.Event) -> None:
    """Be the person in the room until the coordinator ends."""
    from nodes.bus.keys import Keys
    from nodes.bus.session import BusOptions, open_bus
    from nodes.demo_files import SITE

    person = DemoPerson(files.world)
    with ExitStack() as stack:
        bus = stack.enter_context(open_bus(BusOptions(SITE, (files.endpoint,)), stop=stop))
        person.listen(bus, Keys(SITE))

        def is_over() -> bool:
            person.step()
            return coordinator.process.poll() is not None

        _wait(is_over, SESSION_S, "the session", children, stop, but=coordinator)


def _wait(
    is_done: _Condition,
    timeout_s: float,
    what: str,
    children: Children,
    stop: threading.Event,
    *,
    but: Child | None = None,
) -> None:
    end_s = time.monotonic() + timeout_s
    while not is_done():
        children.check(but=but)
        if stop.wait(TICK_S):
            raise InterruptedDemoError("interrupted; all programs were ended")
        if time.monotonic() > end_s:
            raise DeviceError(f"{what} did not come to its end within {timeout_s:.0f} s")


def _is_listening(endpoint: str) -> bool:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        with socket.create_connection((host, int(port)), timeout=TICK_S):
            return True
    except OSError:
        return False


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)
