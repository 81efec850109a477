"""One door for every kind of recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from network_calib.errors import InputError
from network_calib.formats.recording import Recording
from network_calib.formats.svoboda import read_svoboda
from network_calib.formats.table import read_csv, read_npz

# What a folder without the files of MultiCamSelfCal holds its spots in; the first that is there.
TABLES = ("table.npz", "table.csv")


def read_source(
    path: Path, *, tolerance_ns: int | None = None, size_px: Mapping[str, tuple[int, int]] | None = None
) -> Recording:
    """Read a MultiCamSelfCal folder, a .csv or a .npz table, or a folder that holds such a table.

    Args:
        path: folder or file.
        tolerance_ns: for tables without frame numbers, see `timing.group_by_stamp`.
        size_px: image sizes by camera name, where known beforehand: of use where candidates are chosen.

    Raises:
        InputError: there is nothing, or nothing that is read here, at the path; or its content is at fault.
    """
    if path.is_dir():
        if (path / "points.dat").is_file():
            return read_svoboda(path)
        table = next((path / name for name in TABLES if (path / name).is_file()), None)
        if table is None:
            raise InputError(
                f"{path} holds no points.dat", advice=f"Expected a MultiCamSelfCal folder, {' or '.join(TABLES)}."
            )
        return replace(read_source(table, tolerance_ns=tolerance_ns, size_px=size_px), name=path.name)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return read_csv(path, tolerance_ns=tolerance_ns, size_px=size_px)
    if suffix == ".npz":
        return read_npz(path, tolerance_ns=tolerance_ns, size_px=size_px)
    raise InputError(f"{path} is neither a MultiCamSelfCal folder nor a .csv or .npz table")
