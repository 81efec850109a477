"""How much a journal may hold, and which rows go first."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass

from nodes.journal_file import JournalFile

# Rows are given up in such portions: short transactions, so that no observation waits long for them.
PORTION_ROWS = 256


@dataclass(frozen=True, slots=True)
class JournalLimits:
    """What a journal may hold; beyond it the oldest rows go.

    Attributes:
        max_bytes: of rows on disk, without the write-ahead log, which is 32 MiB at most.
        max_age_s: older rows go, unless they are of the session that is running.
    """

    max_bytes: int = 2 * 2**30
    max_age_s: float = 14 * 86400


def trim(file: JournalFile, limits: JournalLimits, *, running: str, now_ns: int) -> None:
    """Give up the oldest rows, as far as the limits demand; the newest one stays.

    Args:
        file: whose writer is the caller's.
        limits: to be kept.
        running: session whose rows no age takes; empty outside of one.
        now_ns: on the clock of the rows.

    Raises:
        DeviceError: the disk refuses.
    """
    with file.explained("cannot be read"):
        cut = _cut(file, limits, running, now_ns)
    while cut is not None:
        with file.transaction() as writer:
            counts = writer.execute("SELECT count(*), run FROM rows WHERE row < ? GROUP BY run", (cut,)).fetchall()
            writer.executemany("UPDATE runs SET n_trimmed = n_trimmed + ? WHERE run = ?", counts)
            writer.execute("DELETE FROM rows WHERE row < ?", (cut,))
            cut = _cut(file, limits, running, now_ns)


def _cut(file: JournalFile, limits: JournalLimits, running: str, now_ns: int) -> int | None:
    """The first row of those that stay, one portion on; None when all may stay."""
    query = "SELECT row, written_ns FROM rows ORDER BY row LIMIT ?"
    oldest = file.writer.execute(query, (PORTION_ROWS + 1,)).fetchall()
    if len(oldest) < 2:
        return None
    if file.used_bytes() > limits.max_bytes:
        return oldest[-1][0]
    too_old_ns = now_ns - round(limits.max_age_s * 1e9)
    cut = next((row for row, written_ns in oldest if written_ns >= too_old_ns), oldest[-1][0])
    # A clock that is put right may jump by years: age never takes what was just measured.
    held = _first_row(file.writer, running) if running else None
    cut = cut if held is None else min(cut, held)
    return cut if cut > oldest[0][0] else None


def _first_row(writer: sqlite3.Connection, session: str) -> int | None:
    return writer.execute("SELECT min(first_row) FROM runs WHERE session = ?", (session,)).fetchone()[0]
