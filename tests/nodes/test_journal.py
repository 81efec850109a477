import resource
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest

from nodes.devices.errors import DeviceError
from nodes.journal import Journal, JournalLimits, Span, Sync

EVERYTHING = {"first": 0, "last": 2**53, "max_bytes": 2**40}
# Appends one row after the other and tells each when `append` has returned.
WRITER = """
import os, sys
from pathlib import Path
from nodes.journal import Journal
journal = Journal(Path(sys.argv[1]))
journal.session = "S1"
print(journal.boot.hex(), flush=True)
while True:
    payload = journal.append("event", "k", lambda n: n.to_bytes(8, "big") + bytes(n % 5000))
    os.write(1, b"%d\\n" % int.from_bytes(payload[:8], "big"))
"""


def numbered(sequence):
    return f"row {sequence}".encode()


def sized(n_bytes):
    return lambda sequence: f"row {sequence}".encode().ljust(n_bytes, b".")


def append_many(journal, n, build=numbered):
    for _ in range(n):
        journal.append("event", "k", build)


def sequences(journal, session, boot=None):
    return [sequence for sequence, _, _ in journal.rows(session, boot or journal.boot, **EVERYTHING)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "folder" / "n1.journal"


@pytest.fixture
def full_disk():
    """Files can grow to 400 kB only, which is how a full disk looks to one program."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    @contextmanager
    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited


def test_rows_come_back_as_they_were_by_sequence(path):
    with Journal(path) as journal:
        journal.append("spots", "a/b", lambda _: b"\x00\xff")
        append_many(journal, 300)
        assert next(journal.rows("", journal.boot, **EVERYTHING)) == (0, "a/b", b"\x00\xff")
        assert list(journal.rows("", journal.boot, 298, 299, max_bytes=2**40)) == [
            (298, "k", b"row 298"),
            (299, "k", b"row 299"),
        ]
        assert sequences(journal, "") == list(range(301))
        assert sequences(journal, "", bytes(16)) == []
        assert sequences(journal, "S1") == []


def test_rows_end_when_enough_bytes_are_given_and_go_on_when_asked_again(path):
    with Journal(path) as journal:
        append_many(journal, 200, sized(100))
        given = [sequence for sequence, _, _ in journal.rows("", journal.boot, 0, 199, max_bytes=1000)]
        assert given == list(range(10))
        first = next(journal.rows("", journal.boot, 10, 199, max_bytes=1))
        assert first[0] == 10


def test_session_and_rows_outlive_the_process_and_each_boot_counts_from_zero(path):
    with Journal(path) as first:
        append_many(first, 2)
        first.session = "S1"
        append_many(first, 3)
    with Journal(path) as second:
        assert second.session == "S1"
        assert second.boot != first.boot
        append_many(second, 2)
        assert second.spans("S1") == (Span(first.boot, 2, 4, 0), Span(second.boot, 0, 1, 0))
        assert second.spans("") == (Span(first.boot, 0, 1, 0),)
        assert sequences(second, "S1", first.boot) == [2, 3, 4]
        assert (second.n_rows, second.n_dropped) == (7, 0)


def test_a_session_that_is_left_and_entered_again_has_two_spans_without_a_gap_in_either(path):
    with Journal(path) as journal:
        for session in ("S1", "S2", "S1"):
            journal.session = session
            append_many(journal, 2)
        assert journal.spans("S1") == (Span(journal.boot, 0, 1, 0), Span(journal.boot, 4, 5, 0))
        assert sequences(journal, "S1") == [0, 1, 4, 5]


@pytest.mark.parametrize("turn", range(3))
def test_a_killed_writer_loses_nothing_and_leaves_no_torn_row(path, turn):
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        boot = bytes.fromhex(writer.stdout.readline().decode())
        for _ in range(100 * (turn + 1)):
            writer.stdout.readline()
        writer.send_signal(signal.SIGKILL)
        told = [line for line in writer.stdout.read().split(b"\n") if line]
        assert writer.wait() == -signal.SIGKILL
    last_told = int(told[-1]) if told else 100 * (turn + 1) - 1
    with Journal(path) as journal:
        rows = list(journal.rows("S1", boot, **EVERYTHING))
        assert [sequence for sequence, _, _ in rows] == list(range(len(rows)))
        # The row at hand may stand there though nobody was told.
        assert len(rows) - 1 in {last_told, last_told + 1}
        assert all(payload == n.to_bytes(8, "big") + bytes(n % 5000) for n, _, payload in rows)
        assert journal.spans("S1") == (Span(boot, 0, len(rows) - 1, 0),)
        append_many(journal, 1)
        assert sequences(journal, "S1") == [0]


def test_beyond_its_size_the_oldest_rows_go_and_are_counted_by_session_and_boot(path):
    limit = 1_000_000
    with Journal(path, limits=JournalLimits(max_bytes=limit)) as journal:
        journal.session = "S1"
        append_many(journal, 500, sized(1000))
        journal.session = "S2"
        append_many(journal, 1000, sized(1000))
        (old,), (new,) = journal.spans("S1"), journal.spans("S2")
        assert (old.first, old.last, old.n_dropped) == (500, 499, 500)
        assert new.last == 1499
        assert new.n_dropped == new.first - 500 > 0
        assert journal.n_dropped == 500 + new.n_dropped
        assert journal.n_rows == 1499 - new.first + 1
        assert sequences(journal, "S2") == list(range(new.first, 1500))
        # Rows of 1000 bytes fill a page of 4096 by threes; one portion may have gone too much.
        assert journal.n_rows > limit / (4096 / 3) - 300
    # Free pages are used again: the file stays near its limit.
    assert path.stat().st_size < 1.2 * limit


def test_counts_and_spans_outlive_the_process_even_when_no_row_is_left(path):
    now_ns = [10**18]
    limits = JournalLimits(max_age_s=10.0)
    with Journal(path, limits=limits, clock_ns=lambda: now_ns[0]) as first:
        first.session = "S1"
        append_many(first, 5)
        first.session = ""
    now_ns[0] += 11 * 10**9
    with Journal(path, limits=limits, clock_ns=lambda: now_ns[0]) as second:
        append_many(second, 1)
        second.flush()
        assert second.spans("S1") == (Span(first.boot, 5, 4, 5),)
        assert (second.n_rows, second.n_dropped) == (1, 5)
    with Journal(path) as third:
        append_many(third, 2)
        assert third.spans("S1") == (Span(first.boot, 5, 4, 5),)
        assert third.spans("") == (Span(second.boot, 0, 0, 0), Span(third.boot, 0, 1, 0))


def test_age_takes_old_rows_but_none_of_the_running_session(path):
    now_ns = [10**18]
    with Journal(path, limits=JournalLimits(max_age_s=10.0), clock_ns=lambda: now_ns[0]) as journal:
        append_many(journal, 300)
        journal.session = "S1"
        append_many(journal, 3)
        # A clock without battery that is put right: decades at once.
        now_ns[0] += 10**18
        append_many(journal, 1)
        journal.flush()
        assert journal.spans("") == (Span(journal.boot, 300, 299, 300),)
        assert journal.spans("S1") == (Span(journal.boot, 300, 303, 0),)
        journal.session = "S2"
        append_many(journal, 1)
        journal.flush()
        assert journal.spans("S1") == (Span(journal.boot, 303, 303, 3),)


def test_a_full_disk_is_a_clear_error_counted_and_over_when_there_is_room(path, full_disk):
    with Journal(path) as journal:
        journal.session = "S1"
        append_many(journal, 3)
        with full_disk():
            with pytest.raises(DeviceError, match="cannot be written") as refused:
                append_many(journal, 10, sized(100_000))
            assert "Make room" in refused.value.advice
            for _ in range(2):
                with pytest.raises(DeviceError):
                    journal.append("event", "k", sized(400_000))
            before, dropped = journal.spans("S1")
            assert (before.first, before.n_dropped, dropped.n_dropped, journal.n_dropped) == (0, 0, 3, 3)
        append_many(journal, 2)
        first_after = before.last + 1 + 3
        assert journal.spans("S1") == (before, Span(journal.boot, first_after, first_after + 1, 3))
        assert journal.n_dropped == 3
        assert sequences(journal, "S1") == [*range(before.last + 1), first_after, first_after + 1]


def test_rows_refused_at_the_end_of_a_session_are_told_in_its_spans(path, full_disk):
    with Journal(path) as journal:
        journal.session = "S1"
        append_many(journal, 1)
        with full_disk(), pytest.raises(DeviceError):
            journal.append("event", "k", sized(500_000))
        journal.session = "S2"
        append_many(journal, 1)
        assert [(span.first, span.last, span.n_dropped) for span in journal.spans("S1")] == [(0, 0, 0), (2, 1, 1)]
        assert [(span.first, span.last, span.n_dropped) for span in journal.spans("S2")] == [(2, 2, 0)]


def test_a_build_that_raises_spends_no_sequence(path):
    def broken(_):
        raise ValueError("broken")

    with Journal(path) as journal:
        with pytest.raises(ValueError, match="broken"):
            journal.append("event", "k", broken)
        append_many(journal, 1)
        assert sequences(journal, "") == [0]


def test_last_of_finds_the_newest_that_is_accepted_in_the_session(path):
    with Journal(path) as journal:
        journal.append("spots", "k", lambda _: b"older session")
        journal.session = "S1"
        journal.append("spots", "k", lambda _: b"C0 first")
        append_many(journal, 200)
        journal.append("spots", "k", lambda _: b"C1 second")
        append_many(journal, 200)
        assert journal.last_of("S1", "spots") == b"C1 second"
        assert journal.last_of("S1", "spots", accepts=lambda payload: payload.startswith(b"C0")) == b"C0 first"
        assert journal.last_of("S1", "spots", accepts=lambda _: False) is None
        assert journal.last_of("S1", "imu") is None
        assert journal.last_of("S2", "spots") is None


def test_threads_append_and_read_at_once(path):
    with Journal(path, sync=Sync.EACH_ROW) as journal:
        threads = [threading.Thread(target=append_many, args=(journal, 100)) for _ in range(4)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            seen = sequences(journal, "")
            assert seen == list(range(len(seen)))
            journal.flush()
        assert sequences(journal, "") == list(range(400))


def test_a_second_holder_is_refused_and_a_closed_journal_says_so(path):
    with Journal(path) as journal:
        append_many(journal, 1)
        with pytest.raises(DeviceError, match="held by another process"):
            Journal(path)
    journal.close()
    with pytest.raises(DeviceError, match="closed"):
        append_many(journal, 1)
    with Journal(path) as again:
        assert again.n_rows == 1


@pytest.mark.parametrize("content", [b"no database" * 1000, b"SQLite format 3\x00" + b"\xff" * 5000])
def test_a_file_that_is_no_journal_is_refused_untouched(path, content):
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(DeviceError, match="cannot be opened"):
        Journal(path)
    assert path.read_bytes() == content


def test_a_folder_that_cannot_be_written_is_refused(path):
    path.parent.write_bytes(b"a file, not a folder")
    with pytest.raises(DeviceError, match="cannot be opened"):
        Journal(path)
