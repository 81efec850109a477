"""Frames of the Xsens protocol, held to documented and computed byte vectors."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.errors import DeviceError
from nodes.devices.mti_frames import (
    MAX_DATA_BYTES,
    FrameParser,
    Message,
    Mid,
    OutputMode,
    OutputSettings,
    decode_data2,
    decode_legacy,
    encode,
)

LEGACY = (
    "FA FF 32 26 3D CC CC CD BE 4C CC CD 41 1C F5 C3 3C 23 D7 0A BC A3 D7 0A 3C F5 C2 8F"
    " 3F 00 00 00 00 00 00 00 BF 4C CC CD 00 01 69"
)
GYRO_ONLY = "FA FF 32 0E 3C 23 D7 0A BC A3 D7 0A 3C F5 C2 8F FF FF C1"
DATA2 = (
    "FA FF 36 31 10 20 02 DF C5 10 60 04 00 45 9D A0 40 20 0C BE DC 9A FA 3F 54 9F 37 41 1C BB 70"
    " 80 20 0C BB AA 5C 80 3B 8C 55 01 BB 81 33 00 E0 20 04 00 00 00 81 45"
)
NO_DATA = {
    Mid.REQUEST_DEVICE_ID: "FA FF 00 00 01",
    Mid.GO_TO_CONFIG: "FA FF 30 00 D1",
    Mid.GO_TO_CONFIG + 1: "FA FF 31 00 D0",
    Mid.GO_TO_MEASUREMENT: "FA FF 10 00 F1",
    Mid.GO_TO_MEASUREMENT + 1: "FA FF 11 00 F0",
    Mid.REQUEST_BAUD: "FA FF 18 00 E9",
    Mid.SET_OUTPUT_MODE: "FA FF D0 00 31",
    Mid.SET_OUTPUT_MODE + 1: "FA FF D1 00 30",
    Mid.REQUEST_CONFIGURATION: "FA FF 0C 00 F5",
    Mid.REQUEST_DATA_LENGTH: "FA FF 0A 00 F7",
    Mid.WAKE_UP: "FA FF 3E 00 C3",
    Mid.WAKE_UP_ACKNOWLEDGE: "FA FF 3F 00 C2",
    Mid.RESET: "FA FF 40 00 C1",
    Mid.REQUEST_FIRMWARE: "FA FF 12 00 EF",
}
WITH_DATA = [
    (0x01, "00 50 00 01", "FA FF 01 04 00 50 00 01 AB"),
    (0x13, "02 04 00", "FA FF 13 03 02 04 00 E5"),
    (Mid.ERROR, "04", "FA FF 42 01 04 BA"),
    (Mid.SET_OUTPUT_MODE, "00 02", "FA FF D0 02 00 02 2D"),
    (Mid.SET_OUTPUT_MODE, "00 06", "FA FF D0 02 00 06 29"),
    (Mid.SET_OUTPUT_SETTINGS, "00 00 00 01", "FA FF D2 04 00 00 00 01 2A"),
    (Mid.SET_OUTPUT_SETTINGS, "00 00 00 51", "FA FF D2 04 00 00 00 51 DA"),
    (Mid.SET_PERIOD, "04 80", "FA FF 04 02 04 80 77"),
    (Mid.SET_SKIP_FACTOR, "00 00", "FA FF D4 02 00 00 2B"),
    (Mid.SET_NO_ROTATION, "00 05", "FA FF 22 02 00 05 D8"),
    (0x18, "01", "FA FF 18 01 01 E7"),
    (0x18, "80", "FA FF 18 01 80 68"),
    (
        Mid.SET_OUTPUT_CONFIGURATION,
        "10 20 FF FF 10 60 FF FF 20 10 00 64 40 20 01 90 80 20 01 90 C0 20 00 64 E0 20 FF FF 50 42 00 64 50 22 00 64"
        " D0 12 00 64",
        "FA FF C0 28 10 20 FF FF 10 60 FF FF 20 10 00 64 40 20 01 90 80 20 01 90 C0 20 00 64 E0 20 FF FF 50 42 00 64"
        " 50 22 00 64 D0 12 00 64 73",
    ),
]
frames = st.builds(Message, st.integers(0, 255), st.binary(max_size=300))


def data_of(frame: str) -> bytes:
    (message,) = FrameParser().feed(bytes.fromhex(frame))
    return message.data


@pytest.mark.parametrize(("mid", "frame"), NO_DATA.items())
def test_commands_without_data_are_the_documented_bytes(mid, frame):
    assert encode(mid) == bytes.fromhex(frame)
    assert FrameParser().feed(bytes.fromhex(frame)) == [Message(mid, b"")]


@pytest.mark.parametrize(("mid", "data", "frame"), WITH_DATA)
def test_commands_with_data_are_the_documented_bytes(mid, data, frame):
    assert encode(mid, bytes.fromhex(data)) == bytes.fromhex(frame)
    assert FrameParser().feed(bytes.fromhex(frame)) == [Message(mid, bytes.fromhex(data))]


def test_legacy_sample():
    reading = decode_legacy(data_of(LEGACY), OutputMode.CALIBRATED, OutputSettings.SAMPLE_COUNTER)
    assert reading.acceleration_m_s2 is not None
    assert reading.rate_rad_s is not None
    # The device's floats have 24 bits.
    np.testing.assert_allclose(reading.acceleration_m_s2, [0.1, -0.2, 9.81], rtol=2**-24)
    np.testing.assert_allclose(reading.rate_rad_s, [0.01, -0.02, 0.03], rtol=2**-24)
    assert (reading.counter, reading.time_fine) == (1, None)


def test_legacy_sample_of_the_gyroscope_alone():
    settings = OutputSettings.SAMPLE_COUNTER | OutputSettings.NO_ACCELERATION | OutputSettings.NO_MAGNETOMETER
    reading = decode_legacy(data_of(GYRO_ONLY), OutputMode.CALIBRATED, settings)
    assert reading.rate_rad_s is not None
    np.testing.assert_allclose(reading.rate_rad_s, [0.01, -0.02, 0.03], rtol=2**-24)
    assert reading.acceleration_m_s2 is None
    assert reading.counter == 65535


def test_sample_of_the_successors():
    reading = decode_data2(data_of(DATA2))
    assert reading.acceleration_m_s2 is not None
    assert reading.rate_rad_s is not None
    assert (reading.counter, reading.time_fine) == (57285, 4562336)
    np.testing.assert_allclose(reading.acceleration_m_s2, [-0.43087, 0.83055, 9.79576], atol=5e-6)
    np.testing.assert_allclose(reading.rate_rad_s, [-0.0051990, 0.0042826, -0.0039428], atol=5e-8)


@pytest.mark.parametrize("frame", [LEGACY, GYRO_ONLY])
def test_legacy_sample_under_other_settings_is_refused(frame):
    settings = OutputSettings.SAMPLE_COUNTER | OutputSettings.NO_GYROSCOPE
    with pytest.raises(DeviceError, match="expected"):
        decode_legacy(data_of(frame), OutputMode.CALIBRATED, settings)


@pytest.mark.parametrize("cut", [1, 4, 6, 20, 48])
def test_cut_sample_of_the_successors_is_refused(cut):
    with pytest.raises(DeviceError):
        decode_data2(data_of(DATA2)[:cut])


@pytest.mark.parametrize("number", ["7F C0 00 00", "7F 80 00 00", "FF 80 00 00"])
def test_a_number_that_is_none_is_refused(number):
    data = bytes.fromhex("80 20 0C" + number + " 00 00 00 00 00 00 00 00 10 20 02 00 01")
    with pytest.raises(DeviceError, match="not finite"):
        decode_data2(data)


@given(messages=st.lists(frames, max_size=8), cuts=st.lists(st.integers(0, 3000), max_size=8))
def test_frames_come_whole_from_any_pieces(messages, cuts):
    stream = b"".join(encode(message.mid, message.data) for message in messages)
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    parser = FrameParser()
    pieces = [stream[a:b] for a, b in pairwise(edges)]
    assert [message for piece in pieces for message in parser.feed(piece)] == messages
    assert (parser.n_bad_sums, parser.n_skipped) == (0, 0)


@given(garbage=st.binary(max_size=200).filter(lambda data: 0xFA not in data), message=frames)
def test_a_frame_is_found_after_garbage(garbage, message):
    parser = FrameParser()
    assert parser.feed(garbage + encode(message.mid, message.data)) == [message]
    assert parser.n_skipped == len(garbage)


@given(garbage=st.binary(max_size=200))
def test_garbage_that_looks_like_a_frame_costs_at_most_the_longest_frame(garbage):
    stream = garbage + bytes.fromhex(GYRO_ONLY) * 60
    found = FrameParser().feed(stream)
    # One begun frame may swallow what it claims to hold, and by chance be believed.
    n_swallowed = -(-(MAX_DATA_BYTES + 7) // len(bytes.fromhex(GYRO_ONLY)))
    assert found[-1] == Message(Mid.DATA, data_of(GYRO_ONLY))
    assert sum(message.mid == Mid.DATA for message in found) >= 60 - n_swallowed


@given(message=frames, at=st.integers(0, 400), bit=st.integers(0, 7))
def test_a_flipped_bit_never_gives_another_message_of_the_same_length(message, at, bit):
    whole = bytearray(encode(message.mid, message.data))
    whole[at % len(whole)] ^= 1 << bit
    found = FrameParser().feed(bytes(whole))
    assert all(len(other.data) != len(message.data) for other in found)


@given(data=st.binary(max_size=400))
def test_any_bytes_give_samples_or_the_projects_own_error(data):
    for decode in (decode_data2, lambda d: decode_legacy(d, OutputMode.CALIBRATED, OutputSettings.SAMPLE_COUNTER)):
        try:
            reading = decode(data)
        except DeviceError:
            continue
        assert 0 <= reading.counter < 65536


def test_memory_is_bounded_whatever_comes():
    parser = FrameParser()
    longest = 0
    rng = np.random.default_rng(3)
    for _ in range(200):
        parser.feed(rng.integers(0, 256, 1000, dtype=np.uint8).tobytes())
        longest = max(longest, len(parser._bytes))
    assert longest <= MAX_DATA_BYTES + 7
