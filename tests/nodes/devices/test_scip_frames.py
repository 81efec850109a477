"""SCIP on the wire, held to documented and recorded byte vectors."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.errors import DeviceError
from nodes.devices.scip_frames import (
    MAX_REPLY_BYTES,
    Reply,
    ReplyParser,
    decode_numbers,
    decode_scan,
    decode_stamp,
    encode_blocks,
    encode_number,
    is_sum_right,
    line_sum,
)

NUMBERS = [
    (1234, 2, "CB"), (5432, 3, "1Dh"), (16000000, 4, "m2@0"), (0, 2, "00"), (1, 2, "01"), (19, 2, "0C"),
    (20, 2, "0D"), (1000, 2, "?X"), (4095, 2, "oo"), (0, 3, "000"), (1, 3, "001"), (19, 3, "00C"), (20, 3, "00D"),
    (1000, 3, "0?X"), (4095, 3, "0oo"), (5600, 3, "1GP"), (262143, 3, "ooo"), (16777215, 4, "oooo"),
]  # fmt: skip
STATUS = "00P 01Q 02R 03S 04T 05U 06V 07W 10Q 98a 99b 0Aa 0Bb 0Cc 0Dd 0Ee 0Ff 0Gg 0Hh 0Ii 0Ll 21S 50U"
PARAMETERS = [
    "VEND:Hokuyo Automatic Co.,Ltd.;[", "PROD:SOKUIKI Sensor URG-04LX;[", "FIRM:3.1.04(02/Aug./2007);a",
    "PROT:SCIP 2.0;N", "SERI:H0706400;F", "MODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N", "DMIN:20;4", "DMAX:5600;_",
    "ARES:1024;\\", "AMIN:44;7", "AMAX:725;o", "AFRT:384;6", "SCAN:600;e", "LASR:OFF;7", "LASR:ON;9",
    "SCSP:Initial(600[rpm])<-Default setting by user;A", "MESM:IDLE;:",
    "SBPS:19200[bps]<-Default setting by user;A", "TIME:001957;O", "STAT:Sensor works well.;8",
]  # fmt: skip
GD = b"GD0384038801\n00P\n0N90W\n0?X0?Y0?Z0?[000b\n\n"
GS = b"GS0384038801\n00P\n0N90W\n?X?Y?Z?[002\n\n"
MD = (
    b"MD0384040501002\n00P\n\n"
    b"MD0384040501001\n99b\n01>8G\n0?X0?Y0?Z0?[0?\\0?]0?^0?_0?`0?a0?b0?c0?d0?e0?f0?g0?h0?i0?j0?k0?l0E\n?m\\\n\n"
    b"MD0384040501000\n99b\n01?\\l\n0?X0?Y0?Z0?[0?\\0?]0?^0?_0?`0?a0?b0?c0?d0?e0?f0?g0?h0?i0?j0?k0?l0E\n?m\\\n\n"
)


@pytest.mark.parametrize(("value", "n_characters", "text"), NUMBERS)
def test_documented_numbers(value, n_characters, text):
    assert encode_number(value, n_characters) == text
    assert decode_numbers(text, n_characters).tolist() == [value]


@pytest.mark.parametrize("line", STATUS.split())
def test_documented_status_sums(line):
    assert line_sum(line[:2]) == line[2]
    assert is_sum_right(line)


@pytest.mark.parametrize("line", PARAMETERS)
def test_recorded_parameter_lines_do_not_count_the_semicolon_and_either_rule_is_taken(line):
    assert line_sum(line[:-2]) == line[-1]
    assert is_sum_right(line)
    assert is_sum_right(line[:-1] + line_sum(line[:-1]))
    assert not is_sum_right(line[:-1] + chr(ord(line[-1]) ^ 1)) or line_sum(line[:-1]) == chr(ord(line[-1]) ^ 1)


@pytest.mark.parametrize(("text", "stamp_ms"), [("01_2", 7106), ("0N90", 123456), ("01>8", 5000), ("01?\\", 5100)])
def test_recorded_stamps(text, stamp_ms):
    assert decode_stamp(text) == stamp_ms
    assert encode_number(stamp_ms, 4) == text


@pytest.mark.parametrize(("frame", "n_characters"), [(GD, 3), (GS, 2)])
def test_documented_single_scans(frame, n_characters):
    (reply,) = ReplyParser().feed(frame)
    assert reply.status == "00"
    scan = decode_scan(reply, n_characters=n_characters, n_beams=5, with_intensity=False)
    assert scan.stamp_ms == 123456
    assert scan.readings_mm.tolist() == [1000, 1001, 1002, 1003, 0]


def test_documented_stream_with_a_number_over_two_blocks():
    first, *scans = ReplyParser().feed(MD)
    assert first == Reply("MD0384040501002", "00", ())
    decoded = [decode_scan(scan, n_characters=3, n_beams=22, with_intensity=False) for scan in scans]
    assert [scan.stamp_ms for scan in decoded] == [5000, 5100]
    assert [scan.readings_mm.tolist() for scan in decoded] == [list(range(1000, 1022))] * 2
    blocks = "".join(encode_number(value, 3) for value in range(1000, 1022))
    assert encode_blocks(blocks).encode() in MD


def test_replies_of_the_first_protocol():
    replies = ReplyParser().feed(b"V\n0\nVEND:Hokuyo\n\nSCIP2.0\n0\n\n")
    assert replies == [Reply("V", "0", ("VEND:Hokuyo",)), Reply("SCIP2.0", "0", ())]


def test_distance_with_intensity_and_the_first_of_several_echoes():
    pairs = [(1000, 30), (2000, 7), (0, 0)]
    text = "".join(encode_number(number, 3) for pair in pairs for number in pair)
    reply = Reply("ME", "99", (encode_number(5, 4), text))
    scan = decode_scan(reply, n_characters=3, n_beams=3, with_intensity=True)
    assert scan.readings_mm.tolist() == [1000, 2000, 0]
    assert scan.intensity is not None
    assert scan.intensity.tolist() == [30, 7, 0]
    one, two, three = (encode_number(value, 3) for value in (1000, 2000, 3000))
    echoes = Reply("ND", "99", (encode_number(5, 4), f"{one}&{two}{two}&{three}&{one}{three}"))
    several = decode_scan(echoes, n_characters=3, n_beams=3, with_intensity=False)
    assert several.readings_mm.tolist() == [1000, 2000, 3000]


@given(
    values=st.lists(st.integers(0, 262143), min_size=1, max_size=1100), cuts=st.lists(st.integers(0, 4000), max_size=9)
)
def test_any_scan_in_any_pieces(values, cuts):
    text = "".join(encode_number(value, 3) for value in values)
    stamp = encode_number(12345, 4)
    frame = f"GD0000076800\n00P\n{stamp}{line_sum(stamp)}\n{encode_blocks(text)}\n".encode()
    edges = [0, *sorted(cut for cut in cuts if cut < len(frame)), len(frame)]
    parser = ReplyParser()
    replies = [r for a, b in pairwise(edges) for r in parser.feed(frame[a:b])]
    assert len(replies) == 1
    scan = decode_scan(replies[0], n_characters=3, n_beams=len(values), with_intensity=False)
    assert scan.readings_mm.tolist() == values
    assert parser.n_bad == 0


@given(at=st.integers(0, len(GD) - 1), bit=st.integers(0, 7))
def test_no_flipped_bit_gives_other_ranges(at, bit):
    damaged = bytearray(GD)
    damaged[at] ^= 1 << bit
    for reply in ReplyParser().feed(bytes(damaged) + b"\n\n"):
        try:
            scan = decode_scan(reply, n_characters=3, n_beams=5, with_intensity=False)
        except DeviceError:
            continue
        # The echo has no sum: it may differ, the driver compares it with what it sent.
        assert scan.readings_mm.tolist() == [1000, 1001, 1002, 1003, 0]
        assert scan.stamp_ms == 123456


@given(garbage=st.binary(max_size=300))
def test_a_reply_is_found_after_garbage_that_has_ended(garbage):
    parser = ReplyParser()
    replies = parser.feed(garbage + b"\n\n" + GD)
    assert replies[-1].echo == "GD0384038801"


@given(data=st.binary(max_size=500))
def test_any_bytes_give_replies_or_the_projects_own_error(data):
    for reply in ReplyParser().feed(data + b"\n\n"):
        try:
            scan = decode_scan(reply, n_characters=3, n_beams=5, with_intensity=False)
        except DeviceError:
            continue
        assert scan.readings_mm.max() < 1 << 18


@pytest.mark.parametrize("text", ["0?", "0?X0", "0?\x7f", "0?\x20"])
def test_data_that_are_none_are_refused(text):
    with pytest.raises(DeviceError):
        decode_numbers(text, 3)


def test_memory_is_bounded_whatever_comes():
    parser = ReplyParser()
    for _ in range(50):
        parser.feed(b"0" * 10_000)
        assert len(parser._bytes) <= MAX_REPLY_BYTES
    assert parser.n_bad > 0


def test_numbers_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="does not fit"):
        encode_number(4096, 2)
    with pytest.raises(ValueError, match="does not fit"):
        encode_number(-1, 2)
    assert np.array_equal(decode_numbers("", 3), [])
