import errno
import os
import signal
import subprocess
import sys
import threading
from collections import Counter

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from network_calib.errors import InputError
from nodes.devices.errors import DeviceError
from nodes.recording import merge as merge_module
from nodes.recording import part as part_module
from nodes.recording import writer as writer_module
from nodes.recording.layout import parts_of
from nodes.recording.reader import about, rows
from nodes.recording.writer import RecordingWriter

KEY = "spotcal/@v1/lab/node/n0/obs/spots"


def append_all(writer, sent):
    for key, payload, stamp_ns in sent:
        writer.append(key, payload, log_ns=stamp_ns + 1, publish_ns=stamp_ns)


def read(path):
    return [(row.key, row.payload, row.publish_ns) for row in rows(path)]


def sent_rows(node, n=20):
    camera = node("n0")
    return [camera.batch(2 * k) for k in range(n)]


def test_a_recording_reads_back_as_it_was_written_before_and_after_the_merge(tmp_path, node):
    sent = sent_rows(node)
    writer = RecordingWriter(tmp_path / "s", session="s1")
    writer.write_site("name = 'lab'\n")
    append_all(writer, sent)
    assert read(tmp_path / "s") == sent
    assert about(tmp_path / "s").site_toml == "name = 'lab'\n"
    path = writer.close()
    assert read(tmp_path / "s") == read(path) == sent
    assert [entry.name for entry in (tmp_path / "s").iterdir()] == ["session.mcap"]
    told = about(path)
    assert (told.session, told.site_toml, told.merged_to) == ("s1", "name = 'lab'\n", 1)
    assert told.program_version


def test_a_stock_reader_decodes_the_merged_file_by_its_own_schemas(recorded, node):
    folder = recorded(sent_rows(node), site="name = 'lab'\n")
    with (folder / "session.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = [
            (schema and schema.name, list(message.frame_sequence), record.publish_time)
            for schema, _, record, message in reader.iter_decoded_messages(topics=["spotcal/@v1/lab/node/n0/obs/spots"])
        ]
        summary = reader.get_summary()
        assert summary is not None
        assert summary.chunk_indexes[0].compression == "zstd"
        assert [one.name for one in reader.iter_attachments()] == ["site.toml"]
    assert [one[1] for one in found] == [[2 * k, 2 * k + 1] for k in range(20)]
    assert {one[0] for one in found} == {"spotcal.v1.SpotBatch"}
    assert [one[2] for one in found] == [stamp_ns for _, _, stamp_ns in sent_rows(node)]


def test_a_second_writer_continues_what_a_crash_cut_off(tmp_path, node):
    sent = sent_rows(node)
    first = RecordingWriter(tmp_path / "s")
    append_all(first, sent[:10])
    first.abandon()
    part = parts_of(tmp_path / "s")[0]
    # A torn record at the end of a part that was never ended: as a kill in the middle of a write leaves it.
    whole = part.read_bytes()
    end = whole.index(sent[9][1]) + len(sent[9][1])
    part.write_bytes(whole[:end] + b"\x05" + (500).to_bytes(8, "little") + b"torn")
    with RecordingWriter(tmp_path / "s") as second:
        assert len(parts_of(tmp_path / "s")) == 2
        with part.open("rb") as file:
            assert sum(1 for _ in make_reader(file).iter_messages()) == 10
        append_all(second, sent[10:])
    assert read(tmp_path / "s") == sent


def test_a_closed_recording_can_be_continued(tmp_path, node):
    sent = sent_rows(node)
    for part in (sent[:5], sent[5:9], sent[9:]):
        with RecordingWriter(tmp_path / "s", session="s1") as writer:
            append_all(writer, part)
    assert read(tmp_path / "s") == sent
    assert about(tmp_path / "s").merged_to == 3


def test_doubled_rows_are_dropped_by_the_merge_and_others_are_not(tmp_path, node):
    sent = sent_rows(node, 6)
    other = ("spotcal/@v1/lab/session/state", b"not a message, kept as it came", sent[0][2])
    with RecordingWriter(tmp_path / "s") as writer:
        append_all(writer, [*sent[:4], other, *sent[2:], other])
    assert read(tmp_path / "s") == [*sent[:4], other, *sent[4:], other]


@pytest.mark.parametrize("stage", ["before_rename", "after_rename", "half_removed"])
def test_a_crash_during_the_merge_loses_nothing_and_doubles_nothing(tmp_path, node, monkeypatch, stage):
    sent = sent_rows(node)
    # Rows without a number are told apart by nothing but the parts they stand in.
    state = ("spotcal/@v1/lab/session/state", b"state", sent[0][2])
    for part in (sent[:10], [state, *sent[10:]]):
        writer = RecordingWriter(tmp_path / "s")
        append_all(writer, part)
        writer.abandon()

    class Killed(BaseException):
        pass

    def kill(*_):
        raise Killed

    with monkeypatch.context() as patched:
        if stage == "before_rename":
            patched.setattr(merge_module.os, "fsync", kill)
        elif stage == "after_rename":
            patched.setattr(merge_module, "_remove_merged", kill)
        else:
            patched.setattr(merge_module, "_remove_merged", lambda folder, _: (parts_of(folder)[0].unlink(), kill()))
        with pytest.raises(Killed):
            merge_module.merge(tmp_path / "s", {"session": "", "program_version": "0"})
    expected = [*sent[:10], state, *sent[10:]]
    assert read(tmp_path / "s") == expected
    with RecordingWriter(tmp_path / "s") as again:
        append_all(again, [state])
    assert read(tmp_path / "s") == [*expected, state]


def test_two_writers_in_one_folder_are_refused(tmp_path):
    with RecordingWriter(tmp_path / "s"), pytest.raises(InputError, match="another program records into"):
        RecordingWriter(tmp_path / "s")


def test_a_closed_writer_refuses_and_closing_again_does_nothing(tmp_path, node):
    writer = RecordingWriter(tmp_path / "s")
    path = writer.close()
    assert writer.close() == path
    with pytest.raises(InputError, match="is closed"):
        append_all(writer, sent_rows(node, 1))


class FullDisk(part_module.FileIO):
    """A file on a disk with so many bytes left; the write that fills it is done in part."""

    left = 0

    def write(self, data):
        if FullDisk.left <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        done = super().write(bytes(data)[: FullDisk.left])
        FullDisk.left -= done
        return done


def test_a_full_disk_is_told_and_what_is_there_stays_readable(tmp_path, node, monkeypatch):
    sent = sent_rows(node)
    monkeypatch.setattr(part_module, "FileIO", FullDisk)
    FullDisk.left = 10**9
    writer = RecordingWriter(tmp_path / "s")
    append_all(writer, sent[:10])
    FullDisk.left = 50
    with pytest.raises(DeviceError, match="No space left on device"):
        append_all(writer, sent[10:11])
    assert read(tmp_path / "s") == sent[:10]
    with pytest.raises(DeviceError, match="No space left on device"):
        append_all(writer, sent[10:11])
    FullDisk.left = 10**9
    append_all(writer, sent[10:])
    writer.close()
    assert read(tmp_path / "s") == sent


def test_a_disk_too_full_for_the_merge_leaves_the_parts(tmp_path, node, monkeypatch):
    sent = sent_rows(node)
    writer = RecordingWriter(tmp_path / "s")
    append_all(writer, sent)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(merge_module.os, "fsync", full)
        with pytest.raises(DeviceError, match="kept and readable"):
            writer.close()
    assert read(tmp_path / "s") == sent
    RecordingWriter(tmp_path / "s").close()
    assert read(tmp_path / "s") == sent


def test_a_failing_fsync_is_told_by_the_next_append(tmp_path, node, monkeypatch):
    failed = threading.Event()

    def broken(_):
        failed.set()
        raise OSError(errno.EIO, "Input/output error")

    sent = sent_rows(node)
    writer = RecordingWriter(tmp_path / "s")
    with monkeypatch.context() as patched:
        patched.setattr(writer_module.os, "fsync", broken)
        append_all(writer, sent[:1])
        assert failed.wait(30)
        with pytest.raises(DeviceError, match="Input/output error"):
            append_all(writer, sent[1:2] * 10_000)
    writer.close()
    assert Counter(read(tmp_path / "s"))[sent[0]] == 1


WRITER = """
import sys
from pathlib import Path
from nodes.recording.writer import RecordingWriter
writer = RecordingWriter(Path(sys.argv[1]))
key = "spotcal/@v1/lab/node/n0/obs/spots"
k = int(sys.argv[2])
while True:
    writer.append(key, k.to_bytes(4, "little") * 60, log_ns=k, publish_ns=k)
    sys.stdout.write(f"{k}\\n")
    sys.stdout.flush()
    k += 1
"""


def test_nothing_is_lost_when_the_writer_is_killed_again_and_again(tmp_path):
    folder, first = tmp_path / "s", 0
    told = []
    for n_rows in (1, 7, 400):
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(folder), str(first)], stdout=subprocess.PIPE, text=True
        )
        with process:
            assert process.stdout is not None
            told += [int(process.stdout.readline()) for _ in range(n_rows)]
            os.kill(process.pid, signal.SIGKILL)
            # What it had told before the signal came counts as well.
            told += [int(line) for line in process.stdout.read().splitlines() if line]
        first = told[-1] + 1000
    found = [int.from_bytes(row.payload[:4], "little") for row in rows(folder)]
    # `append` may have returned for one more row that was not told yet, at each kill.
    assert not set(told) - set(found)
    assert len(found) == len(set(found)) <= len(told) + 3
    assert all(row.payload == row.publish_ns.to_bytes(4, "little") * 60 for row in rows(folder))
    RecordingWriter(folder).close()
    assert [int.from_bytes(row.payload[:4], "little") for row in rows(folder)] == found
