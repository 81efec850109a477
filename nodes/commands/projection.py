"""Commands around projection: `projection` and `project`. Wiring only; `cli.py` registers them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"
DISTANCE_HELP = "Stream scans into cameras so near to one of their points: no wall between rooms is known."


def projection(
    site: Annotated[str, typer.Option("--site", metavar="NAME", help="Of the site, as its nodes know it.")] = "lab",
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="FILE", help="A calibration.json, read again whenever it changes."),
    ] = None,
    from_bus: Annotated[
        bool, typer.Option("--from-bus", help="Take the coordinator's newest calibration; the default.")
    ] = False,
    router: Annotated[
        list[str] | None,
        typer.Option("--router", metavar="ADDRESS", help=f"{DEFAULT_ROUTER} by default; may be repeated."),
    ] = None,
    max_distance: Annotated[
        float, typer.Option("--max-distance", metavar="M", min=0.1, help=DISTANCE_HELP, show_default=False)
    ] = math.inf,
    tls_ca: Annotated[Path | None, typer.Option("--tls-ca", metavar="PEM", help="Certificate of the site.")] = None,
    tls_certificate: Annotated[
        Path | None, typer.Option("--tls-certificate", metavar="PEM", help="Certificate of this program.")
    ] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", metavar="PEM", help="Key of the certificate.")] = None,
) -> None:
    """Answer where laser points appear in every camera, and stream every scan, until interrupted."""
    from network_calib.errors import InputError
    from nodes.bus.router import tls_of
    from nodes.bus.session import BusOptions
    from nodes.projection.service import run_projection
    from nodes.site.until_signal import until_signal

    if from_bus and calibration is not None:
        raise InputError("--calibration and --from-bus: give one of them")
    bus = BusOptions(site, tuple(router or [DEFAULT_ROUTER]), tls_of(tls_ca, tls_certificate, tls_key))
    with until_signal() as stop:
        run_projection(
            bus, calibration, stop=stop, say=lambda line: print(line, flush=True), max_distance_m=max_distance
        )


def project(
    points: Annotated[
        Path, typer.Argument(help="Table of laser points: lrf,range_m,bearing_rad,tilt_deg or x,y,z (world).")
    ],
    calibration: Annotated[Path, typer.Option("--calibration", metavar="FILE", help="A calibration.json.")],
    camera: Annotated[str, typer.Option("--camera", metavar="NAME", help="The camera to look through.")],
    out: Annotated[Path, typer.Option("--out", metavar="PNG", help="Picture to write.")] = Path("overlay.png"),
    image: Annotated[
        Path | None, typer.Option("--image", metavar="FILE", help="A frame of the camera to draw on.")
    ] = None,
) -> None:
    """Draw laser points over a camera's image, coloured by range, with 95 % error ellipses; walls hide none of them."""
    from nodes.projection.calibration import Calibration
    from nodes.projection.overlay import draw_overlay
    from nodes.projection.points_file import read_points
    from nodes.report.terminal import stderr_console
    from nodes.solve import check_writable

    check_writable(out)
    drawn = draw_overlay(Calibration.load(calibration), read_points(points), camera, out, image=image)
    told = f"{len(drawn.px)} of {drawn.n_given} points in the image; written to {out}"
    stderr_console().print(told, markup=False, soft_wrap=True)
