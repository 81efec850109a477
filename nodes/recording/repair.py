"""A part that a crash cut off becomes a file that every MCAP reader takes."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode

from nodes.recording.mcap_records import MAGIC, PREFIX, whole_bytes

# End of the data without a checksum; footer without a summary; magic.
_END: Final = (
    PREFIX.pack(Opcode.DATA_END, 4)
    + struct.pack("<I", 0)
    + PREFIX.pack(Opcode.FOOTER, 20)
    + struct.pack("<QQI", 0, 0, 0)
    + MAGIC
)


def repair(path: Path) -> None:
    """Take the torn record off the end of an unchunked file, and end it as the format wants; a whole file stays.

    Raises:
        OSError: the file cannot be written. Its whole records stay whatever happens.
    """
    with path.open("r+b") as file:
        if _is_ended(path):
            return
        end = whole_bytes(path)
        file.truncate(end)
        file.seek(end)
        if end:
            file.write(_END)
        file.flush()
        os.fsync(file.fileno())


def _is_ended(path: Path) -> bool:
    """The file ends with a footer and magic. A payload may look like that: its file is then left as it is, unended."""
    tail = PREFIX.size + 20 + len(MAGIC)
    with path.open("rb") as file:
        if file.seek(0, os.SEEK_END) < tail + len(MAGIC):
            return False
        file.seek(-tail, os.SEEK_END)
        last = file.read(tail)
    return last.endswith(MAGIC) and last.startswith(PREFIX.pack(Opcode.FOOTER, 20))
