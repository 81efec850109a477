"""Writes a recording: nothing that `append` has returned from is lost when the process is killed."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self

from network_calib.errors import InputError
from nodes.recording.disk import sync_folder, writing
from nodes.recording.folder_lock import FolderLock
from nodes.recording.layout import PARTS, SESSION, TEMPORARY, part_number, part_path, parts_of
from nodes.recording.merge import merge
from nodes.recording.part import Part
from nodes.recording.reader import about_file
from nodes.recording.repair import repair

FSYNC_S = 1.0
# Times in a file are unsigned.
_LATEST_NS = 2**63 - 1


class RecordingWriter:
    """Records into a folder, which may hold an earlier part of the same recording: it is repaired and continued.

    Safe to use from several threads. `with` ends with `close`; where the block fails, the parts stay as they are.

    Args:
        folder: made when missing.
        session: id of the session; empty where it is not known.

    Raises:
        InputError: another program records there.
        DeviceError: nothing can be written there.
    """

    def __init__(self, folder: Path, *, session: str = "") -> None:
        self.folder = folder
        self._session = session
        self._write_lock = threading.Lock()
        self._is_dirty, self._is_ended, self._merged_to = False, False, 0
        self._fault: OSError | None = None
        with writing(folder):
            (folder / PARTS).mkdir(parents=True, exist_ok=True)
            self._lock = FolderLock(folder)
            try:
                self._tidy()
                self._part: Part | None = self._next_part()
            except BaseException:
                self._lock.release()
                raise
        self._stop = threading.Event()
        self._syncing = threading.Thread(target=self._sync_each_second, name="recording-fsync", daemon=True)
        self._syncing.start()

    def append(self, key: str, payload: bytes, *, log_ns: int, publish_ns: int) -> None:
        """Write one message; when this returns, the system has it, and within a second the disk.

        Args:
            key: it was published under.
            payload: as it arrived.
            log_ns: its arrival.
            publish_ns: its `header.stamp_ns`.

        Raises:
            DeviceError: the disk is full or fails. What was written before stays readable; a later call tries again.
            InputError: the recording is closed, or holds too many keys.
        """
        log_ns, publish_ns = (min(max(stamp_ns, 0), _LATEST_NS) for stamp_ns in (log_ns, publish_ns))
        self._write(lambda part: part.add(key, payload, log_ns=log_ns, publish_ns=publish_ns))

    def write_site(self, text: str) -> None:
        """Attach the text of the site's configuration; the last one counts.

        Raises:
            DeviceError: the disk is full or fails.
            InputError: the recording is closed.
        """
        log_ns = time.time_ns()
        self._write(lambda part: part.add_site(text, log_ns=log_ns))

    def flush(self) -> None:
        """Wait until the disk has everything.

        Raises:
            DeviceError: the disk fails.
        """
        with writing(self.folder):
            self._sync()

    def close(self) -> Path:
        """Make `session.mcap` of all parts and remove them; further calls do nothing.

        Raises:
            DeviceError: the disk is full or fails. The parts stay, and are readable; a new writer goes on.
        """
        if self._end():
            try:
                with writing(self.folder):
                    merge(self.folder, self._remarks())
            finally:
                self._lock.release()
        return self.folder / SESSION

    def abandon(self) -> None:
        """End the recording as it is, in parts; further calls do nothing."""
        self._end()
        self._lock.release()

    def _end(self) -> bool:
        with self._write_lock:
            if self._is_ended:
                return False
            self._is_ended = True
        self._stop.set()
        self._syncing.join()
        # A part without its end is whole in all its records; the next reader or writer does without.
        with suppress(OSError):
            if self._part is not None:
                self._part.finish()
        return True

    def _write(self, add: Callable[[Part], None]) -> None:
        with self._write_lock, writing(self.folder):
            if self._is_ended:
                raise InputError(f"the recording in {self.folder} is closed")
            self._add(add)

    def _add(self, add: Callable[[Part], None]) -> None:
        if self._fault is not None:
            fault, self._fault = self._fault, None
            raise fault
        if self._part is None:
            self._part = self._next_part()
        try:
            add(self._part)
        except OSError:
            self._part.close()
            self._part = None
            raise
        self._is_dirty = True

    def _tidy(self) -> None:
        """After a crash: what was merged goes, what was cut off is ended."""
        (self.folder / TEMPORARY).unlink(missing_ok=True)
        session = self.folder / SESSION
        if session.is_file():
            self._merged_to = about_file(session).merged_to
        for path in parts_of(self.folder):
            if (part_number(path) or 0) <= self._merged_to:
                path.unlink()
            else:
                repair(path)

    def _next_part(self) -> Part:
        numbers = [part_number(path) or 0 for path in parts_of(self.folder)]
        path = part_path(self.folder, max([self._merged_to, *numbers]) + 1)
        part = Part(path, self._remarks())
        sync_folder(path.parent)
        return part

    def _remarks(self) -> dict[str, str]:
        return {"session": self._session, "program_version": version("spotcal")}

    def _sync_each_second(self) -> None:
        while not self._stop.wait(FSYNC_S):
            try:
                self._sync()
            except OSError as error:
                self._fault = error

    def _sync(self) -> None:
        with self._write_lock:
            if not self._is_dirty or self._part is None:
                return
            self._is_dirty = False
            handle = self._part.duplicate_handle()
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self.abandon()
