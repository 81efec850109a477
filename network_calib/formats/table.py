"""Spot observations as a columnar table, in CSV (UTF-8, one header line, commas) or NPZ.

Columns: `camera` (a name); `frame` (a whole number >= 0, equal for one instant) or `stamp_ns` (a whole number on a
common clock), or both; `x_px`, `y_px`; optionally `sigma_px` (> 0; empty in CSV, NaN in NPZ where unknown) and `score`
(0..1). In NPZ the columns are arrays of one length; `camera` holds text, or indices into a further array
`camera_names`.

Without `frame`, stamps are grouped (`timing.py`). With `score` a camera may have several rows in a frame, candidates of
which one is chosen on reading (`choose.py`). A table knows no image sizes: they come from the room configuration.
"""

from __future__ import annotations

import csv
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from network_calib.candidates import Candidates
from network_calib.errors import InputError
from network_calib.formats.csv_text import ColumnNames, csv_columns
from network_calib.formats.recording import MAX_FILE_BYTES, Recording, check_file_size, digest, natural_key
from network_calib.formats.table_columns import NUMBERS, REQUIRED, Columns, parse_column
from network_calib.observations import FloatArray, IntArray, Observations
from network_calib.timing import group_by_stamp

_COLUMNS = ColumnNames(
    REQUIRED,
    ("camera", *NUMBERS),
    f"expected {', '.join(REQUIRED)}, and frame or stamp_ns, and optionally sigma_px and score",
)
Sizes = Mapping[str, tuple[int, int]]


@dataclass(frozen=True, slots=True)
class _Rows:
    """A checked table: camera names, (K,) camera indices, number columns."""

    names: tuple[str, ...]
    camera: IntArray
    columns: Columns


def read_csv(path: Path, *, tolerance_ns: int | None = None, size_px: Sizes | None = None) -> Recording:
    """Read a CSV table; cameras are ordered by name, numbers inside names by value.

    Args:
        path: file.
        tolerance_ns: for tables without frame numbers, see `timing.group_by_stamp`.
        size_px: image sizes by camera name, of use where candidates are chosen.

    Raises:
        InputError: names file, line, column, value and what was expected.
    """
    return _recording(path, _csv_rows(path), tolerance_ns=tolerance_ns, size_px=size_px)


def read_npz(path: Path, *, tolerance_ns: int | None = None, size_px: Sizes | None = None) -> Recording:
    """Read an NPZ table; pickled content is never loaded. Arguments as of `read_csv`.

    Raises:
        InputError: no NPZ file, a column is missing, of the wrong type or length, or holds a value out of range.
    """
    return _recording(path, _npz_rows(path), tolerance_ns=tolerance_ns, size_px=size_px)


def read_candidates(path: Path, *, tolerance_ns: int | None = None) -> Candidates:
    """Read a .csv or .npz table with scores, every row of it.

    Raises:
        InputError: as of `read_csv` and `read_npz`; or the table has no scores.
    """
    rows = _npz_rows(path) if path.suffix.lower() == ".npz" else _csv_rows(path)
    if rows.columns.score is None:
        raise InputError(f"{path} has no column score")
    frame, _ = _frames(path, rows, tolerance_ns=tolerance_ns)
    return _candidates(path, rows, frame, rows.columns.score)


def write_csv(observations: Observations | Candidates, path: Path) -> None:
    """Write a CSV table that `read_csv`, or of candidates `read_candidates`, reads back exactly."""
    names = np.array(observations.camera_names, dtype=object)
    columns: list[list[object]] = [names[observations.camera].tolist(), observations.frame.tolist()]
    header = ["camera", "frame"]
    if observations.stamp_ns is not None:
        header.append("stamp_ns")
        columns.append(observations.stamp_ns.tolist())
    header += ["x_px", "y_px"]
    columns += [observations.px[:, 0].tolist(), observations.px[:, 1].tolist()]
    if np.isfinite(observations.sigma_px).any():
        header.append("sigma_px")
        columns.append(["" if math.isnan(sigma) else sigma for sigma in observations.sigma_px.tolist()])
    if isinstance(observations, Candidates):
        header.append("score")
        columns.append(observations.score.tolist())
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(zip(*columns, strict=True))


def write_npz(observations: Observations | Candidates, path: Path) -> None:
    """Write an NPZ table that `read_npz`, or of candidates `read_candidates`, reads back exactly."""
    columns: dict[str, np.ndarray] = {
        "camera_names": np.array(observations.camera_names),
        "camera": observations.camera,
        "frame": observations.frame,
        "x_px": observations.px[:, 0],
        "y_px": observations.px[:, 1],
        "sigma_px": observations.sigma_px,
    }
    if observations.stamp_ns is not None:
        columns["stamp_ns"] = observations.stamp_ns
    if isinstance(observations, Candidates):
        columns["score"] = observations.score
    np.savez_compressed(path, allow_pickle=False, **columns)


def _csv_rows(path: Path) -> _Rows:
    columns, lines = csv_columns(path, _COLUMNS)
    arrays = {name: parse_column(path, name, columns[name], lines) for name in columns if name != "camera"}
    names = tuple(sorted(set(columns["camera"]), key=natural_key))
    if "" in names:
        raise InputError(f"{path}, line {lines[columns['camera'].index('')]}, column camera: empty, expected a name")
    index = {name: k for k, name in enumerate(names)}
    camera = np.fromiter(map(index.__getitem__, columns["camera"]), dtype=np.int64, count=len(lines))
    return _Rows(names, camera, Columns.of(path, arrays))


def _npz_rows(path: Path) -> _Rows:
    arrays = _npz_arrays(path)
    names, camera = _npz_cameras(path, arrays)
    numbers = {name: parse_column(path, name, arrays[name], None) for name in arrays if name in NUMBERS}
    return _Rows(names, camera, Columns.of(path, numbers))


def _recording(path: Path, rows: _Rows, *, tolerance_ns: int | None, size_px: Sizes | None) -> Recording:
    frame, notes = _frames(path, rows, tolerance_ns=tolerance_ns)
    columns = rows.columns
    if columns.score is None:
        try:
            observations = Observations.from_columns(
                rows.names,
                camera=rows.camera,
                frame=frame,
                px=columns.px,
                sigma_px=columns.sigma_px,
                stamp_ns=columns.stamp_ns,
            )
        except InputError as error:
            raise InputError(f"{path}: {error.message}", advice=error.advice) from None
    else:
        observations, told = _chosen(path, _candidates(path, rows, frame, columns.score), size_px)
        notes += told
    return Recording(
        path.name, observations, (), None, notes, digest(observations), is_frame_given=columns.frame is not None
    )


def _frames(path: Path, rows: _Rows, *, tolerance_ns: int | None) -> tuple[IntArray, tuple[str, ...]]:
    """Frame numbers (K,), given or from the stamps, and what to tell of them."""
    columns, camera = rows.columns, rows.camera
    if columns.frame is not None:
        return columns.frame, ()
    assert columns.stamp_ns is not None  # Columns.of asks for one of the two
    if columns.score is None:
        frame = group_by_stamp(columns.stamp_ns, camera, tolerance_ns=tolerance_ns, camera_names=rows.names)
    else:  # candidates of one picture share its stamp and count once
        pictures, of_row = np.unique(np.stack([camera, columns.stamp_ns]), axis=1, return_inverse=True)
        frame = group_by_stamp(pictures[1], pictures[0], tolerance_ns=tolerance_ns, camera_names=rows.names)[of_row]
    told = f"{path.name}: {len(camera)} detections grouped by stamp into {len(np.unique(frame))} instants"
    return frame, (told,)


def _candidates(path: Path, rows: _Rows, frame: IntArray, score: FloatArray) -> Candidates:
    columns = rows.columns
    try:
        return Candidates.from_columns(
            rows.names,
            camera=rows.camera,
            frame=frame,
            px=columns.px,
            score=score,
            sigma_px=columns.sigma_px,
            stamp_ns=columns.stamp_ns,
        )
    except InputError as error:
        raise InputError(f"{path}: {error.message}", advice=error.advice) from None


def _chosen(path: Path, candidates: Candidates, size_px: Sizes | None) -> tuple[Observations, tuple[str, ...]]:
    """One row of each camera and frame, and what to tell of the choice."""
    from network_calib.choose import CHOICE_SEED, choose

    chosen = choose(candidates, rng=np.random.default_rng(CHOICE_SEED), size_px=size_px)
    return chosen.observations, chosen.notes(path.name)


def _npz_arrays(path: Path) -> dict[str, np.ndarray]:
    check_file_size(path)
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(info.file_size for info in archive.infolist())
        if unpacked > MAX_FILE_BYTES:  # a small file may unpack to anything
            raise InputError(f"{path} unpacks to {unpacked} bytes, expected at most {MAX_FILE_BYTES}")
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
    except (zipfile.BadZipFile, ValueError, EOFError, OSError, KeyError, MemoryError) as error:
        raise InputError(f"{path} is no readable NPZ table: {error}") from None
    known = {"camera", "camera_names", *NUMBERS}
    unknown = sorted(set(arrays) - known)
    if unknown:
        raise InputError(f"{path}: unknown arrays {unknown}, expected some of {sorted(known)}")
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise InputError(f"{path}: arrays {', '.join(missing)} missing")
    for name, array in arrays.items():
        if array.ndim != 1:
            raise InputError(f"{path}: array {name} has shape {array.shape}, expected one dimension")
        if name != "camera_names" and len(array) != len(arrays["camera"]):
            raise InputError(
                f"{path}: array {name} has {len(array)} values, expected {len(arrays['camera'])} as in camera"
            )
    return arrays


def _npz_cameras(path: Path, arrays: dict[str, np.ndarray]) -> tuple[tuple[str, ...], IntArray]:
    camera = arrays["camera"]
    if camera.dtype.kind == "U":
        if "camera_names" in arrays:
            raise InputError(f"{path}: camera holds names, so camera_names is one too many")
        names = tuple(sorted(map(str, np.unique(camera)), key=natural_key))
        index = {name: k for k, name in enumerate(names)}
        return names, np.array([index[name] for name in camera.tolist()], dtype=np.int64)
    if camera.dtype.kind not in "iu":
        raise InputError(f"{path}: array camera is {camera.dtype}, expected text, or whole numbers with camera_names")
    if "camera_names" not in arrays or arrays["camera_names"].dtype.kind != "U":
        raise InputError(f"{path}: camera holds indices, so an array camera_names of text is expected")
    names = tuple(map(str, arrays["camera_names"]))
    if len(set(names)) != len(names):
        raise InputError(f"{path}: camera_names holds a name twice: {list(names)}")
    return names, camera.astype(np.int64)
