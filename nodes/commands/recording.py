"""Commands for recordings: `record`, `replay` and `info`. Wiring only; `cli.py` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"
Recording = Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of a session, or a .mcap file.")]
Router = Annotated[
    list[str] | None, typer.Option("--router", metavar="ADDRESS", help=f"{DEFAULT_ROUTER} by default; may be repeated.")
]


def info(session: Recording) -> None:
    """Print what a recording holds: nodes, cameras, LRFs, what was refused and what is missing."""
    from rich.console import Console

    from nodes.recording.info import info as info_view

    Console(highlight=False).print(info_view(session))


def replay(
    session: Recording,
    speed: Annotated[float, typer.Option("--speed", min=0, help="2: twice as fast; 0: as fast as possible.")] = 1.0,
    router: Router = None,
) -> None:
    """Publish a recording into the bus as if it were live: same keys, payloads unchanged."""
    from nodes.bus.session import BusOptions
    from nodes.recording.replay import ReplayOptions
    from nodes.recording.replay import replay as replay_into_bus
    from nodes.report.terminal import stderr_console
    from nodes.site.until_signal import until_signal

    console = stderr_console()
    # The keys of the recording name its site.
    bus = BusOptions(site="replay", endpoints=tuple(router or [DEFAULT_ROUTER]))
    with until_signal() as stop:
        replayed = replay_into_bus(ReplayOptions(session, bus, speed), stop=stop, console=console)
    console.print(f"{replayed.n_published} of {replayed.n_rows} messages published")


def record(
    site: Annotated[str, typer.Option("--site", metavar="NAME", help="Of the site, as its nodes know it.")],
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="For the recording; one there is continued.")],
    router: Router = None,
) -> None:
    """Record what a site's nodes observe, until interrupted; no coordinator is needed."""
    from nodes.bus.session import BusOptions
    from nodes.recording.record import record as record_bus
    from nodes.report.terminal import stderr_console
    from nodes.site.until_signal import until_signal

    console = stderr_console()
    bus = BusOptions(site=site, endpoints=tuple(router or [DEFAULT_ROUTER]))
    with until_signal() as stop, console.status("waiting for the router") as status:
        recorded = record_bus(
            bus,
            out,
            stop=stop,
            told=lambda now: status.update(f"{now.n_rows} messages recorded, {now.refused.total()} refused"),
        )
    for reason, count in sorted(recorded.refused.items()):
        console.print(f"refused: {count} x {reason}", markup=False, soft_wrap=True)
    console.print(f"{recorded.n_rows} messages written to {recorded.path}", markup=False, soft_wrap=True)
