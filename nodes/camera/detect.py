"""`spotcal detect`: from the recordings of all cameras to a table of candidates, and a room configuration beside it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from network_calib.candidates import Candidates
from network_calib.errors import InputError
from network_calib.formats.table import write_csv, write_npz
from nodes.camera.camera_detections import CameraDetections
from nodes.camera.detect_camera import CameraJob
from nodes.camera.matching_frames import candidates_of, match_frames
from nodes.camera.parallel_cameras import detect_in_parallel, n_usable_processors
from nodes.detector_settings import DetectorSettings, NamedSource, is_recording
from nodes.devices.cameras.open_source import open_source
from nodes.devices.redaction import redact
from nodes.report.tables import plain_table, share
from nodes.room_file import TABLE_SUFFIXES, keeps, room_text, write_whole
from nodes.solve import check_writable


@dataclass(frozen=True, slots=True)
class Detected:
    """What came of a run.

    Attributes:
        recordings: one for each camera, in the order of the sources.
        notes: for the user.
    """

    recordings: tuple[CameraDetections, ...]
    notes: tuple[str, ...]


def detect(
    sources: Sequence[NamedSource],
    settings: DetectorSettings,
    out: Path,
    *,
    console: Console,
    n_processes: int | None = None,
    tolerance_ns: int | None = None,
) -> Detected:
    """Find the spot in recordings, and write the table and the room configuration, both whole or not at all.

    Args:
        sources: one recording for each camera.
        settings: of the detector.
        out: .csv or .npz; the configuration gets the same name with .toml.
        console: shows the progress.
        n_processes: recordings read at once; None for as many as there are processors.
        tolerance_ns: for matching by stamps.

    Raises:
        SpotcalError: a source cannot be read, the recordings do not fit together, or no spot was found at all.
    """
    _refuse_sources(sources, out)
    check_writable(out)
    jobs = [CameraJob(source, settings) for source in sources]
    with Bars(sources, console) as bars:
        wanted = n_usable_processors() if n_processes is None else n_processes
        recordings = detect_in_parallel(jobs, n_processes=min(wanted, len(jobs)), watch=bars.show)
    seeing = [recording for recording in recordings if recording.n_seen]
    _refuse_blind(recordings, seeing)
    matched = match_frames(seeing, tolerance_ns=tolerance_ns)
    notes = write_detected(out, candidates_of(seeing, matched), seeing)
    return Detected(tuple(recordings), (*_source_notes(recordings), *matched.notes, *notes))


def detected_view(detected: Detected) -> Table:
    """Per camera: frames, what was found, the rate of it."""
    heads = ("size", "frames", "with a spot", "candidates")
    table = plain_table("Spots", "camera", *heads)
    for r in detected.recordings:
        found = f"{r.n_seen}, {share(r.n_seen, r.n_frames)}"
        table.add_row(Text(r.name), f"{r.size_px[0]} x {r.size_px[1]}", str(r.n_frames), found, str(len(r.picture)))
    return table


def advice_lines(detected: Detected) -> list[str]:
    """What may be better about the pictures, by camera."""
    return [f"{r.name}: {text}" for r in detected.recordings for text in r.advice]


def _refuse_sources(sources: Sequence[NamedSource], out: Path) -> None:
    if out.suffix.lower() not in TABLE_SUFFIXES:
        raise InputError(f"--out {out}: expected a name that ends in {' or '.join(TABLE_SUFFIXES)}")
    if len(sources) < 2:
        raise InputError(
            f"one source is one camera ({sources[0].name}), a network needs two or more",
            advice="Name the recordings of all cameras: spotcal detect C0=first.mp4 C1=second.mp4 --out walk.csv. "
            "To look at one camera: spotcal spot.",
        )
    for source in sources:
        if not is_recording(source.text):
            raise InputError(
                f"{redact(source.text)} is no recording",
                advice="Give video files or folders of images. `spotcal spot` watches a live camera.",
            )
    for source in sources:  # before the first of them is read for minutes
        with open_source(source.text):
            pass


def _refuse_blind(recordings: Sequence[CameraDetections], seeing: Sequence[CameraDetections]) -> None:
    """Fewer than two cameras that saw a spot."""
    if len(seeing) > 1:
        return
    advice = "\n".join(f"{r.name}: {text}" for r in recordings for text in r.advice)
    if seeing:
        raise InputError(
            f"a spot was found in {seeing[0].name} alone, a network needs two cameras or more", advice=advice
        )
    listed = ", ".join(f"{recording.name} in {recording.n_frames} frames" for recording in recordings)
    raise InputError(f"no spot was found: {listed}", advice=advice)


def _source_notes(recordings: Sequence[CameraDetections]) -> list[str]:
    """What the sources say of themselves, and which cameras saw nothing."""
    notes = [f"{recording.name}: {note}" for recording in recordings for note in recording.notes]
    for recording in recordings:
        if not recording.n_seen:
            told = f"no spot was found in its {recording.n_frames} frames; it is left out of the table"
            notes.append(f"{recording.name}: {told}")
    return notes


def write_detected(out: Path, candidates: Candidates, recordings: Sequence[CameraDetections]) -> tuple[str, ...]:
    """Write the table, and the room configuration unless one that fits is there.

    Returns:
        What became of a configuration that was there before.

    Raises:
        OSError: a file cannot be written.
    """
    sizes_px = {recording.name: recording.size_px for recording in recordings}
    room = out.with_suffix(".toml")
    notes: tuple[str, ...] = ()
    if keeps(room, sizes_px):
        notes = (f"{room} describes these cameras already and stays as it is",)
    else:
        if room.is_file():
            backup = room.with_name(f"{room.name}.bak")
            shutil.copyfile(room, backup)
            notes = (f"{room} described other cameras and is now {backup}",)
        text = room_text(sizes_px, table=out.name)
        write_whole(room, lambda path: path.write_text(text, encoding="utf-8"))
    write = write_npz if out.suffix.lower() == ".npz" else write_csv
    write_whole(out, lambda path: write(candidates, path))
    return notes


class Bars:
    """A bar for each camera: two passes of equal weight, the second of known length."""

    def __init__(self, sources: Sequence[NamedSource], console: Console) -> None:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[told]}", markup=False),
            TimeElapsedColumn(),
        )
        self._progress = Progress(*columns, console=console, transient=True, disable=console.quiet)
        self._tasks: list[TaskID] = [self._progress.add_task(s.name, total=None, told="waiting") for s in sources]

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, camera: int, n_passed: tuple[int, int], *, is_done: bool) -> None:
        """As of `parallel_cameras.Watcher`."""
        first, second = n_passed
        if is_done:
            self._progress.update(self._tasks[camera], total=1, completed=1, told=f"{second} frames")
        elif second:
            total = first or None
            self._progress.update(self._tasks[camera], total=total, completed=second, told=f"{second} frames")
        elif first:
            self._progress.update(self._tasks[camera], told=f"learning the background, {first} frames")
