"""Commands that look at pictures: `detect`, `spot` and `cameras`. Wiring only; `cli.py` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RECORDING_HELP = "Recording of one camera: a video file or a folder of images. NAME=SOURCE names the camera."
SOURCE_HELP = "Video file, folder of images, rtsp://host/path, or /dev/video0."
BACKGROUND_HELP = "Where the scene without the spot is learnt: the whole recording, or its first N frames if empty."
MASK_HELP = "Black where no spot may be; of the pictures' size."

Channel = Annotated[
    str, typer.Option("--channel", metavar="auto|red|green|blue|luma", help="The light of the pointer.")
]
MaxCandidates = Annotated[int, typer.Option("--max-candidates", min=1, max=50, help="Spots kept of each picture.")]


def detect(
    sources: Annotated[list[str], typer.Argument(metavar="[NAME=]SOURCE", help=RECORDING_HELP)],
    out: Annotated[Path, typer.Option("--out", metavar="TABLE", help="Table to write, .csv or .npz.")],
    channel: Channel = "auto",
    background: Annotated[str, typer.Option("--background", metavar="whole|first:N", help=BACKGROUND_HELP)] = "whole",
    masks: Annotated[
        list[str] | None, typer.Option("--mask", metavar="[NAME=]IMAGE", help=f"{MASK_HELP} May be repeated.")
    ] = None,
    max_candidates: MaxCandidates = 4,
    tolerance_ms: Annotated[
        float | None, typer.Option("--tolerance-ms", min=0.001, help="Largest gap of stamps within one instant.")
    ] = None,
    jobs: Annotated[int | None, typer.Option("--jobs", min=1, help="Recordings read at once; all processors.")] = None,
) -> None:
    """Find the spot in the recordings of all cameras; writes a table for `calibrate`."""
    from rich.console import Console

    from nodes.camera.detect import advice_lines, detect, detected_view
    from nodes.detector_settings import DetectorSettings, named_sources, parse_background, parse_channel, with_masks
    from nodes.report.terminal import print_notes, stderr_console

    settings = DetectorSettings(
        channel=parse_channel(channel),
        n_learning=parse_background(background),
        max_candidates=max_candidates,
    )
    console = stderr_console()
    detected = detect(
        with_masks(named_sources(sources), masks or []),
        settings,
        out,
        console=console,
        n_processes=jobs,
        tolerance_ns=None if tolerance_ms is None else max(round(tolerance_ms * 1e6), 1),
    )
    print_notes(console, detected.notes)
    Console().print(detected_view(detected))
    for line in advice_lines(detected):
        console.print(f"advice: {line}", markup=False, soft_wrap=True)
    room = out.with_suffix(".toml")
    told = f"Written to {out} and {room} (image sizes; add an anchor there). Next: spotcal calibrate {out}"
    console.print(told, markup=False, soft_wrap=True)


def spot(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help=SOURCE_HELP)],
    channel: Channel = "auto",
    background: Annotated[
        str | None,
        typer.Option(
            "--background", metavar="whole|first:N", help="As of detect; of a live camera first:50 by default."
        ),
    ] = None,
    mask: Annotated[Path | None, typer.Option("--mask", metavar="IMAGE", help=MASK_HELP)] = None,
    max_candidates: MaxCandidates = 4,
    frames: Annotated[int | None, typer.Option("--frames", min=1, help="Stop after so many frames.")] = None,
    save: Annotated[
        Path | None, typer.Option("--save", metavar="FOLDER", help="Write the pictures with the spots drawn in.")
    ] = None,
) -> None:
    """Run the detector alone on one camera or recording: rate, spots and advice, live."""
    from rich.console import Console

    from nodes.camera.spot import DEFAULT_LIVE_BACKGROUND, summary_view, watch
    from nodes.detector_settings import (
        WHOLE,
        DetectorSettings,
        NamedSource,
        is_recording,
        parse_background,
        parse_channel,
    )
    from nodes.report.terminal import stderr_console

    given = background or (WHOLE if is_recording(source) else DEFAULT_LIVE_BACKGROUND)
    settings = DetectorSettings(
        channel=parse_channel(channel),
        n_learning=parse_background(given),
        max_candidates=max_candidates,
    )
    summary = watch(NamedSource(source, source, mask), settings, max_frames=frames, save=save, console=stderr_console())
    Console().print(summary_view(summary))


def cameras(
    network: Annotated[bool, typer.Option("--network", help="Ask the network too, by ONVIF; takes 3 s.")] = False,
) -> None:
    """List the cameras that are connected, and what each can do."""
    from rich.console import Console

    from nodes.camera.cameras_list import cameras_view, connected_cameras

    Console().print(cameras_view(connected_cameras(is_network_asked=network), is_network_asked=network))
