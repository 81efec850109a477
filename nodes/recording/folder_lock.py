"""One recorder for a folder: the lock goes with the process, however it ends, and leaves no file behind."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from network_calib.errors import InputError


class FolderLock:
    """Held from the making of the object until `release`.

    Args:
        folder: that is recorded into.

    Raises:
        InputError: another recorder holds it.
    """

    def __init__(self, folder: Path) -> None:
        self._handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise InputError(
                f"another program records into {folder}", advice="Stop it, or name another folder."
            ) from None
        except OSError:
            # Some network file systems have no locks; two recorders in one folder are then nobody's to find.
            return

    def release(self) -> None:
        """Give it back; further calls do nothing."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1
