import random
import struct
from collections import Counter

import pytest
from mcap.writer import CompressionType, Writer

from network_calib.errors import InputError
from nodes.recording.layout import parts_of
from nodes.recording.reader import rows
from nodes.recording.writer import RecordingWriter


@pytest.fixture
def sent(node):
    camera = node("n0")
    return [camera.batch(2 * k) for k in range(12)]


@pytest.fixture
def part(tmp_path, sent):
    """An ended part, and for each row the byte behind it."""
    writer = RecordingWriter(tmp_path / "s", session="s1")
    for key, payload, stamp_ns in sent:
        writer.append(key, payload, log_ns=stamp_ns, publish_ns=stamp_ns)
    writer.abandon()
    path = parts_of(tmp_path / "s")[0]
    data = path.read_bytes()
    return path, [data.index(payload) + len(payload) for _, payload, _ in sent]


def payloads(path, faults=None):
    return [row.payload for row in rows(path, faults=faults)]


def test_every_cut_of_a_part_gives_every_whole_row_before_it(part, sent):
    path, ends = part
    data, expected = path.read_bytes(), [payload for _, payload, _ in sent]
    # Up to the first row stand the schemas, thousands of bytes: a stride of 31 meets every field of their records.
    first = data.index(sent[0][1]) - 40
    for cut in (*range(0, first, 31), *range(first, ends[4]), *range(ends[4], len(data) + 1, 31)):
        path.write_bytes(data[:cut])
        faults = Counter()
        assert payloads(path, faults) == expected[: sum(end <= cut for end in ends)], cut
        assert not faults


@pytest.mark.parametrize("compression", list(CompressionType))
def test_every_cut_of_a_chunked_file_gives_the_rows_of_all_whole_chunks_and_a_beginning_of_the_torn_one(
    tmp_path, sent, compression
):
    path = tmp_path / "a.mcap"
    chunk_ends = []
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=600, compression=compression)
        writer.start()
        channel = writer.register_channel(sent[0][0], "", 0)
        for k, (_, payload, stamp_ns) in enumerate(sent, start=1):
            writer.add_message(channel, stamp_ns, payload, stamp_ns)
            if k % 4 == 0:
                writer.flush()
                chunk_ends.append((file.tell(), k))
        writer.finish()
    data, expected = path.read_bytes(), [payload for _, payload, _ in sent]
    salvaged = 0
    for cut in range(8, len(data) + 1, 3):
        path.write_bytes(data[:cut])
        found = payloads(path)
        # The message index of a chunk stands between its last byte and the end that was noted.
        n_whole = max([k for end, k in chunk_ends if end <= cut], default=0)
        assert found == expected[: len(found)], cut
        assert len(found) >= n_whole
        salvaged += len(found) > n_whole
    assert salvaged


def test_a_folder_with_parts_only_reads_in_their_order_and_the_tenth_comes_last(tmp_path, sent):
    for row in sent:
        writer = RecordingWriter(tmp_path / "s")
        writer.append(row[0], row[1], log_ns=row[2], publish_ns=row[2])
        writer.abandon()
    assert len(parts_of(tmp_path / "s")) == 12
    assert payloads(tmp_path / "s") == [payload for _, payload, _ in sent]


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"something else entirely")
    with pytest.raises(InputError, match="is no MCAP file"):
        payloads(tmp_path / "a.mcap")
    with pytest.raises(InputError, match="is not there"):
        payloads(tmp_path / "none")
    with pytest.raises(InputError, match="holds no recording"):
        payloads(tmp_path)


def test_hostile_lengths_cost_nothing(part):
    path, ends = part
    data = path.read_bytes()
    huge_chunk = struct.pack("<QQQI", 0, 0, 2**60, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", 4) + b"zstd"
    for record in (
        b"\x05" + struct.pack("<Q", 2**63) + b"x",
        b"\x06" + struct.pack("<Q", len(huge_chunk)) + huge_chunk,
        b"\x05" + struct.pack("<Q", 3) + b"abc",
        b"\x04" + struct.pack("<Q", 8) + struct.pack("<HHI", 1, 1, 2**31),
        b"\x99" + struct.pack("<Q", 2) + b"??",
    ):
        path.write_bytes(data[: ends[2]] + record + data[ends[2] : ends[4]])
        assert len(payloads(path)) in {3, 5}


def test_mutated_files_never_raise_anything_but_what_is_promised(part, tmp_path, sent, recorded):
    rng = random.Random(3)
    for source in (part[0], recorded(sent, "merged") / "session.mcap"):
        data = source.read_bytes()
        for _ in range(400):
            mutated = bytearray(data)
            for _ in range(rng.randint(1, 6)):
                mutated[rng.randrange(8, len(mutated))] = rng.randrange(256)
            path = tmp_path / "mutated.mcap"
            path.write_bytes(mutated)
            assert len(payloads(path)) <= len(sent)


def test_a_chunk_whose_numbers_changed_in_silence_is_left_out(tmp_path, sent):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel(sent[0][0], "", 0)
        for _, payload, stamp_ns in sent:
            writer.add_message(channel, stamp_ns, payload, stamp_ns)
        writer.finish()
    data = bytearray(path.read_bytes())
    data[data.index(sent[3][1]) + 60] ^= 1
    path.write_bytes(data)
    faults = Counter()
    assert payloads(path, faults) == []
    assert faults == {"recording: damaged chunk": 1}
