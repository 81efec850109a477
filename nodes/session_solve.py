"""A recorded session solved: what its nodes saw becomes observations, and these a calibration.

The coordinator's last step and `spotcal calibrate SESSION` are this one function of the recording alone, so that the
same recording gives the same result wherever it is solved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from lrf_stereo.lrf_priors import InstrumentSigma
from lrf_stereo.samples import LrfSpots
from lrf_stereo.session import LrfSession
from network_calib.candidates import Candidates
from network_calib.choose import CHOICE_SEED, choose
from network_calib.errors import InputError
from network_calib.formats.recording import Recording, digest
from network_calib.observations import IntArray, Observations
from network_calib.result import Calibration
from network_calib.room_setup import CameraSetup
from nodes.camera.camera_detections import CameraDetections
from nodes.camera.matching_frames import Matched, candidates_of, match_frames
from nodes.config import Resolved, resolve
from nodes.config_model import RoomConfig
from nodes.lrf.matching import TimedSightings, joined_settings, with_frames
from nodes.lrf.session import instrument_of
from nodes.recording.join_lrfs import LrfRecord, LrfSpotColumns
from nodes.recording.layout import PARTS, SESSION
from nodes.recording.session_data import SessionData, read_session
from nodes.report.terminal import print_notes
from nodes.site.load import site_of_text
from nodes.solve import solve


@dataclass(frozen=True, slots=True)
class Prepared:
    """Everything that the solve asks for.

    Attributes:
        resolved: observations, cameras, anchor, options.
        lrfs: of the session; None where it has none with crossings.
        input_name: id of the session.
        input_sha256: of the cameras' observations.
        notes: what was assumed or left out, one sentence each.
    """

    resolved: Resolved
    lrfs: LrfSession | None
    input_name: str
    input_sha256: str
    notes: tuple[str, ...]


def is_session(path: Path) -> bool:
    """Whether a path is a recorded session: its folder, or an MCAP file."""
    if path.is_dir():
        return (path / SESSION).is_file() or (path / PARTS).is_dir()
    return path.suffix.lower() == ".mcap"


def solve_session(path: Path, *, seed: int, console: Console, room: RoomConfig | None = None) -> Calibration:
    """Calibrate from a recording.

    Args:
        path: folder of a session, or its MCAP file.
        seed: of all random numbers.
        console: shows progress and notes.
        room: in place of the site's configuration that the recording holds.

    Raises:
        SpotcalError: the recording cannot be read, or does not determine the answer.
    """
    data = read_session(path)
    prepared = prepare(data, site_of_text(data.site_toml, name=str(path)) if room is None else room)
    print_notes(console, prepared.notes)
    return solve(
        prepared.resolved,
        seed=seed,
        input_name=prepared.input_name,
        input_sha256=prepared.input_sha256,
        console=console,
        lrfs=prepared.lrfs,
    )


def prepare(data: SessionData, room: RoomConfig) -> Prepared:
    """From what the nodes recorded to what the solve asks for.

    Raises:
        InputError: fewer than two cameras saw a spot, or their frames do not fit together.
    """
    seeing = _in_order([camera for camera in data.cameras if camera.n_seen], room)
    if len(seeing) < 2:
        told = ", ".join(f"{camera.name} in {camera.n_seen} of {camera.n_frames} frames" for camera in data.cameras)
        raise InputError(
            f"session {data.session}: fewer than two cameras saw a spot: {told or 'no camera sent anything'}",
            advice="Wave the spot where two cameras or more see it.",
        )
    matched = match_frames(seeing, tolerance_ns=room.tolerance_ns)
    recording = _recording(data.session, seeing, matched)
    only = _only(room, {camera.name for camera in seeing})
    resolved = resolve(recording, only)
    lrfs, lrf_notes = _lrfs(data.lrfs, room, *_located_instants(recording.observations))
    blind = [f"{camera.name}: saw no spot; left out" for camera in data.cameras if not camera.n_seen]
    notes = (*_gap_notes(data), *blind, *resolved.notes, *lrf_notes)
    return Prepared(resolved, lrfs, data.session, recording.sha256, notes)


def _gap_notes(data: SessionData) -> list[str]:
    """What the recording lacks or had refused."""
    lost: dict[str, int] = {}
    for rows in data.missing:
        lost[rows.node] = lost.get(rows.node, 0) + rows.n_rows
    notes = [f"{node}: {n} of its messages are not in the recording" for node, n in sorted(lost.items())]
    if data.refused:
        told = ", ".join(f"{reason} ({n})" for reason, n in data.refused.most_common(3))
        notes.append(f"{data.refused.total()} messages of the recording were refused: {told}")
    return notes


def _in_order(cameras: Sequence[CameraDetections], room: RoomConfig) -> list[CameraDetections]:
    """As the configuration names them, then by name: never as they happened to arrive."""
    names = [camera.name for camera in room.cameras]
    return sorted(cameras, key=lambda c: (names.index(c.name) if c.name in names else len(names), c.name))


def _only(room: RoomConfig, seeing: set[str]) -> RoomConfig:
    """The configuration without cameras that saw nothing: a dead camera does not stop the others."""
    return room.model_copy(update={"cameras": [camera for camera in room.cameras if camera.name in seeing]})


def _recording(session: str, cameras: Sequence[CameraDetections], matched: Matched) -> Recording:
    sizes = {camera.name: camera.size_px for camera in cameras}
    candidates: Candidates = candidates_of(cameras, matched)
    chosen = choose(candidates, rng=np.random.default_rng(CHOICE_SEED), size_px=sizes)
    return Recording(
        name=session,
        observations=chosen.observations,
        setups=tuple(CameraSetup(name, size) for name, size in sizes.items()),
        known_centres=None,
        notes=(*matched.notes, *chosen.notes(session)),
        sha256=digest(chosen.observations),
    )


def _located_instants(observations: Observations) -> tuple[IntArray, IntArray]:
    """(F,) numbers and (F,) stamps, growing, of the frames in which two cameras or more saw the spot.

    A frame's stamp is its earliest camera's.
    """
    seen = observations.in_frames_with_views(2)
    if seen.stamp_ns is None:
        return seen.frame[:0], seen.frame[:0]
    order = np.lexsort((seen.stamp_ns, seen.frame))
    numbers, first = np.unique(seen.frame[order], return_index=True)
    return numbers, seen.stamp_ns[order][first]


def _lrfs(
    records: Sequence[LrfRecord], room: RoomConfig, frames: IntArray, stamps_ns: IntArray
) -> tuple[LrfSession | None, tuple[str, ...]]:
    """The LRFs whose acquisition ended, their crossings joined to the cameras' frames."""
    notes = tuple(f"{r.name}: its acquisition did not end; left out" for r in records if not len(r.angle_rad))
    whole = [record for record in records if len(record.angle_rad) and len(record.spots)]
    if not whole:
        return None, notes
    if not len(frames):
        return None, (*notes, "the cameras' stamps are no clock's, so the LRFs' crossings cannot join them; left out")
    # Seconds from the first frame: a double holds those of the epoch to a quarter of a microsecond only.
    begin_ns = int(stamps_ns[0])
    stamps_s = (stamps_ns - begin_ns) / 1e9
    parts: list[LrfSpots] = []
    n_settings = 0
    for record in whole:
        sightings = _sightings(record.spots, begin_ns)
        parts.append(with_frames(sightings, frames, stamps_s, first_setting=n_settings))
        n_settings += len(record.angle_rad)
    names = tuple(record.name for record in whole)
    notes = (*notes, *(f"{record.name}: {note}" for record in whole for note in record.notes))
    known = room.model_copy(update={"lrfs": [lrf for lrf in room.lrfs if lrf.name in names]})
    instrument: tuple[InstrumentSigma, ...] = instrument_of(known, names)
    settings = joined_settings([record.angle_rad for record in whole], [record.covariance_rad2 for record in whole])
    return LrfSession(names, _joined(parts), settings, instrument), notes


def _sightings(spots: LrfSpotColumns, begin_ns: int) -> TimedSightings:
    """With their times in seconds since `begin_ns`."""
    return TimedSightings(
        time_s=(spots.stamp_ns - begin_ns) / 1e9,
        setting=spots.setting,
        range_m=spots.range_m,
        bearing_rad=spots.bearing_rad,
        sigma_range_m=spots.range_sigma_m,
        sigma_bearing_rad=spots.bearing_sigma_rad,
        sigma_out_of_plane_m=spots.out_of_plane_sigma_m,
        bias_bound_m=spots.bias_bound_m,
    )


def _joined(parts: Sequence[LrfSpots]) -> LrfSpots:
    return LrfSpots(*(np.concatenate([getattr(part, name) for part in parts]) for name in LrfSpots.__slots__))
