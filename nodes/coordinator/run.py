"""`spotcal coordinator`: from the configuration to the exit status; terminal, signals, and what is printed."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.live import Live

from network_calib.errors import InputError
from network_calib.formats.recording import read_text
from nodes.bus.session import open_bus
from nodes.coordinator.coordinator import Coordinator
from nodes.coordinator.keyboard import Keyboard
from nodes.coordinator.live_view import PlainLines, render
from nodes.coordinator.phases import Phase
from nodes.coordinator.plan import Plan, first_plan
from nodes.coordinator.session_folder import choose_session
from nodes.devices.errors import DeviceError
from nodes.site.bus_options import bus_options
from nodes.site.load import load_site

TICK_S = 0.2
# After the end: for those who ask for the calibration at that moment, and for nodes to take their last order.
LINGER_S = 1.0
STOPPING_S = 5.0
DONE, FAILED, INTERRUPTED = 0, 1, 130


def plan_of(config: Path, *, session: str | None, is_auto: bool, out: Path | None) -> Plan:
    """What is to be run.

    Args:
        config: site.toml.
        session: name; None for the newest that is not finished, or else a new one.
        is_auto: begins by itself.
        out: folder of the sessions, in place of the site's.

    Raises:
        InputError: a configuration or a state that cannot be read, a name that cannot be one, a session that is done.
    """
    site = load_site(config)
    data = Path(site.data) if out is None else out
    folder, saved = choose_session(data, session, now_s=time.time())
    if saved is not None and saved.phase is Phase.DONE:
        raise InputError(
            f"session {saved.session} is done: {folder.calibration}", advice="Name another one with --session."
        )
    return first_plan(site, read_text(config), folder, is_auto=is_auto, now_s=time.time())


def run_coordinator(plan: Plan, *, stop: threading.Event, console: Console) -> int:
    """Run a session to its end, or until told to stop.

    Args:
        plan: what is to be run.
        stop: ends it; everything is kept, and the session can go on later.
        console: shows what goes on.

    Returns:
        Exit status: 0 done, 1 failed, 130 stopped before.

    Raises:
        InputError: nobody could begin the session, or another coordinator runs it.
        DeviceError: the recording cannot be written.
    """
    with ExitStack() as stack:
        keyboard = stack.enter_context(Keyboard())
        if not (plan.rules.is_auto or keyboard.is_there):
            raise InputError(
                "no terminal: nobody could press Enter to begin", advice="Run it with --auto, or from a terminal."
            )
        _say(console, f"looking for a router at {', '.join(plan.site.router)}")
        try:
            bus = stack.enter_context(open_bus(bus_options(plan.site), stop=stop))
        except DeviceError:
            if stop.is_set():
                return INTERRUPTED
            raise
        _say_begin(console, plan)
        coordinator = stack.enter_context(Coordinator(bus, plan, has_keys=keyboard.is_there))
        _loop(coordinator, keyboard, stop=stop, console=console, is_auto=plan.rules.is_auto)
        return _ended(coordinator, plan, console)


def _loop(
    coordinator: Coordinator, keyboard: Keyboard, *, stop: threading.Event, console: Console, is_auto: bool
) -> None:
    plain = PlainLines()
    with Live(console=console, auto_refresh=False, transient=False) if console.is_terminal else ExitStack() as live:
        while not stop.is_set():
            for press in keyboard.presses() or (None,):
                coordinator.step(press)
            view = coordinator.view()
            if isinstance(live, Live):
                live.update(render(view), refresh=True)
            else:
                for line in plain.lines(view, now_s=time.monotonic()):
                    _say(console, line)
            if coordinator.is_over and not _is_serving(coordinator, is_auto=is_auto):
                break
            stop.wait(TICK_S)
    _linger(coordinator, stop)


def _is_serving(coordinator: Coordinator, *, is_auto: bool) -> bool:
    """A person at the terminal ends it; until then the calibration can be asked for."""
    return not is_auto and not coordinator.is_quit and coordinator.state.phase is Phase.DONE


def _linger(coordinator: Coordinator, stop: threading.Event) -> None:
    if not coordinator.state.phase.is_over:
        return
    begin_s = time.monotonic()
    while not stop.is_set():
        spent_s = time.monotonic() - begin_s
        if spent_s > STOPPING_S or (spent_s > LINGER_S and coordinator.is_everybody_stopped):
            return
        coordinator.step()
        stop.wait(TICK_S)


def _say_begin(console: Console, plan: Plan) -> None:
    if plan.is_resumed:
        _say(
            console,
            f"session {plan.saved.session} goes on from {plan.saved.phase.value}; --session NAME begins another",
        )
    else:
        _say(console, f"session {plan.saved.session}, kept in {plan.folder.path}")


def _ended(coordinator: Coordinator, plan: Plan, console: Console) -> int:
    folder = plan.folder
    match coordinator.state.phase:
        case Phase.DONE:
            _say(console, f"Written to {folder.path}: calibration, recording, report")
            return DONE
        case Phase.FAILED:
            _say(console, f"failed: {coordinator.state.warning}")
            _say(console, f"Everything is kept in {folder.path}; --session {plan.saved.session} goes on with it")
            return FAILED
        case _:
            _say(console, f"stopped; everything is kept in {folder.path}, and the next start goes on with it")
            return INTERRUPTED


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)
