import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.cameras.h264_gaps import FrameNumbers
from tests.nodes.devices.coded_video import coded

N_FRAMES, GOP = 40, 20
# Parameter sets of every shape: high profile with 8x8 transform, 4:4:4, B pictures that none refers to, weighting.
OPTIONS = {
    "baseline": {"profile": "baseline"},
    "high": {"profile": "high", "x264-params": "8x8dct=1:cqm=jvt"},
    "bframes": {"tune": "psnr", "bf": "2", "x264-params": "b-pyramid=none:rc-lookahead=4:sync-lookahead=0:threads=1"},
}


@pytest.fixture(scope="module", params=OPTIONS)
def packets(request):
    return coded("libx264", N_FRAMES, gop=GOP, options=OPTIONS[request.param])


def is_key(packet):
    return any(unit[:1] and unit[0] & 0x1F == 5 for unit in packet.split(b"\0\0\1"))


def is_referred_to(packet):
    return any(unit[:1] and unit[0] & 0x1F in (1, 5) and unit[0] & 0x60 for unit in packet.split(b"\0\0\1"))


def gaps(packets):
    numbers = FrameNumbers()
    return [numbers.is_gap_before(packet) for packet in packets]


def test_a_whole_stream_has_no_gap(packets):
    assert sum(map(is_key, packets)) >= 2
    assert not any(gaps(packets))


def test_each_lost_picture_that_others_refer_to_is_seen_at_the_next(packets):
    lost = [k for k in range(1, len(packets) - 1) if is_referred_to(packets[k]) and not is_key(packets[k + 1])]
    lost = [k for k in lost if not is_key(packets[k])]
    assert len(lost) > 10
    for k in lost:
        expected = [j == k for j in range(len(packets) - 1)]
        assert gaps(packets[:k] + packets[k + 1 :]) == expected


def test_a_lost_picture_that_none_refers_to_is_no_gap(packets):
    for k, packet in enumerate(packets):
        if not is_referred_to(packet):
            assert not any(gaps(packets[:k] + packets[k + 1 :]))


def test_parameter_sets_may_come_apart_from_the_stream(packets):
    first = packets[0].split(b"\0\0\1")
    sets = b"".join(b"\0\0\1" + unit for unit in first[1:] if unit[0] & 0x1F in (7, 8))
    bare = [b"".join(b"\0\0\1" + unit for unit in first[1:] if unit[0] & 0x1F not in (7, 8)), *packets[1:GOP]]
    numbers = FrameNumbers(sets)
    assert [numbers.is_gap_before(packet) for packet in bare[:5] + bare[6:]].count(True) == is_referred_to(bare[5])


def sets(*, is_gap_allowed):
    """A parameter set of the baseline profile: identifier 0, numbers of 4 bits, order type 2, one reference."""
    fields = "1" + "1" + "011" + "010" + str(int(is_gap_allowed)) + "1000000"
    return bytes([0, 0, 1, 0x67, 66, 0, 30]) + int(fields, 2).to_bytes(2, "big")


def slice_of(number):
    """Of a picture that others refer to: first macroblock 0, type 0, parameters 0, then its number."""
    return bytes([0, 0, 1, 0x41]) + int(f"111{number:04b}1", 2).to_bytes(1, "big") + bytes(20)


@pytest.mark.parametrize("is_gap_allowed", [True, False])
def test_gaps_that_the_stream_announces_are_none(is_gap_allowed):
    numbers = FrameNumbers(sets(is_gap_allowed=is_gap_allowed))
    judged = [numbers.is_gap_before(slice_of(number)) for number in (13, 14, 15, 0, 1, 3, 4)]
    assert judged == [False] * 5 + [not is_gap_allowed, False]


@given(st.binary(max_size=200), st.integers(0, 2**32 - 1))
def test_hostile_bytes_end_in_an_answer(data, seed):
    rng = np.random.default_rng(seed)
    numbers = FrameNumbers(b"\0\0\1\x67" + data)
    for head in (b"\0\0\1\x67", b"\0\0\1\x65", b"\0\0\1\x41"):
        assert numbers.is_gap_before(head + rng.bytes(60)) in (True, False)
