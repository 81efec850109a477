"""Tables of an acquisition, `crossings.csv` with times and `tilts.csv`: what `acquire` writes and `join` reads."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.formats.csv_text import ColumnNames, csv_columns
from network_calib.formats.table_columns import integers, refuse
from network_calib.observations import FloatArray
from nodes.lrf.matching import TimedSightings
from nodes.lrf.session import SPOT_NUMBERS, TILT_FILE, TILT_NAMES, read_tilts, table_numbers
from nodes.lrf_node import Acquired

CROSSINGS = "crossings.csv"
_HEADER = ("lrf", "stamp_ns", "setting", *SPOT_NUMBERS)
_COLUMNS = ColumnNames(_HEADER, _HEADER, f"expected {', '.join(_HEADER)}")


@dataclass(frozen=True, slots=True)
class AcquiredTables:
    """What the tables of one acquisition hold.

    Attributes:
        folder: where they are.
        name: of the LRF.
        sightings: crossings, with their times on the clock of the LRF node.
        angle_rad: (T,) tilt angles.
        sigma_rad: (T,) their standard deviations.
    """

    folder: Path
    name: str
    sightings: TimedSightings
    angle_rad: FloatArray
    sigma_rad: FloatArray


def write_acquired(folder: Path, name: str, acquired: Acquired) -> None:
    """Write `crossings.csv` (with stamps; frames are joined to it later) and `tilts.csv`."""
    tilts, sightings = acquired.tilts.tilts, TimedSightings.of(acquired)
    angles = zip(np.degrees(tilts.angle_rad).tolist(), np.degrees(tilts.sigma_rad).tolist(), strict=True)
    _write(folder / TILT_FILE, TILT_NAMES, [(name, k, *row) for k, row in enumerate(angles)])
    columns = [getattr(sightings, column).tolist() for column in SPOT_NUMBERS]
    stamps = [round(1e9 * time_s) for time_s in sightings.time_s.tolist()]
    rows = zip([name] * len(sightings), stamps, sightings.setting.tolist(), *columns, strict=True)
    _write(folder / CROSSINGS, _HEADER, list(rows))


def read_acquired(folder: Path) -> AcquiredTables:
    """Read what `write_acquired` wrote.

    Raises:
        InputError: no such folder; an acquisition that was cut off; or names file, line, column and value.
    """
    path = folder / CROSSINGS
    if not path.is_file():
        raise InputError(
            f"{folder} holds no {CROSSINGS}",
            advice="Give a folder that `spotcal lrf acquire` wrote; it writes the tables when all tilts are done.",
        )
    tilts = read_tilts(folder / TILT_FILE)
    columns, lines = csv_columns(path, _COLUMNS)
    if len(tilts.names) != 1:
        raise InputError(f"{folder / TILT_FILE}: tilts of {', '.join(tilts.names)}, expected one LRF")
    name = tilts.names[0]
    refuse(path, "lrf", columns["lrf"], lines, np.array([each != name for each in columns["lrf"]]), f"{name!r}")
    stamp_ns = integers(path, "stamp_ns", columns["stamp_ns"], lines)
    label = integers(path, "setting", columns["setting"], lines)
    setting = np.array([tilts.rows.get((name, each), -1) for each in label.tolist()], dtype=np.int64)
    refuse(path, "setting", columns["setting"], lines, setting < 0, f"a setting of {TILT_FILE}")
    number = {column: table_numbers(path, column, columns[column], lines) for column in SPOT_NUMBERS}
    sightings = TimedSightings(
        1e-9 * stamp_ns.astype(np.float64), setting, **number, bias_bound_m=np.zeros(len(setting))
    )
    sigma_rad = np.sqrt(np.diag(tilts.settings.covariance_rad2))
    return AcquiredTables(folder, name, sightings, tilts.settings.angle_rad, sigma_rad)


def _write(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
