"""The file of a journal: SQLite, its tables, and the lock that keeps a second process out."""

from __future__ import annotations

import fcntl
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from nodes.devices.errors import DeviceError

VERSION = 1
# A checkpoint by the writer itself, should nobody call `flush`: 32 MiB of log.
CHECKPOINT_PAGES = 8192
BUSY_S = 10.0
TABLES = """
BEGIN;
CREATE TABLE IF NOT EXISTS runs (run INTEGER PRIMARY KEY, session TEXT NOT NULL, boot BLOB NOT NULL,
    first_row INTEGER NOT NULL, first_sequence INTEGER NOT NULL,
    n_trimmed INTEGER NOT NULL, n_unwritten INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS runs_of_session ON runs (session);
CREATE TABLE IF NOT EXISTS rows (row INTEGER PRIMARY KEY, run INTEGER NOT NULL, kind TEXT NOT NULL, key TEXT NOT NULL,
    payload BLOB NOT NULL, written_ns INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS state (id INTEGER PRIMARY KEY, session TEXT NOT NULL);
COMMIT;
"""
_ROWS = """
SELECT r.first_sequence + x.row - r.first_row, x.key, x.payload
FROM runs r CROSS JOIN rows x
    ON x.row >= r.first_row + max(0, :first - r.first_sequence)
    AND x.row <= r.first_row + :last - r.first_sequence
    AND x.row < coalesce((SELECT n.first_row FROM runs n WHERE n.run = r.run + 1), 1 << 62)
WHERE r.session = :session AND r.boot = :boot
ORDER BY r.run, x.row LIMIT :limit
"""
_NEWEST = """
SELECT x.row, x.payload
FROM rows x CROSS JOIN runs r ON r.run = x.run
WHERE r.session = :session AND x.kind = :kind AND x.row < :below
    AND x.row >= (SELECT min(first_row) FROM runs WHERE session = :session)
ORDER BY x.row DESC LIMIT :limit
"""


@dataclass(frozen=True, slots=True)
class JournalFile:
    """An open journal.

    Attributes:
        path: of the file.
        writer: for appends; whoever uses it holds the journal's lock.
        reader: a second connection, for replay and checkpoints, so that appends need not wait.
        lock: descriptor of the lock file.
    """

    path: Path
    writer: sqlite3.Connection
    reader: sqlite3.Connection
    lock: int

    def close(self) -> None:
        """Checkpoint, close, and let another process in."""
        self.reader.close()
        self.writer.close()
        os.close(self.lock)

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """All that is written inside, or nothing.

        Raises:
            DeviceError: it could not be written.
        """
        with self.explained("cannot be written"):
            self.writer.execute("BEGIN IMMEDIATE")
            try:
                yield self.writer
                self.writer.execute("COMMIT")
            except BaseException:
                # SQLite itself may have rolled back, as it does when the disk is full.
                if self.writer.in_transaction:
                    self.writer.execute("ROLLBACK")
                raise

    @contextmanager
    def explained(self, what: str) -> Iterator[None]:
        """SQLite's errors as the project's."""
        try:
            yield
        except sqlite3.Error as error:
            raise DeviceError(
                f"journal {self.path} {what}: {error}",
                advice="Is the disk full or read-only, or the file damaged? Make room, or move the file away.",
            ) from None

    def resume(self) -> tuple[int, str]:
        """Number of the next row, and the session that was running."""
        row = self.writer.execute("SELECT max(row) + 1 FROM rows").fetchone()[0]
        # When no row is left, numbers go on behind those that were given up.
        behind = self.writer.execute("SELECT max(first_row + n_trimmed) FROM runs").fetchone()[0]
        state = self.writer.execute("SELECT session FROM state").fetchone()
        return max(row or 1, behind or 1), state[0] if state else ""

    def used_bytes(self) -> int:
        """Size of the file without what is free in it."""
        pages, free, size = (
            self.writer.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_count", "freelist_count", "page_size")
        )
        return (pages - free) * size

    def checkpoint(self) -> None:
        """Carry the log to the disk and into the file, as far as no reader or writer is in the way."""
        with self.explained("cannot be written"):
            self.reader.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()

    def page_of_rows(
        self, session: str, boot: bytes, first: int, last: int, *, limit: int
    ) -> list[tuple[int, str, bytes]]:
        """Sequence, key and payload of rows of a session and boot, by sequence."""
        values = {"session": session, "boot": boot, "first": first, "last": last, "limit": limit}
        with self.explained("cannot be read"):
            return self.reader.execute(_ROWS, values).fetchall()

    def page_of_newest(self, session: str, kind: str, below: int, *, limit: int) -> list[tuple[int, bytes]]:
        """Number and payload of rows of a session and kind, newest first, below a number."""
        values = {"session": session, "kind": kind, "below": below, "limit": limit}
        with self.explained("cannot be read"):
            return self.reader.execute(_NEWEST, values).fetchall()


def open_journal_file(path: Path, *, synchronous: str) -> JournalFile:
    """Open or make a journal's file.

    Raises:
        DeviceError: it cannot be opened, is no journal, or another process holds it.
    """
    lock = _lock(path)
    connections: list[sqlite3.Connection] = []
    try:
        writer = _connect(path, connections)
        reader = _connect(path, connections)
        _prepare(writer, synchronous)
        version = writer.execute("PRAGMA user_version").fetchone()[0]
        if version not in {0, VERSION}:
            raise DeviceError(f"journal {path} is of version {version}; this program knows {VERSION}")
        writer.executescript(TABLES)
        writer.execute(f"PRAGMA user_version = {VERSION}")
        writer.execute("SELECT max(row) FROM rows").fetchone()
    except (sqlite3.Error, DeviceError) as error:
        for connection in connections:
            connection.close()
        os.close(lock)
        if isinstance(error, DeviceError):
            raise
        raise DeviceError(
            f"journal {path} cannot be opened: {error}",
            advice="Is the disk full, the folder read-only, the file damaged? A file that is moved away is made anew.",
        ) from None
    return JournalFile(path, writer, reader, lock)


def _connect(path: Path, connections: list[sqlite3.Connection]) -> sqlite3.Connection:
    connection = sqlite3.connect(path, BUSY_S, isolation_level=None, check_same_thread=False)
    connections.append(connection)
    return connection


def _prepare(writer: sqlite3.Connection, synchronous: str) -> None:
    writer.execute("PRAGMA journal_mode = WAL")
    writer.execute(f"PRAGMA synchronous = {synchronous}")
    writer.execute(f"PRAGMA wal_autocheckpoint = {CHECKPOINT_PAGES}")


def _lock(path: Path) -> int:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(path.with_name(path.name + ".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise DeviceError(f"journal {path} cannot be opened: {error.strerror}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise DeviceError(
            f"journal {path} is held by another process",
            advice="Does this node run already? Every node needs a journal of its own.",
        ) from None
    return lock
