"""One door for every kind of recording."""

from __future__ import annotations

from pathlib import Path

from network_calib.errors import InputError
from network_calib.formats.recording import Recording
from network_calib.formats.svoboda import read_svoboda
from network_calib.formats.table import read_csv, read_npz


def read_source(path: Path, *, tolerance_ns: int | None = None) -> Recording:
    """Read a MultiCamSelfCal folder, a .csv or a .npz table.

    Args:
        path: folder or file.
        tolerance_ns: for tables without frame numbers, see `timing.group_by_stamp`.

    Raises:
        InputError: there is nothing, or nothing that is read here, at the path; or its content is at fault.
    """
    if path.is_dir():
        if not (path / "points.dat").is_file():
            raise InputError(f"{path} holds no points.dat", advice="Expected a MultiCamSelfCal folder, .csv or .npz.")
        return read_svoboda(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return read_csv(path, tolerance_ns=tolerance_ns)
    if suffix == ".npz":
        return read_npz(path, tolerance_ns=tolerance_ns)
    raise InputError(f"{path} is neither a MultiCamSelfCal folder nor a .csv or .npz table")
