"""Spot observations as a columnar table, in CSV (UTF-8, one header line, commas) or NPZ.

Columns: `camera` (a name); `frame` (a whole number >= 0, equal for one instant) or `stamp_ns` (a whole number on a
common clock), or both; `x_px`, `y_px`; optionally `sigma_px` (> 0; empty in CSV, NaN in NPZ where unknown). In NPZ the
columns are arrays of one length; `camera` holds text, or indices into a further array `camera_names`.

Without `frame`, stamps are grouped (`timing.py`). A table knows no image sizes: they come from the room configuration.
"""

from __future__ import annotations

import csv
import math
import zipfile
from pathlib import Path

import numpy as np

from network_calib.errors import InputError
from network_calib.formats.csv_text import ColumnNames, csv_columns
from network_calib.formats.recording import MAX_FILE_BYTES, Recording, check_file_size, digest, natural_key
from network_calib.formats.table_columns import NUMBERS, REQUIRED, Columns, parse_column
from network_calib.observations import FloatArray, IntArray, Observations
from network_calib.timing import group_by_stamp

_COLUMNS = ColumnNames(
    REQUIRED,
    ("camera", *NUMBERS),
    f"expected {', '.join(REQUIRED)}, and frame or stamp_ns, and optionally sigma_px",
)


def read_csv(path: Path, *, tolerance_ns: int | None = None) -> Recording:
    """Read a CSV table; cameras are ordered by name, numbers inside names by value.

    Raises:
        InputError: names file, line, column, value and what was expected.
    """
    columns, rows = csv_columns(path, _COLUMNS)
    arrays = {name: parse_column(path, name, columns[name], rows) for name in columns if name != "camera"}
    names = tuple(sorted(set(columns["camera"]), key=natural_key))
    if "" in names:
        raise InputError(f"{path}, line {rows[columns['camera'].index('')]}, column camera: empty, expected a name")
    index = {name: k for k, name in enumerate(names)}
    camera = np.fromiter(map(index.__getitem__, columns["camera"]), dtype=np.int64, count=len(rows))
    return _recording(path, names, camera, arrays, tolerance_ns=tolerance_ns)


def read_npz(path: Path, *, tolerance_ns: int | None = None) -> Recording:
    """Read an NPZ table; pickled content is never loaded.

    Raises:
        InputError: no NPZ file, a column is missing, of the wrong type or length, or holds a value out of range.
    """
    arrays = _npz_arrays(path)
    names, camera = _npz_cameras(path, arrays)
    kept = {name: parse_column(path, name, arrays[name], None) for name in arrays if name in NUMBERS}
    return _recording(path, names, camera, kept, tolerance_ns=tolerance_ns)


def write_csv(observations: Observations, path: Path) -> None:
    """Write a CSV table that `read_csv` reads back exactly."""
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
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(zip(*columns, strict=True))


def write_npz(observations: Observations, path: Path) -> None:
    """Write an NPZ table that `read_npz` reads back exactly."""
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
    np.savez_compressed(path, allow_pickle=False, **columns)


def _recording(
    path: Path,
    names: tuple[str, ...],
    camera: IntArray,
    arrays: dict[str, IntArray | FloatArray],
    *,
    tolerance_ns: int | None,
) -> Recording:
    columns = Columns.of(path, arrays)
    notes: tuple[str, ...] = ()
    frame = columns.frame
    if frame is None:
        assert columns.stamp_ns is not None  # Columns.of asks for one of the two
        frame = group_by_stamp(columns.stamp_ns, camera, tolerance_ns=tolerance_ns, camera_names=names)
        notes = (f"{path.name}: {len(camera)} detections grouped by stamp into {len(np.unique(frame))} instants",)
    try:
        observations = Observations.from_columns(
            names, camera=camera, frame=frame, px=columns.px, sigma_px=columns.sigma_px, stamp_ns=columns.stamp_ns
        )
    except InputError as error:
        raise InputError(f"{path}: {error.message}", advice=error.advice) from None
    return Recording(
        path.name, observations, (), None, notes, digest(observations), is_frame_given=columns.frame is not None
    )


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
