"""A recording as columns: what a calibration is made from, live or years later."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from nodes.bus import spotcal_pb2 as pb
from nodes.camera.camera_detections import CameraDetections
from nodes.recording.checked_rows import CheckedRows, MissingRows, check_rows
from nodes.recording.join_cameras import join_cameras
from nodes.recording.join_lrfs import LrfRecord, join_lrfs
from nodes.recording.reader import about, rows


@dataclass(frozen=True, slots=True)
class SessionData:
    """What a recording holds of its session; the same however its rows were ordered or doubled.

    Attributes:
        session: id.
        site_toml: text of the site's configuration; empty: none recorded.
        cameras: in the natural order of their names.
        lrfs: the same.
        n_rows: of the recording, doubled and refused ones too.
        refused: rows that were left out, by reason.
        missing: observations that nodes numbered and that are not there.
    """

    session: str
    site_toml: str
    cameras: tuple[CameraDetections, ...]
    lrfs: tuple[LrfRecord, ...]
    n_rows: int
    refused: Counter[str]
    missing: tuple[MissingRows, ...]


def read_session(path: Path) -> SessionData:
    """Read a recording, checking every row again.

    Args:
        path: a session folder or a .mcap file, whole or cut off.

    Raises:
        InputError: nothing there, or no recording.
    """
    told = about(path)
    faults = Counter[str]()
    checked = check_rows(rows(path, faults=faults), session=told.session, refused=faults)
    return session_of(checked, site_toml=told.site_toml)


def session_of(checked: CheckedRows, *, site_toml: str) -> SessionData:
    """Columns of observations that were checked."""
    refused = Counter(checked.refused)
    messages = [one.message for one in checked.observations]
    batches = [message for message in messages if isinstance(message, pb.SpotBatch)]
    of_lrfs = [
        message
        for message in messages
        if isinstance(message, pb.LrfInfo | pb.LrfSpot | pb.TiltSample | pb.TiltSettings)
    ]
    return SessionData(
        session=checked.session,
        site_toml=site_toml,
        cameras=join_cameras(batches, refused),
        lrfs=join_lrfs(of_lrfs, refused),
        n_rows=checked.n_rows,
        refused=refused,
        missing=checked.missing,
    )
