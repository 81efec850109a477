"""One part of a recording while it is written: every record is with the system when the call returns."""

from __future__ import annotations

import os
from io import FileIO
from pathlib import Path
from typing import IO, Any, cast

from mcap.writer import IndexType, Writer

from nodes.recording.layout import METADATA, SITE_NAME, SITE_TYPE
from nodes.recording.schemas import Channels


class Part:
    """An unchunked MCAP file that is written record by record.

    After an error the file is as it was before the call, and takes nothing more: its channels may not be those that the
    writer believes. The next part does.

    Args:
        path: of the file, which must not exist.
        remarks: of the recording, as metadata.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, path: Path, remarks: dict[str, str]) -> None:
        self.path = path
        self._file = _WholeWrites(path)
        self._writer = Writer(cast(IO[Any], self._file), use_chunking=False, index_types=IndexType.NONE)
        try:
            self._writer.start(profile="", library="spotcal")
            self._writer.add_metadata(METADATA, remarks)
        except OSError:
            self._file.close()
            path.unlink(missing_ok=True)
            raise
        self._channels = Channels(self._writer)

    def add(self, key: str, payload: bytes, *, log_ns: int, publish_ns: int) -> None:
        """Write one message.

        Raises:
            OSError: it could not be written; what was there before still is.
        """
        channel = self._channels.of_key(key)
        self._writer.add_message(channel, log_time=log_ns, data=payload, publish_time=publish_ns)

    def add_site(self, text: str, *, log_ns: int) -> None:
        """Attach the site's configuration.

        Raises:
            OSError: it could not be written; what was there before still is.
        """
        self._writer.add_attachment(log_ns, log_ns, SITE_NAME, SITE_TYPE, text.encode())

    def duplicate_handle(self) -> int:
        """A file descriptor of its own, to be closed by the caller: for fsync beside the writing."""
        return os.dup(self._file.fileno())

    def finish(self) -> None:
        """Write the end, so that every reader takes the file, and close it.

        Raises:
            OSError: the end could not be written; the file is closed all the same, and its records are whole.
        """
        try:
            self._writer.finish()
            os.fsync(self._file.fileno())
        finally:
            self.close()

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()


class _WholeWrites:
    """A file in which each write is whole or has not happened: a disk that fills up leaves no torn record behind."""

    def __init__(self, path: Path) -> None:
        self._raw = FileIO(path, "x")
        self._end = 0

    def write(self, data: bytes) -> int:
        view, done = memoryview(data), 0
        try:
            while done < len(view):
                done += self._raw.write(view[done:]) or 0
        except OSError:
            if done:
                self._raw.truncate(self._end)
                self._raw.seek(self._end)
            raise
        self._end += done
        return done

    def tell(self) -> int:
        return self._end

    def flush(self) -> None:
        """Nothing is held back."""

    def fileno(self) -> int:
        return self._raw.fileno()

    def close(self) -> None:
        self._raw.close()
