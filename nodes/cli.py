"""The command line. Commands are wiring only, and import what they need when they run: `--help` answers at once."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from network_calib.errors import SpotcalError
from nodes.commands import bus, coordinator, instruments, projection, recording, site, sources

if TYPE_CHECKING:
    from rich.console import Console

    from network_calib.formats.recording import Recording
    from network_calib.result import Calibration
    from nodes.config_model import RoomConfig

EXIT_ERROR, EXIT_UNEXPECTED_RESULT, EXIT_INTERRUPTED = 2, 1, 130

app = typer.Typer(
    name="spotcal",
    help="Calibrate networks of cameras from one waved bright spot.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command()(sources.detect)

Source = Annotated[Path, typer.Argument(help="A .csv or .npz table of spots, or a MultiCamSelfCal folder.")]
SessionSource = Annotated[
    Path, typer.Argument(help="A .csv or .npz table of spots, a MultiCamSelfCal folder, or a recorded session.")
]
CalibrationFile = Annotated[Path, typer.Argument(metavar="CALIBRATION", help="A calibration.json.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="room.toml: cameras, anchor, options.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Of all random numbers; the same seed, the same result.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]


def main() -> None:
    """Run the command line; errors that the user can act on become one message and exit status 2."""
    try:
        app()
    except SpotcalError as error:
        _print_error(error.message, error.advice)
        sys.exit(EXIT_ERROR)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _print_error(f"{place}{error.strerror or error}", "")
        sys.exit(EXIT_ERROR)
    except KeyboardInterrupt:
        _print_error("interrupted; nothing was written", "")
        sys.exit(EXIT_INTERRUPTED)


@app.command()
def calibrate(
    source: SessionSource,
    config: ConfigFile = None,
    out: Annotated[Path, typer.Option("--out", help="Result file.")] = Path("calibration.json"),
    seed: Seed = 0,
    start: Annotated[
        str | None, typer.Option("--start", metavar="auto|factorisation|anchor", help="How the solve begins.")
    ] = None,
    fix_intrinsics: Annotated[
        bool, typer.Option("--fix-intrinsics", help="Hold the given intrinsics fixed; otherwise they are a prior.")
    ] = False,
    cameras: Annotated[
        Path | None, typer.Option("--cameras", help="A calibration.json whose cameras are held: adds the LRFs to it.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Calibrate cameras from spot observations, and the LRFs of a session."""
    from network_calib.formats.calibration_json import save
    from nodes.session_solve import is_session
    from nodes.solve import check_writable

    check_writable(out)
    console = _stderr(quiet=quiet)
    if is_session(source):
        if cameras is not None or start is not None or fix_intrinsics:
            _refuse_for_session(source)
        from nodes.config import load_room
        from nodes.session_solve import solve_session

        room = None if config is None else load_room(config)
        calibration = solve_session(source, seed=seed, console=console, room=room)
    else:
        calibration = _calibrate_tables(
            source, config, cameras=cameras, seed=seed, start=start, fix_intrinsics=fix_intrinsics, console=console
        )
    save(calibration, out)
    if not quiet:
        _print_calibration(calibration)
        console.print(f"Written to {out}", markup=False, soft_wrap=True)


def _refuse_for_session(source: Path) -> None:
    from network_calib.errors import InputError

    raise InputError(
        f"{source} is a recorded session: --cameras, --start and --fix-intrinsics are not for it",
        advice="Give a room.toml by --config in place of the site's configuration in the recording.",
    )


def _calibrate_tables(
    source: Path,
    config: Path | None,
    *,
    cameras: Path | None,
    seed: int,
    start: str | None,
    fix_intrinsics: bool,
    console: Console,
) -> Calibration:
    from nodes.config import resolve
    from nodes.lrf.session import read_lrfs_beside, require_lrfs
    from nodes.report.terminal import print_notes
    from nodes.solve import solve, solve_lrfs

    room = _room(source, config, console)
    recording = _read(source, room)
    lrfs = read_lrfs_beside(source, recording, room)
    if cameras is not None:
        _refuse_camera_options(start=start, fix_intrinsics=fix_intrinsics)
        return solve_lrfs(cameras, recording, require_lrfs(lrfs, source), rejection=_rejection(room), seed=seed)
    resolved = resolve(recording, room, fix_intrinsics=fix_intrinsics, start=start)
    print_notes(console, resolved.notes)
    return solve(
        resolved, seed=seed, input_name=recording.name, input_sha256=recording.sha256, console=console, lrfs=lrfs
    )


@app.command()
def show(calibration: CalibrationFile) -> None:
    """Print a calibration as tables."""
    from network_calib.formats.calibration_json import load

    _print_calibration(load(calibration))


@app.command()
def evaluate(calibration: CalibrationFile, source: Source, config: ConfigFile = None) -> None:
    """Reproject new data with a calibration; nothing is refitted."""
    from rich.console import Console

    from network_calib.evaluate import evaluate as evaluate_spots
    from network_calib.formats.calibration_json import load
    from nodes.matching import observations_of
    from nodes.report.show import evaluation_view
    from nodes.report.terminal import print_notes

    loaded = load(calibration)
    console = _stderr()
    recording = _read(source, _room(source, config, console))
    observations, notes = observations_of(loaded, recording)
    print_notes(console, (*recording.notes, *notes))
    evaluation = evaluate_spots(loaded, observations)
    Console().print(evaluation_view(evaluation, names=[camera.name for camera in loaded.cameras]))


@app.command()
def export(
    calibration: CalibrationFile,
    format_name: Annotated[str, typer.Option("--format", metavar="svoboda|aniposelib|opencv", help="Layout.")],
    out: Annotated[Path, typer.Option("--out", help="File (svoboda: folder) to write.")],
) -> None:
    """Write a calibration for other tools."""
    from network_calib.errors import InputError
    from network_calib.formats.aniposelib import write_aniposelib
    from network_calib.formats.calibration_json import load
    from network_calib.formats.opencv import write_opencv
    from network_calib.formats.svoboda_export import write_svoboda

    writers = {"svoboda": write_svoboda, "aniposelib": write_aniposelib, "opencv": write_opencv}
    if format_name not in writers:
        raise InputError(f"--format {format_name}: expected one of {', '.join(writers)}")
    writers[format_name](load(calibration), out)
    _stderr().print(f"Written to {out}", markup=False, soft_wrap=True)


app.command()(sources.spot)
app.command()(sources.cameras)
app.command()(instruments.devices)
app.command()(instruments.emulate)
app.command()(bus.router)
app.add_typer(instruments.lrf, name="lrf")
app.command()(site.camera)
app.command()(site.init)
app.command()(coordinator.coordinator)
app.command()(recording.record)
app.command()(recording.replay)
app.command()(recording.info)
app.command()(projection.projection)
app.command()(projection.project)


@app.command()
def simulate(  # noqa: PLR0913, PLR0917 — every option of a command is an argument
    name: Annotated[str, typer.Argument(help="Name of a synthetic room; an unknown name lists them all.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write; the name of the room by default.")] = None,
    seed: Seed = 0,
    frames: Annotated[int | None, typer.Option("--frames", min=2, help="Length of the recording.")] = None,
    noise_px: Annotated[float, typer.Option("--noise-px", min=0, help="Standard deviation per axis.")] = 0.2,
    missing: Annotated[float, typer.Option("--missing", min=0, max=1, help="Share of detections dropped.")] = 0.3,
    false: Annotated[float, typer.Option("--false", min=0, max=1, help="Share of false detections.")] = 0.1,
    video: Annotated[
        str | None, typer.Option("--video", metavar="h264|ffv1|images", help="Film the room, in place of detections.")
    ] = None,
    scene: Annotated[
        str, typer.Option("--scene", metavar="clean|dark_room|bright_office|hard", help="What is filmed.")
    ] = "clean",
) -> None:
    """Write a synthetic recording with its truth: points, table.npz, room.toml, truth.json, tables of LRFs, videos."""
    from nodes.simulation.simulate import refuse_no_video_room, simulate_named

    folder = Path(name) if out is None else out
    if video is not None:
        refuse_no_video_room(name)
        from nodes.simulation.video_simulation import VideoPlan, simulate_videos

        recordings = simulate_videos(name, folder, VideoPlan(video, scene, seed, frames), console=_stderr())
        told = " ".join(map(str, recordings))
    else:
        n_detections = simulate_named(
            name, folder, seed=seed, n_frames=frames, noise_px=noise_px, missing=missing, false=false
        )
        told = f"{n_detections} detections"
    _stderr().print(f"Written to {folder}: {told}", markup=False, soft_wrap=True)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder of everything that is left.")] = Path("demo-out"),
    seed: Seed = 0,
) -> None:
    """Run a whole simulated smart room as separate processes, calibrate it, and compare with the truth."""
    from rich.console import Console

    from nodes.demo import run_demo

    if not run_demo(out, seed=seed, console=Console()):
        sys.exit(EXIT_UNEXPECTED_RESULT)


@app.command()
def paper(
    method: Annotated[str, typer.Option("--method", metavar="paper|screw|joint|all", help="What to compare.")] = "all",
    runs: Annotated[int, typer.Option("--runs", min=1, help="Simulated sessions for each number of spots.")] = 20,
    out: Annotated[Path, typer.Option("--out", help="Folder for the table and the pictures.")] = Path("paper-out"),
    seed: Seed = 0,
) -> None:
    """Regenerate Table I and figures 7 and 8 of the LRF paper from a simulation."""
    from rich.console import Console

    from nodes.report.paper_report import chosen_methods, run_report

    methods = chosen_methods(method)
    run_report(methods, out, n_runs=runs, seed=seed, console=Console(), progress_console=_stderr())


def _room(source: Path, config: Path | None, console: Console) -> RoomConfig | None:
    """The configuration that was named, or the one that `detect` wrote beside the table."""
    from nodes.config import load_room
    from nodes.report.terminal import print_notes
    from nodes.room_file import room_beside

    beside = room_beside(source) if config is None else None
    if beside is not None:
        print_notes(console, [f"cameras as described in {beside}"])
    path = config or beside
    return None if path is None else load_room(path)


def _read(source: Path, room: RoomConfig | None) -> Recording:
    from network_calib.formats.source import read_source
    from nodes.room_file import sizes_of

    if room is None:
        return read_source(source)
    return read_source(source, tolerance_ns=room.tolerance_ns, size_px=sizes_of(room))


def _refuse_camera_options(*, start: str | None, fix_intrinsics: bool) -> None:
    from network_calib.errors import InputError

    given = [
        name for name, is_given in (("--start", start is not None), ("--fix-intrinsics", fix_intrinsics)) if is_given
    ]
    if given:
        raise InputError(f"{', '.join(given)}: of no use with --cameras, which holds the cameras as they are")


def _rejection(room: RoomConfig | None) -> float:
    from network_calib.room_setup import Options

    given = None if room is None else room.options.rejection
    return Options().rejection if given is None else given


def _print_calibration(calibration: Calibration) -> None:
    from rich.console import Console

    from nodes.report.show import calibration_view

    Console().print(calibration_view(calibration))


def _stderr(*, quiet: bool = False) -> Console:
    from nodes.report.terminal import stderr_console

    return stderr_console(quiet=quiet)


def _print_error(message: str, advice: str) -> None:
    from nodes.report.terminal import print_error

    print_error(message, advice)
