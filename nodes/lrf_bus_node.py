"""`spotcal lrf --config`: a node with one LRF. It publishes what its instruments measure, and the spot's crossings."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from nodes.bus.host_clock import clock_quality
from nodes.bus.keys import Role
from nodes.bus.node import BusNode
from nodes.devices.errors import DeviceError
from nodes.journal import Journal
from nodes.lrf.bus_acquisition import Surroundings
from nodes.lrf.bus_recorder import BusRecorder
from nodes.lrf.bus_runner import LrfRunner
from nodes.lrf.open_devices import open_devices
from nodes.site.bus_options import bus_options
from nodes.site.model import LrfNodeConfig

# A fault is told on the bus before the node ends.
TELLING_S = 1.5


def run_lrf_node(config: LrfNodeConfig, *, stop: threading.Event, console: Console) -> bool:
    """Run until told to stop; false when an instrument failed for good while running, which the bus was told.

    Args:
        config: of the node.
        stop: ends it.
        console: told once that it runs.

    Raises:
        SpotcalError: an instrument or the journal cannot be opened.
    """
    clock = time.monotonic
    with ExitStack() as stack:
        journal = stack.enter_context(Journal(Path(config.journal)))
        devices = open_devices(config.lrf, stack, clock=clock)
        stack.callback(_quietly, devices.scanner.stop)
        bus = BusNode(config.node, Role.LRF, bus_options(config), journal, clock=clock_quality())
        # The devices' clock never jumps; to Unix time it is brought when a session begins.
        recorder = BusRecorder(bus, config.lrf.name, offset_s=lambda: time.time() - clock())
        runner = LrfRunner(config.lrf, devices, bus, recorder, Surroundings(journal, stop, clock, stop.wait))
        bus.status, bus.on_command = runner.status, runner.command
        stack.enter_context(bus)
        console.print(f"LRF node {config.node} runs", markup=False, soft_wrap=True)
        try:
            runner.run()
        except DeviceError as error:
            runner.fail(error)
            bus.set_alive(False)
            stop.wait(TELLING_S)
            console.print(f"error: {error.message}", markup=False, soft_wrap=True)
            return False
    return True


def _quietly(stop: Callable[[], None]) -> None:
    """Switch the laser off; a scanner that is gone has been told of already."""
    try:
        stop()
    except DeviceError:
        return
