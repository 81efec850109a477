"""A node's journal: what it observed stands in a file before it is published, and can be asked for again.

SQLite in WAL mode. When `append` returns, the row is with the operating system: a killed process loses nothing.
`flush`, called each second, carries rows to the disk, so that a power cut takes that second at most; with
`Sync.EACH_ROW` every append waits for the disk, and it takes nothing.

Rows are numbered without a gap. A run is a stretch of rows of one session and boot whose sequences rise in step with
the numbers, so that the runs alone tell the spans; one ends where the session changes or a row could not be written.
"""

from __future__ import annotations

import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import TracebackType

from nodes.devices.errors import DeviceError
from nodes.journal_file import open_journal_file
from nodes.journal_trim import JournalLimits, trim

PAGE_ROWS = 64
TRIM_EACH_BYTES = 2**20


class Sync(StrEnum):
    """When rows reach the disk itself; SQLite's names."""

    EACH_FLUSH = "NORMAL"
    EACH_ROW = "FULL"


@dataclass(frozen=True, slots=True)
class Span:
    """Rows of one boot and session without a gap.

    Attributes:
        boot: 16 bytes.
        first: sequence of the oldest row there is.
        last: of the newest; `first - 1` when none is left.
        n_dropped: rows before `first` that were given up for want of room, or could not be written.
    """

    boot: bytes
    first: int
    last: int
    n_dropped: int


class Journal:
    """The journal in one file; for one process, and any of its threads.

    Attributes:
        boot: 16 random bytes, new for each object.
        path: of the file.

    Raises:
        DeviceError: the file cannot be opened, is no journal, or another process holds it.
    """

    def __init__(
        self,
        path: Path,
        *,
        limits: JournalLimits | None = None,
        sync: Sync = Sync.EACH_FLUSH,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.path = path
        self.boot = os.urandom(16)
        self._limits = limits or JournalLimits()
        self._clock_ns = clock_ns
        self._file = open_journal_file(path, synchronous=sync)
        # The second one is for the reading connection: replay does not hold up observations.
        self._lock, self._reader_lock = threading.Lock(), threading.Lock()
        self._next_row, self._session = self._file.resume()
        self._next_sequence = self._n_unwritten = self._n_bytes_appended = 0
        self._run: int | None = None
        self._is_open = True

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Carry all rows to the disk and let go of the file; harmless when done before."""
        with self._lock, self._reader_lock:
            if self._is_open:
                self._is_open = False
                self._file.close()

    @property
    def session(self) -> str:
        """The session that new rows belong to; empty outside of one. It outlives the process.

        Setting it raises DeviceError when that could not be written down; for this process it counts nevertheless.
        """
        return self._session

    @session.setter
    def session(self, session: str) -> None:
        with self._lock:
            if session == self._session:
                return
            left, self._session = self._session, session
            try:
                with self._file.transaction() as writer:
                    if self._n_unwritten:
                        self._begin_run(writer, left, self._next_sequence)
                    writer.execute("INSERT OR REPLACE INTO state (id, session) VALUES (0, ?)", (session,))
            finally:
                self._run, self._n_unwritten = None, 0

    @property
    def n_rows(self) -> int:
        """Rows that the journal holds, of all sessions."""
        with self._lock, self._file.explained("cannot be read"):
            first = self._file.writer.execute("SELECT min(row) FROM rows").fetchone()[0]
            return 0 if first is None else self._next_row - first

    @property
    def n_dropped(self) -> int:
        """Rows that were given up or could not be written, of all sessions."""
        with self._lock, self._file.explained("cannot be read"):
            n = self._file.writer.execute("SELECT sum(n_trimmed + n_unwritten) FROM runs").fetchone()[0]
            return (n or 0) + self._n_unwritten

    def append(self, kind: str, key: str, build: Callable[[int], bytes]) -> bytes:
        """Write a row under the next sequence of this boot; returns its payload.

        Args:
            kind: of the message, for `last_of`.
            key: it will be published under.
            build: gives the payload for a sequence; `session` does not change meanwhile.

        Raises:
            DeviceError: it could not be written. Its sequence is spent, and the row counted as dropped.
        """
        with self._lock:
            sequence = self._next_sequence
            payload = build(sequence)
            self._next_sequence += 1
            try:
                self._write(kind, key, payload, sequence)
            except DeviceError:
                self._run = None
                self._n_unwritten += 1
                raise
            self._n_bytes_appended += len(payload)
            if self._n_bytes_appended >= min(TRIM_EACH_BYTES, self._limits.max_bytes // 64):
                # The row stands; what keeps the oldest from going is told by the next `flush`.
                with suppress(DeviceError):
                    self._trim()
            return payload

    def flush(self) -> None:
        """Carry all rows to the disk and give up what is too old or too much; appends go on meanwhile.

        Raises:
            DeviceError: the disk refuses.
        """
        with self._reader_lock:
            self._file.checkpoint()
        with self._lock:
            self._trim()

    def spans(self, session: str) -> tuple[Span, ...]:
        """What there is of a session, oldest first; a boot comes again where its sequences have a gap."""
        query = """
            SELECT boot, first_sequence + n_trimmed, n_trimmed + n_unwritten,
                first_sequence - 1 - first_row + coalesce((SELECT n.first_row FROM runs n WHERE n.run = r.run + 1), ?)
            FROM runs r WHERE session = ? ORDER BY run"""
        with self._lock, self._file.explained("cannot be read"):
            found = self._file.writer.execute(query, (self._next_row, session)).fetchall()
            spans = [Span(boot, first, last, n_dropped) for boot, first, n_dropped, last in found]
            if self._n_unwritten and session == self._session:
                spans.append(Span(self.boot, self._next_sequence, self._next_sequence - 1, self._n_unwritten))
            return tuple(spans)

    def rows(
        self, session: str, boot: bytes, first: int, last: int, *, max_bytes: int
    ) -> Iterator[tuple[int, str, bytes]]:
        """Sequence, key and payload of a session's and boot's rows, by sequence; appends go on meanwhile.

        Args:
            session: its id.
            boot: 16 bytes.
            first: sequence.
            last: sequence, included.
            max_bytes: of payloads; ends with the row that reaches it. Ask again from the next one.

        Raises:
            DeviceError: the file is damaged.
        """
        n_bytes = 0
        while True:
            with self._reader_lock:
                page = self._file.page_of_rows(session, boot, first, last, limit=PAGE_ROWS)
            for sequence, key, payload in page:
                yield sequence, key, payload
                first = sequence + 1
                n_bytes += len(payload)
                if n_bytes >= max_bytes:
                    return
            if len(page) < PAGE_ROWS:
                return

    def last_of(self, session: str, kind: str, *, accepts: Callable[[bytes], bool] | None = None) -> bytes | None:
        """The newest payload of a kind, for a node that was started again within a session; None: there is none.

        Args:
            session: its id.
            kind: as given to `append`.
            accepts: which payloads count, such as those of one camera; all by default.
        """
        below = 2**62
        while True:
            with self._reader_lock:
                page = self._file.page_of_newest(session, kind, below, limit=PAGE_ROWS)
            for _, payload in page:
                if accepts is None or accepts(payload):
                    return payload
            if len(page) < PAGE_ROWS:
                return None
            below = page[-1][0]

    def _write(self, kind: str, key: str, payload: bytes, sequence: int) -> None:
        with self._file.transaction() as writer:
            run = self._begin_run(writer, self._session, sequence) if self._run is None else self._run
            values = (self._next_row, run, kind, key, payload, self._clock_ns())
            writer.execute("INSERT INTO rows VALUES (?, ?, ?, ?, ?, ?)", values)
        self._next_row += 1
        if self._run is None:
            self._run, self._n_unwritten = run, 0

    def _begin_run(self, writer: sqlite3.Connection, session: str, first_sequence: int) -> int | None:
        return writer.execute(
            "INSERT INTO runs (session, boot, first_row, first_sequence, n_trimmed, n_unwritten) "
            "VALUES (?, ?, ?, ?, 0, ?)",
            (session, self.boot, self._next_row, first_sequence, self._n_unwritten),
        ).lastrowid

    def _trim(self) -> None:
        self._n_bytes_appended = 0
        trim(self._file, self._limits, running=self._session, now_ns=self._clock_ns())
