"""The command `coordinator`. Wiring only; `cli.py` registers it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def coordinator(
    config: Annotated[
        Path, typer.Option("--config", metavar="FILE", help="site.toml; `spotcal init site` writes one.")
    ],
    session: Annotated[
        str | None, typer.Option("--session", help="Name; by default the newest that is not finished, or a new one.")
    ] = None,
    auto: Annotated[bool, typer.Option("--auto", help="Begin when all expected nodes are there; no keys.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Of the sessions, in place of the site's `data`.")
    ] = None,
) -> None:
    """Run a session: record what all nodes see, guide the person who waves, calibrate."""
    from rich.console import Console

    from nodes.coordinator.run import plan_of, run_coordinator
    from nodes.site.until_signal import until_signal

    with until_signal() as stop:
        plan = plan_of(config, session=session, is_auto=auto, out=out)
        status = run_coordinator(plan, stop=stop, console=Console())
    if status:
        sys.exit(status)
