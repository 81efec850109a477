"""What a disk does wrong, told to the user; and folders whose entries survive a power cut."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nodes.devices.errors import DeviceError


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Make the system's errors of a recording's disk the project's own.

    Raises:
        DeviceError: the disk is full, fails, or refuses.
    """
    try:
        yield
    except OSError as error:
        raise DeviceError(
            f"{folder}: the recording cannot be written: {error.strerror or error}",
            advice="Make room or name another folder. What was recorded so far is kept and readable.",
        ) from None


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the folder's entries."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
