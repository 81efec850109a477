"""The end of a session: solve from the recording alone, as anybody could later, and write down what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from nodes.coordinator.session_folder import SessionFolder
from nodes.room_file import write_whole

if TYPE_CHECKING:
    from network_calib.result import Calibration


@dataclass(frozen=True, slots=True)
class FinishJob:
    """What is to be finished: a session's folder with its recording, and the seed of all random draws."""

    folder: Path
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Finished:
    """What came of it.

    Attributes:
        calibration_id: first 16 hexadecimal digits of the SHA-256 of calibration.json.
        summary: one line for a person.
        notes: what could not be written.
    """

    calibration_id: str
    summary: str
    notes: tuple[str, ...] = ()


def calibration_id(json_text: bytes) -> str:
    """The name of a calibration, by its content."""
    return sha256(json_text).hexdigest()[:16]


def finish_offline(job: FinishJob) -> Finished:
    """Solve, save calibration.json and aniposelib.toml, write the report; for a process of its own.

    Raises:
        SpotcalError: the recording does not determine the answer.
        OSError: the result cannot be written.
    """
    from rich.console import Console

    from network_calib.formats.aniposelib import write_aniposelib
    from network_calib.formats.calibration_json import save
    from nodes.session_solve import solve_session

    folder = SessionFolder(job.folder)
    calibration = solve_session(job.folder, seed=job.seed, console=Console(quiet=True))
    write_whole(folder.calibration, lambda path: save(calibration, path))
    write_whole(folder.aniposelib, lambda path: write_aniposelib(calibration, path))
    notes = (*_report(folder, calibration), *_shown_in_viewers(folder))
    quality = calibration.quality
    summary = (
        f"{len(calibration.cameras)} cameras, {len(calibration.lrfs)} LRFs; {quality.n_inliers} of "
        f"{quality.n_observations} observations used, {quality.fitted.rms_px:.3f} px RMS"
    )
    return Finished(calibration_id(folder.calibration.read_bytes()), summary, notes)


def _shown_in_viewers(folder: SessionFolder) -> tuple[str, ...]:
    """The recording once more, now with the calibrated cameras for viewers of it; its rows stay as they are."""
    from network_calib.errors import SpotcalError
    from nodes.recording.merge import rewrite

    try:
        rewrite(folder.path)
    except (SpotcalError, OSError) as error:
        return (f"the calibration could not be added to the recording: {error}",)
    return ()


def _report(folder: SessionFolder, calibration: Calibration) -> tuple[str, ...]:
    """A calibration without its report is still one; so whatever goes wrong here is told, not raised."""
    try:
        from nodes.recording.session_data import read_session
        from nodes.report.session_report import write_session_report
        from nodes.session_solve import prepare
        from nodes.site.load import site_of_text

        data = read_session(folder.path)
        prepared = prepare(data, site_of_text(data.site_toml, name=str(folder.path)))
        write_session_report(folder.report, calibration, prepared.resolved.observations, notes=prepared.notes)
    except Exception as error:  # see above
        return (f"the report could not be written: {type(error).__name__}: {error}",)
    return ()
