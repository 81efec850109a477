"""`spotcal lrf join`: crossings of acquisitions put into a session folder, beside what its cameras saw meanwhile.

A crossing has a time, a session counts frames: each crossing gets the nearest frame in which two cameras saw the spot,
and what is left of the time as its delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lrf_stereo.calibrate import MIN_SIGHTINGS
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.session import LrfSession
from network_calib.errors import InputError
from network_calib.formats.source import read_source
from network_calib.observations import FloatArray, IntArray
from nodes.lrf.acquired_tables import AcquiredTables, read_acquired
from nodes.lrf.matching import with_frames
from nodes.lrf.session import LRF_FILE, TILT_FILE, write_lrf_session

S_NS = 1e-9


@dataclass(frozen=True, slots=True)
class Joined:
    """What was written, for each tilt setting.

    Attributes:
        session: the LRFs' part.
        n_acquired: (T,) crossings that were acquired.
        n_joined: (T,) of them, in frames that two cameras or more saw the spot in.
    """

    session: LrfSession
    n_acquired: IntArray
    n_joined: IntArray

    def lines(self) -> list[str]:
        """For a person: a line for each tilt."""
        settings, names = self.session.settings, self.session.names
        return [
            f"{names[settings.scanner[k]]} at {np.degrees(settings.angle_rad[k]):.2f} deg: {self.n_joined[k]} of "
            f"{self.n_acquired[k]} crossings in frames of two cameras or more"
            for k in range(len(settings.angle_rad))
        ]


@dataclass(frozen=True, slots=True)
class _Frames:
    """Frames in which two cameras or more saw the spot: (F,) numbers, and (F,) times that grow."""

    number: IntArray
    stamp_s: FloatArray


def join(acquisitions: Sequence[Path], session: Path) -> Joined:
    """Write `lrf.csv` and `tilts.csv` into a session folder.

    Args:
        acquisitions: folders that `spotcal lrf acquire` wrote, one for each LRF.
        session: folder with the cameras' spots, with frame numbers and stamps.

    Raises:
        InputError: a file is missing or wrong; two LRFs of one name; the session holds LRFs already; no time in common;
            or fewer crossings at a tilt than a calibration needs.
    """
    for name in (LRF_FILE, TILT_FILE):
        if (session / name).exists():
            raise InputError(
                f"{session} holds {name} already", advice="Move it away, or name all acquisitions in one command."
            )
    tables = [read_acquired(folder) for folder in acquisitions]
    frames = _frames(session)
    parts, n_before = [], 0
    for table in tables:
        parts.append(_joined(table, frames, session, first_setting=n_before))
        n_before += len(table.angle_rad)
    settings = _settings(tables)
    n_acquired = np.concatenate([np.bincount(t.sightings.setting, minlength=len(t.angle_rad)) for t in tables])
    spots = _concatenated(parts)
    n_joined = np.bincount(spots.setting, minlength=n_before)
    _refuse_few(tables, settings, n_acquired, n_joined)
    joined = LrfSession(tuple(table.name for table in tables), spots, settings)
    write_lrf_session(joined, session)
    return Joined(joined, n_acquired, n_joined)


def _frames(session: Path) -> _Frames:
    if not session.is_dir():
        raise InputError(f"{session}: no such folder", advice="Give the folder that holds the cameras' table.csv.")
    recording = read_source(session)
    observations = recording.observations
    if observations.stamp_ns is None:
        raise InputError(
            f"{session}: the cameras' table has no column stamp_ns, so nothing tells when its frames were taken",
            advice="Record cameras with stamps: crossings and frames are joined by time.",
        )
    if not recording.is_frame_given:
        raise InputError(
            f"{session}: the cameras' table has stamps and no frame numbers, so {LRF_FILE} cannot refer to its frames",
            advice="Add a column frame to the table.",
        )
    number, of_row, n_views = np.unique(observations.frame, return_inverse=True, return_counts=True)
    stamp_s = np.asarray(np.bincount(of_row, S_NS * observations.stamp_ns) / n_views, dtype=np.float64)
    is_seen = n_views >= 2
    if is_seen.sum() < 2:
        raise InputError(f"{session}: two cameras see the spot together in {int(is_seen.sum())} frames: too few")
    number, stamp_s = number[is_seen], stamp_s[is_seen]
    order = np.argsort(stamp_s, kind="stable")
    return _Frames(number[order], stamp_s[order])


def _joined(table: AcquiredTables, frames: _Frames, session: Path, *, first_setting: int) -> LrfSpots:
    time_s, stamp_s = table.sightings.time_s, frames.stamp_s
    if time_s.max() < stamp_s[0] or time_s.min() > stamp_s[-1]:
        raise InputError(
            f"no common time: the crossings of {table.folder} are from {_span(time_s)}, the frames in which two "
            f"cameras of {session} see the spot from {_span(stamp_s)}",
            advice="Give recordings of one and the same session. If they are, a clock was wrong: the LRF node's or the "
            "cameras'.",
        )
    return with_frames(table.sightings, frames.number, stamp_s, first_setting=first_setting)


def _span(time_s: FloatArray) -> str:
    begin, end = (datetime.fromtimestamp(float(t), UTC) for t in (time_s.min(), time_s.max()))
    return f"{begin:%Y-%m-%d %H:%M:%S} to {end:%Y-%m-%d %H:%M:%S} UTC"


def _settings(tables: Sequence[AcquiredTables]) -> TiltSettings:
    sigma = np.concatenate([table.sigma_rad for table in tables])
    return TiltSettings(
        scanner=np.repeat(np.arange(len(tables)), [len(table.angle_rad) for table in tables]),
        angle_rad=np.concatenate([table.angle_rad for table in tables]),
        covariance_rad2=np.diag(sigma**2),
    )


def _refuse_few(
    tables: Sequence[AcquiredTables], settings: TiltSettings, n_acquired: IntArray, n_joined: IntArray
) -> None:
    poor = np.flatnonzero(n_joined < MIN_SIGHTINGS)
    if not len(poor):
        return
    listed = ", ".join(
        f"{tables[settings.scanner[k]].name} at {np.degrees(settings.angle_rad[k]):.1f} deg {n_joined[k]} of "
        f"{n_acquired[k]}"
        for k in poor
    )
    raise InputError(
        f"too few crossings in frames in which two cameras saw the spot: {listed}; {MIN_SIGHTINGS} or more are needed "
        "at each tilt",
        advice="Raise and lower the spot where two cameras see it, and let the cameras record all the while.",
    )


def _concatenated(parts: Sequence[LrfSpots]) -> LrfSpots:
    return LrfSpots(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in LrfSpots.__slots__})
