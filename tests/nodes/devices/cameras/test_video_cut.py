"""Whether a file is shorter than its header says, on headers made by hand."""

import struct

import pytest

from nodes.devices.cameras.video_cut import is_cut

FTYP = struct.pack(">I4s8s", 16, b"ftyp", b"isom0000")
EBML = b"\x1a\x45\xdf\xa3\x84abcd" + b"\x18\x53\x80\x67"
WHOLE = {
    "32-bit box": FTYP + struct.pack(">I4s", 28, b"mdat") + bytes(20),
    "64-bit box": FTYP + struct.pack(">I4sQ", 1, b"mdat", 36) + bytes(20),
    "segment": EBML + b"\x94" + bytes(20),
    "segment of 8 bytes' length": EBML + b"\x01" + bytes(6) + b"\x14" + bytes(20),
    "list": struct.pack("<4sI", b"RIFF", 20) + bytes(20),
    "two lists, the first odd": struct.pack("<4sI", b"RIFF", 5)
    + bytes(6)
    + struct.pack("<4sI", b"RIFF", 20)
    + bytes(20),
}
OPEN_ENDED = {
    "box to the end": FTYP + struct.pack(">I4s", 0, b"mdat") + bytes(20),
    "live segment": EBML + b"\x01" + b"\xff" * 7 + bytes(20),
    "unfinished list": struct.pack("<4sI", b"RIFF", 0) + bytes(20),
    "transport stream": b"\x47" + bytes(187),
}


@pytest.mark.parametrize("kind", WHOLE)
def test_a_byte_less_is_cut(tmp_path, kind):
    path = tmp_path / "file"
    path.write_bytes(WHOLE[kind])
    assert not is_cut(path)
    path.write_bytes(WHOLE[kind][:-1])
    assert is_cut(path)


@pytest.mark.parametrize("kind", OPEN_ENDED)
def test_what_states_no_length_is_never_cut(tmp_path, kind):
    path = tmp_path / "file"
    for n_missing in (0, 1, 10):
        path.write_bytes(OPEN_ENDED[kind][: len(OPEN_ENDED[kind]) - n_missing])
        assert not is_cut(path)
