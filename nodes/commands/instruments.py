"""Commands for the instruments of an LRF node: `devices`, `emulate` and `lrf`. Wiring only; `cli.py` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.commands import site

ADDRESS_HELP = "Serial port such as /dev/ttyACM0, or tcp://host:port."
lrf = typer.Typer(help="Laser range finders: watch one, acquire with one, run one as a node.", no_args_is_help=True)
lrf.callback(invoke_without_command=True)(site.lrf_node)


def devices(
    addresses: Annotated[
        list[str] | None, typer.Argument(metavar="[ADDRESS]...", help=f"{ADDRESS_HELP} All serial ports by default.")
    ] = None,
) -> None:
    """Find and name the scanners, tilt units and IMUs on the serial ports; every port is asked."""
    from rich.console import Console

    from nodes.devices_list import devices_view
    from nodes.report.terminal import stderr_console

    Console().print(devices_view(addresses or [], console=stderr_console()))


def emulate(
    instrument: Annotated[str, typer.Argument(metavar="urg|ptu|mti|platform", help="What to emulate.")],
    folder: Annotated[Path, typer.Option("--dir", help="Where links to the emulated ports are made.")] = Path(
        "emulated"
    ),
    tcp: Annotated[bool, typer.Option("--tcp", help="On TCP ports of this machine instead.")] = False,
    newer: Annotated[bool, typer.Option("--newer", help="Successors: UST-10LX scanner, MTData2 IMU.")] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the simulated room and all noise.")] = 0,
    session: Annotated[
        Path | None, typer.Option("--session", metavar="FOLDER", help="Gets, at the end, what cameras saw meanwhile.")
    ] = None,
) -> None:
    """Emulate instruments that any program may talk to, until interrupted."""
    from nodes.emulate import run_emulators
    from nodes.report.terminal import stderr_console

    try:
        run_emulators(
            instrument, folder, is_tcp=tcp, is_newer=newer, seed=seed, session=session, console=stderr_console()
        )
    except KeyboardInterrupt:
        return


@lrf.command()
def monitor(
    scanner: Annotated[str, typer.Argument(metavar="PORT", help=ADDRESS_HELP)],
    tilt_unit: Annotated[str | None, typer.Option("--tilt-unit", metavar="PORT", help="Show its angle too.")] = None,
    imu: Annotated[str | None, typer.Option("--imu", metavar="PORT", help="Show its rates too.")] = None,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after so long.")] = None,
) -> None:
    """Show scan, angle, rates, clock drift and errors, live."""
    from rich.console import Console

    from nodes.lrf.monitor import MonitorAddresses, monitor

    try:
        monitor(MonitorAddresses(scanner, tilt_unit, imu), duration_s=seconds, console=Console())
    except KeyboardInterrupt:
        return


@lrf.command()
def acquire(
    scanner: Annotated[str, typer.Argument(metavar="PORT", help=ADDRESS_HELP)],
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Recording and tables; must hold none yet.")],
    tilt_unit: Annotated[str | None, typer.Option("--tilt-unit", metavar="PORT", help="What tilts it.")] = None,
    imu: Annotated[str | None, typer.Option("--imu", metavar="PORT", help="What measures the tilt.")] = None,
    tilts: Annotated[str, typer.Option("--tilts", metavar="DEGREES", help="Angles, with commas.")] = "12.1,23.2,50",
    crossings: Annotated[int, typer.Option("--crossings", min=1, help="At every tilt, at least.")] = 22,
    name: Annotated[str, typer.Option("--name", help="Of the LRF in the tables.")] = "L0",
) -> None:
    """Acquire crossings of the spot at one tilt after the other, and record every scan and sample."""
    from nodes.lrf.acquire import AcquirePlan, acquire, parse_tilts
    from nodes.lrf.monitor import MonitorAddresses
    from nodes.report.terminal import print_notes, stderr_console

    console = stderr_console()
    plan = AcquirePlan(name, parse_tilts(tilts), crossings, out)
    acquired = acquire(MonitorAddresses(scanner, tilt_unit, imu), plan, console=console)
    print_notes(console, acquired.tilts.notes)
    counts, found = acquired.scan_counts, ", ".join(str(len(setting.crossings)) for setting in acquired.settings)
    console.print(f"{found} crossings; {counts.scans} scans, {counts.missed} missed; written to {out}", soft_wrap=True)


@lrf.command()
def join(
    acquisitions: Annotated[
        list[Path], typer.Argument(metavar="ACQUISITION...", help="Folders of `lrf acquire`, one for each LRF.")
    ],
    session: Annotated[
        Path,
        typer.Option("--session", metavar="FOLDER", help="The cameras' table with stamps; gets lrf.csv, tilts.csv."),
    ],
) -> None:
    """Join crossings to the cameras' frames by time: `calibrate` then takes cameras and LRFs together."""
    from nodes.lrf.join import join
    from nodes.report.terminal import stderr_console

    joined = join(acquisitions, session)
    console = stderr_console()
    for line in joined.lines():
        console.print(line, markup=False, soft_wrap=True)
    console.print(f"lrf.csv and tilts.csv written to {session}", markup=False, soft_wrap=True)
