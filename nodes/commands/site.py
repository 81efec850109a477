"""Commands of the running smart room's nodes: `camera`, `lrf` without a subcommand, and `init`. Wiring only."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXIT_FAULT = 1
NodeFile = Annotated[Path, typer.Option("--config", metavar="FILE", help="Of the node; `spotcal init` writes one.")]


def camera(config: NodeFile) -> None:
    """Run a camera node until it is told to end: finds the spot in what its cameras see, and publishes it."""
    from nodes.camera_node import run_camera_node
    from nodes.report.terminal import stderr_console
    from nodes.site.load import load_camera_node
    from nodes.site.until_signal import until_signal

    with until_signal() as stop:
        is_well = run_camera_node(load_camera_node(config), stop=stop, console=stderr_console())
    if not is_well:
        raise typer.Exit(EXIT_FAULT)


def lrf_node(
    context: typer.Context,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Run a node until told to end; `init` writes one.")
    ] = None,
) -> None:
    """Laser range finders: watch one, acquire with one, run one as a node."""
    if config is None:
        return
    if context.invoked_subcommand is not None:
        from network_calib.errors import InputError

        raise InputError(f"lrf --config runs a node, and {context.invoked_subcommand} is another command")
    from nodes.lrf_bus_node import run_lrf_node
    from nodes.report.terminal import stderr_console
    from nodes.site.load import load_lrf_node
    from nodes.site.until_signal import until_signal

    with until_signal() as stop:
        is_well = run_lrf_node(load_lrf_node(config), stop=stop, console=stderr_console())
    if not is_well:
        raise typer.Exit(EXIT_FAULT)


def init(
    what: Annotated[str, typer.Argument(metavar="site|camera|lrf", help="Which file.")],
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="By default site.toml and so on.")] = None,
) -> None:
    """Write a commented example of a configuration file."""
    from network_calib.errors import InputError
    from nodes.report.terminal import stderr_console
    from nodes.site.examples import Example, example

    if what not in tuple(Example):
        raise InputError(f"init {what}: expected one of {', '.join(Example)}")
    path = out or Path(f"{what}.toml")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(example(Example(what)))
    except FileExistsError:
        raise InputError(f"{path} is there already", advice="Name another file with --out, or move it.") from None
    stderr_console().print(f"Written to {path}: change what stands in it", markup=False, soft_wrap=True)
