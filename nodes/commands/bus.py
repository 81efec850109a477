"""Commands for the bus: `router`. Wiring only; `cli.py` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

LISTEN_HELP = "Address to listen at; may be repeated. 0.0.0.0 means all of this machine's."


def router(
    listen: Annotated[list[str] | None, typer.Option("--listen", metavar="tcp/HOST:PORT", help=LISTEN_HELP)] = None,
    tls_ca: Annotated[Path | None, typer.Option("--tls-ca", metavar="PEM", help="Certificate of the site.")] = None,
    tls_certificate: Annotated[
        Path | None, typer.Option("--tls-certificate", metavar="PEM", help="Certificate of this router.")
    ] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", metavar="PEM", help="Key of the certificate.")] = None,
) -> None:
    """Run the router that nodes and coordinator connect to, until interrupted."""
    from nodes.bus.router import run_router, tls_of
    from nodes.site.until_signal import until_signal

    with until_signal() as stop:
        run_router(
            tuple(listen or ["tcp/0.0.0.0:7447"]),
            stop=stop,
            say=lambda line: print(line, flush=True),
            tls=tls_of(tls_ca, tls_certificate, tls_key),
        )
