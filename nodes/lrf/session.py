"""Tables of LRFs beside the cameras' spots of a session: `lrf.csv`, what they saw, and `tilts.csv`, how they stood.

`lrf.csv`: `lrf` (a name), `frame` (that of the cameras), `setting` (a row of tilts.csv), `range_m`, `bearing_rad`,
`sigma_range_m`, `sigma_bearing_rad`, `sigma_out_of_plane_m`, and optionally (0 when left out) `out_of_plane_m`,
`bias_bound_m` (of a one-sided crossing: how far the spot may be off the plane, always to the same side) and `delay_s`
(time of the beam less that of the cameras' exposure).
`tilts.csv`: `lrf`, `setting` (a whole number, unique for its LRF), `angle_deg`, `sigma_deg` (0: trusted as it is).
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lrf_stereo.lrf_priors import InstrumentSigma
from lrf_stereo.samples import MAX_DELAY_S, LrfSpots, TiltSettings
from lrf_stereo.session import LrfSession
from network_calib.errors import InputError
from network_calib.formats.csv_text import ColumnNames, csv_columns
from network_calib.formats.recording import Recording
from network_calib.formats.table_columns import floats, integers, refuse
from network_calib.observations import FloatArray, IntArray
from nodes.config_faults import hint
from nodes.config_model import InstrumentConfig, RoomConfig

LRF_FILE, TILT_FILE = "lrf.csv", "tilts.csv"
# No scanner reaches further; a larger number is another unit.
MAX_RANGE_M = 1000.0
# A ball and a beam are centimetres wide; a larger number is another unit.
MAX_BIAS_BOUND_M = 1.0
SPOT_NUMBERS = ("range_m", "bearing_rad", "sigma_range_m", "sigma_bearing_rad", "sigma_out_of_plane_m")
_OPTIONAL_NUMBERS = ("out_of_plane_m", "bias_bound_m", "delay_s")
_SPOTS = ColumnNames(
    ("lrf", "frame", "setting", *SPOT_NUMBERS),
    ("lrf", "frame", "setting", *SPOT_NUMBERS, *_OPTIONAL_NUMBERS),
    f"expected lrf, frame, setting, {', '.join(SPOT_NUMBERS)}, and optionally {', '.join(_OPTIONAL_NUMBERS)}",
)
TILT_NAMES = ("lrf", "setting", "angle_deg", "sigma_deg")
_TILTS = ColumnNames(TILT_NAMES, TILT_NAMES, f"expected {', '.join(TILT_NAMES)}")

Limits = dict[str, tuple[float, float, str]]
_LIMITS: Limits = {
    "range_m": (0.0, MAX_RANGE_M, f"a number > 0, at most {MAX_RANGE_M:g}"),
    "bearing_rad": (-2 * np.pi, 2 * np.pi, "a number of radians within a turn"),
    "out_of_plane_m": (-MAX_RANGE_M, MAX_RANGE_M, f"a number within +-{MAX_RANGE_M:g}"),
    "sigma_range_m": (0.0, MAX_RANGE_M, "a number > 0"),
    "sigma_bearing_rad": (0.0, 2 * np.pi, "a number of radians > 0"),
    "sigma_out_of_plane_m": (0.0, MAX_RANGE_M, "a number > 0"),
    "angle_deg": (-360.0, 360.0, "a number within a turn"),
    "sigma_deg": (0.0, 90.0, "a number from 0 to 90"),
    "bias_bound_m": (0.0, MAX_BIAS_BOUND_M, f"a number from 0 to {MAX_BIAS_BOUND_M:g}"),
    "delay_s": (-MAX_DELAY_S, MAX_DELAY_S, f"a number of seconds within +-{MAX_DELAY_S:g}"),
}
_MAY_BE_LOWEST = ("sigma_deg", "bias_bound_m", "delay_s")


@dataclass(frozen=True, slots=True)
class TiltTable:
    """Rows of tilts.csv: LRF names in their order there, and the settings by name and number."""

    names: tuple[str, ...]
    rows: dict[tuple[str, int], int]
    settings: TiltSettings


def read_lrfs_beside(source: Path, recording: Recording, config: RoomConfig | None) -> LrfSession | None:
    """The LRF data of a session folder; None where it holds none, or the source is a file.

    Raises:
        InputError: as `read_lrf_session`; or the cameras' table has no frame numbers to meet those of the LRFs.
    """
    if not (source.is_dir() and (source / LRF_FILE).is_file()):
        return None
    if not recording.is_frame_given:
        raise InputError(
            f"{source}: the table of spots has stamps and no frame numbers, so {LRF_FILE} cannot refer to its frames",
            advice="Add a column frame to the table.",
        )
    return read_lrf_session(source, config)


def require_lrfs(lrfs: LrfSession | None, source: Path) -> LrfSession:
    """The session, which must be there.

    Raises:
        InputError: there is none.
    """
    if lrfs is None:
        raise InputError(
            f"{source} holds no {LRF_FILE}: there is no LRF to add to the cameras",
            advice=f"Give a session folder with {LRF_FILE} and {TILT_FILE}, or leave --cameras out.",
        )
    return lrfs


def read_lrf_session(folder: Path, config: RoomConfig | None = None) -> LrfSession:
    """Read lrf.csv and tilts.csv of a session folder.

    Settings are numbered over all LRFs, in the order of tilts.csv.

    Args:
        folder: of the session.
        config: its `[[lrfs]]` say what the instruments may be wrong by.

    Raises:
        InputError: names file, line, column, value and what was expected.
    """
    tilts = read_tilts(folder / TILT_FILE)
    path = folder / LRF_FILE
    columns, lines = csv_columns(path, _SPOTS)
    frame = integers(path, "frame", columns["frame"], lines)
    refuse(path, "frame", columns["frame"], lines, frame < 0, "0 or more")
    names = (*SPOT_NUMBERS, *(name for name in _OPTIONAL_NUMBERS if name in columns))
    number = dict.fromkeys(_OPTIONAL_NUMBERS, np.zeros(len(frame)))
    number |= {name: table_numbers(path, name, columns[name], lines) for name in names}
    spots = LrfSpots(
        frame=frame,
        setting=_settings(path, columns, lines, tilts),
        range_m=number["range_m"],
        bearing_rad=number["bearing_rad"],
        out_of_plane_m=number["out_of_plane_m"],
        sigma_range_m=number["sigma_range_m"],
        sigma_bearing_rad=number["sigma_bearing_rad"],
        sigma_out_of_plane_m=number["sigma_out_of_plane_m"],
        bias_bound_m=number["bias_bound_m"],
        delay_s=number["delay_s"],
    )
    try:
        return LrfSession(tilts.names, spots, tilts.settings, instrument_of(config, tilts.names))
    except InputError as error:
        raise InputError(f"{path}: {error.message}", advice=error.advice) from None


def write_lrf_session(session: LrfSession, folder: Path) -> None:
    """Write lrf.csv and tilts.csv, which `read_lrf_session` reads back; sigma of tilts only, no correlations.

    Optional columns are written where they hold anything but zero.
    """
    settings, spots = session.settings, session.spots
    name = np.array(session.names, dtype=object)[settings.scanner]
    label = _labels(settings.scanner)
    sigma_deg = np.degrees(np.sqrt(np.diag(settings.covariance_rad2)))
    _write(folder / TILT_FILE, TILT_NAMES, [name, label, np.degrees(settings.angle_rad), sigma_deg])
    numbers = (*SPOT_NUMBERS, *(name for name in _OPTIONAL_NUMBERS if getattr(spots, name).any()))
    columns = [name[spots.setting], spots.frame, label[spots.setting], *(getattr(spots, column) for column in numbers)]
    _write(folder / LRF_FILE, ("lrf", "frame", "setting", *numbers), columns)


def instrument_of(config: RoomConfig | None, names: tuple[str, ...]) -> tuple[InstrumentSigma, ...]:
    """What each of the instruments may be wrong by.

    Raises:
        InputError: the configuration names an LRF that the session does not have.
    """
    entries = [] if config is None else config.lrfs
    for entry in entries:
        if entry.name not in names:
            known = ", ".join(names)
            raise InputError(f"lrfs: the session has no LRF {entry.name!r}{hint(entry.name, names)}; it has {known}")
    given = {entry.name: entry.sigma for entry in entries}
    return tuple(_instrument(given.get(name, InstrumentConfig())) for name in names)


def _instrument(sigma: InstrumentConfig) -> InstrumentSigma:
    return InstrumentSigma(
        tilt_gain=sigma.tilt_gain,
        range_bias_m=sigma.range_bias_m,
        range_scale=sigma.range_scale,
        bearing_zero_rad=float(np.radians(sigma.bearing_zero_deg)),
        clock_offset_s=1e-3 * sigma.clock_offset_ms,
    )


def joint_digest(cameras_sha256: str, session: LrfSession) -> str:
    """SHA-256 over the digest of the cameras' spots and all numbers of the LRFs, little-endian 64-bit."""
    sha = hashlib.sha256("\n".join((cameras_sha256, *session.names)).encode())
    spots, settings = session.spots, session.settings
    columns = [getattr(spots, name) for name in LrfSpots.__slots__]
    for column in (*columns, settings.scanner, settings.angle_rad, settings.covariance_rad2):
        sha.update(np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("<")).tobytes())
    return sha.hexdigest()


def read_tilts(path: Path) -> TiltTable:
    """Read a tilts.csv.

    Raises:
        InputError: names file, line, column, value and what was expected.
    """
    columns, lines = csv_columns(path, _TILTS)
    label = integers(path, "setting", columns["setting"], lines)
    rows: dict[tuple[str, int], int] = {}
    for k, (name, number) in enumerate(zip(columns["lrf"], label.tolist(), strict=True)):
        if not name.strip():
            raise InputError(f"{path}, line {lines[k]}, column lrf: empty, expected a name")
        if (name, number) in rows:
            first = lines[rows[name, number]]
            raise InputError(
                f"{path}, line {lines[k]}, column setting: {number} of {name!r} stands in line {first} already"
            )
        rows[name, number] = k
    names = tuple(dict.fromkeys(columns["lrf"]))
    angle_deg = table_numbers(path, "angle_deg", columns["angle_deg"], lines)
    sigma_deg = table_numbers(path, "sigma_deg", columns["sigma_deg"], lines)
    scanner = np.array([names.index(name) for name in columns["lrf"]], dtype=np.int64)
    return TiltTable(names, rows, TiltSettings(scanner, np.radians(angle_deg), np.diag(np.radians(sigma_deg) ** 2)))


def _settings(path: Path, columns: dict[str, list[str]], lines: Sequence[int], tilts: TiltTable) -> IntArray:
    """(M,) row in tilts.csv of each sighting."""
    is_unknown = np.array([name not in tilts.names for name in columns["lrf"]])
    refuse(path, "lrf", columns["lrf"], lines, is_unknown, f"an LRF of {TILT_FILE}: {', '.join(tilts.names)}")
    label = integers(path, "setting", columns["setting"], lines)
    row = np.array([tilts.rows.get(key, -1) for key in zip(columns["lrf"], label.tolist(), strict=True)])
    refuse(path, "setting", columns["setting"], lines, row < 0, f"a setting of this LRF in {TILT_FILE}")
    return row


def table_numbers(path: Path, name: str, texts: list[str], lines: Sequence[int]) -> FloatArray:
    """Numbers within the limits of their column; most lower limits are excluded."""
    low, high, expected = _LIMITS[name]
    values = floats(path, name, texts, lines)
    is_low = values < low if name in _MAY_BE_LOWEST else values <= low
    refuse(path, name, texts, lines, is_low | ~(values <= high), expected)
    return values


def _labels(scanner: IntArray) -> IntArray:
    """(T,) number of each setting among those of its scanner."""
    return np.array([int((scanner[:k] == scanner[k]).sum()) for k in range(len(scanner))], dtype=np.int64)


def _write(path: Path, header: Sequence[str], columns: Sequence[np.ndarray]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(zip(*(column.tolist() for column in columns), strict=True))
