import math
import random
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.bus import checks
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.check_calls import parse_command, parse_reply, parse_rows, parse_summary
from nodes.bus.checks import MessageError, parse_observation, parse_status
from nodes.bus.keys import Kind
from tests.nodes.bus.good_messages import NODE, NOW_NS, good, good_status, header

NAN, INF = math.nan, math.inf
TEXT, NO_TEXT = "x" * 4096, ["x" * 4097, "a\x1b[2J", "a\x9b2J", "\x7f", "\0"]
AHEAD_NS = NOW_NS + checks.MAX_AHEAD_NS + 1
EARLY_NS, LATE_NS = checks.EARLIEST_NS - 1, checks.LATEST_NS + 1

# Field: values that are refused, with the reason.
SPOILT_HEADER = [
    ("schema", [0, 2], "header.schema: unknown version"),
    ("node", ["", "a/b", "n" * 65], "header.node: no name"),
    ("node", ["n2"], "header.node: not the key's"),
    ("boot", [b"", bytes(15), bytes(17)], "header.boot: not 16 bytes"),
    ("sequence", [2**53 + 1, 2**64 - 1], "header.sequence: too large"),
    ("session", ["a b", "*"], "header.session: no name"),
    ("stamp_ns", [0, -1, EARLY_NS, LATE_NS], "header.stamp_ns: no time of an observation"),
    ("stamp_ns", [AHEAD_NS], "header.stamp_ns: in the future"),
]
SPOILT = [
    (Kind.SPOTS, "camera", ["", "C 0"], "camera: no name"),
    (Kind.SPOTS, "width_px", [0, 100_001], "width_px, height_px: no image"),
    (Kind.SPOTS, "height_px", [0, 100_001], "width_px, height_px: no image"),
    (Kind.SPOTS, "rate_hz", [-1, NAN, INF], "rate_hz: out of bounds"),
    (Kind.SPOTS, "origin", [7], "origin: unknown"),
    (Kind.SPOTS, "frame_sequence", [[], range(4097)], "frame_sequence: none, or too many"),
    (Kind.SPOTS, "frame_sequence", [[7], [7, 8, 9]], "frame_stamp_ns: wrong length"),
    (Kind.SPOTS, "frame_sequence", [[9, 7], [7, 7], [7, 2**53 + 1]], "frame_sequence: does not rise"),
    (Kind.SPOTS, "frame_stamp_ns", [[NOW_NS]], "frame_stamp_ns: wrong length"),
    (Kind.SPOTS, "frame_stamp_ns", [[NOW_NS, EARLY_NS], [LATE_NS] * 2], "frame_stamp_ns: no time of an observation"),
    (Kind.SPOTS, "frame_stamp_ns", [[NOW_NS, AHEAD_NS]], "stamps: in the future"),
    (Kind.SPOTS, "spot_frame", [[0] * 32769], "spot_frame: too many"),
    (Kind.SPOTS, "spot_frame", [[0, 1]], "x_px, y_px, sigma_px, score: wrong length"),
    (Kind.SPOTS, "spot_frame", [[0, 1, 2], [1, 0, 1]], "spot_frame: no frame of the batch, or falls"),
    (Kind.SPOTS, "x_px", [[1, 2]], "x_px, y_px, sigma_px, score: wrong length"),
    (Kind.SPOTS, "x_px", [[-0.51, 1, 1], [1, 1, 639.51], [1, NAN, 1]], "x_px: out of bounds"),
    (Kind.SPOTS, "y_px", [[-0.51, 1, 1], [1, 1, 479.51], [1, INF, 1]], "y_px: out of bounds"),
    (Kind.SPOTS, "sigma_px", [[0, 1, 1], [1, 1, 1001], [1, NAN, 1]], "sigma_px: out of bounds"),
    (Kind.SPOTS, "score", [[-0.01, 0, 0], [0, 0, 1.01], [0, NAN, 0]], "score: out of bounds"),
    (Kind.LRF_INFO, "lrf", [""], "lrf: no name"),
    (Kind.LRF_INFO, "product", NO_TEXT, "product: too long, or control characters"),
    (Kind.LRF_INFO, "serial", NO_TEXT, "serial: too long, or control characters"),
    (Kind.LRF_INFO, "firmware", NO_TEXT, "firmware: too long, or control characters"),
    (Kind.LRF_INFO, "steps_per_turn", [0, 65537, 700], "first_step, last_step, steps_per_turn: no scan"),
    (Kind.LRF_INFO, "first_step", [725, 800], "first_step, last_step, steps_per_turn: no scan"),
    (Kind.LRF_INFO, "front_step", [1025, -1025], "front_step: beyond a turn"),
    (Kind.LRF_INFO, "range_min_m", [-0.1, NAN], "range_min_m: out of bounds"),
    (Kind.LRF_INFO, "range_min_m", [5.6, 6], "range_min_m, range_max_m: no range"),
    (Kind.LRF_INFO, "range_max_m", [0, 10_001, NAN], "range_max_m: out of bounds"),
    (Kind.LRF_INFO, "turn_s", [0, 11, NAN], "turn_s: out of bounds"),
    (Kind.LRF_SCAN, "lrf", ["L/0"], "lrf: no name"),
    (Kind.LRF_SCAN, "readings_mm", [[], [0] * 65537], "readings_mm: none, or too many"),
    (Kind.LRF_SCAN, "readings_mm", [[-1, 0], [0, 10**7 + 1]], "readings_mm: out of bounds"),
    (Kind.LRF_SCAN, "intensity", [[1], [1, 2, 3]], "intensity: wrong length"),
    (Kind.LRF_SCAN, "stamp_ns", [0, EARLY_NS, LATE_NS], "stamp_ns: no time of an observation"),
    (Kind.LRF_SCAN, "stamp_ns", [AHEAD_NS], "stamps: in the future"),
    (Kind.LRF_SCAN, "sigma_s", [-1, NAN], "sigma_s: out of bounds"),
    (Kind.LRF_SCAN, "device_s", [-1, INF], "device_s: out of bounds"),
    (Kind.LRF_SPOT, "lrf", [""], "lrf: no name"),
    (Kind.LRF_SPOT, "setting", [256], "setting: too large"),
    (Kind.LRF_SPOT, "stamp_ns", [0, LATE_NS], "stamp_ns: no time of an observation"),
    (Kind.LRF_SPOT, "stamp_ns", [AHEAD_NS], "stamps: in the future"),
    (Kind.LRF_SPOT, "range_m", [0, 1001, NAN], "range_m: out of bounds"),
    (Kind.LRF_SPOT, "bearing_rad", [-6.3, 6.3, NAN], "bearing_rad: out of bounds"),
    (Kind.LRF_SPOT, "range_sigma_m", [0, 11, NAN], "range_sigma_m, bearing_sigma_rad: out of bounds"),
    (Kind.LRF_SPOT, "bearing_sigma_rad", [0, 11, NAN], "range_sigma_m, bearing_sigma_rad: out of bounds"),
    (Kind.LRF_SPOT, "out_of_plane_sigma_m", [0, 11, NAN], "out_of_plane_sigma_m: out of bounds"),
    (Kind.LRF_SPOT, "bias_bound_m", [-1e-3, 1.1, NAN], "bias_bound_m: out of bounds"),
    (Kind.LRF_SPOT, "n_spots", [32769], "n_spots: out of bounds"),
    (Kind.TILT, "lrf", [""], "lrf: no name"),
    (Kind.TILT, "setting", [256], "setting: too large"),
    (Kind.TILT, "tilt_rad", [-6.3, 6.3, NAN], "tilt_rad: out of bounds"),
    (Kind.TILT, "steps", [2**53 + 1, -(2**53) - 1], "steps: too large"),
    (Kind.TILTS, "lrf", [""], "lrf: no name"),
    (Kind.TILTS, "angle_rad", [[], [0] * 257], "angle_rad: none, or too many"),
    (Kind.TILTS, "angle_rad", [[0.1]], "covariance_rad2: wrong length"),
    (Kind.TILTS, "angle_rad", [[0, 6.3], [NAN, 0]], "angle_rad: out of bounds"),
    (Kind.TILTS, "covariance_rad2", [[1, 0, 0]], "covariance_rad2: wrong length"),
    (Kind.TILTS, "covariance_rad2", [[11, 0, 0, 1], [NAN, 0, 0, 1]], "covariance_rad2: out of bounds"),
    (Kind.TILTS, "covariance_rad2", [[1, 0.1, 0, 1], [1, 2, 2, 1], [-1, 0, 0, 1]], "covariance_rad2: no covariance"),
    (Kind.TILTS, "sources", [["s"] * 17], "sources, notes: too many"),
    (Kind.TILTS, "notes", [["n"] * 65], "sources, notes: too many"),
    (Kind.TILTS, "sources", [[text] for text in NO_TEXT], "sources, notes: too long, or control characters"),
    (Kind.TILTS, "notes", [[text] for text in NO_TEXT], "sources, notes: too long, or control characters"),
    (Kind.IMU, "lrf", [""], "lrf: no name"),
    (Kind.IMU, "sample", [[], range(8193)], "sample: none, or too many"),
    (Kind.IMU, "sample", [[1, 2]], "device_s, arrival_ns: wrong length"),
    (Kind.IMU, "rate_rad_s", [[0, 0]], "rate_rad_s, acceleration_m_s2: wrong length"),
    (Kind.IMU, "acceleration_m_s2", [[0, 0]], "rate_rad_s, acceleration_m_s2: wrong length"),
    (Kind.IMU, "arrival_ns", [[0], [LATE_NS]], "arrival_ns: no time of an observation"),
    (Kind.IMU, "arrival_ns", [[AHEAD_NS]], "stamps: in the future"),
    (Kind.IMU, "device_s", [[-1], [NAN]], "device_s: out of bounds"),
    (Kind.IMU, "rate_rad_s", [[0, 0, 1001], [NAN, 0, 0]], "rate_rad_s: out of bounds"),
    (Kind.IMU, "acceleration_m_s2", [[0, 0, 10_001], [NAN, 0, 0]], "acceleration_m_s2: out of bounds"),
    (Kind.EVENT, "text", NO_TEXT, "text: too long, or control characters"),
]
SPOILT_STATUS = [
    *((field, NO_TEXT, f"{field}: too long, or control characters") for field in ("role", "state", "message")),
    ("advice", [[text] for text in NO_TEXT], "advice: too long, or control characters"),
    ("advice", [["a"] * 65], "advice: too many"),
    ("rate_hz", [-1, 1e7, NAN], "rate_hz: out of bounds"),
    ("temperature_c", [-301, 1001, NAN], "temperature_c: out of bounds"),
    ("plane_sigma_m", [-1, NAN, INF], "plane_sigma_m: out of bounds"),
]


def set_field(message, field, value):
    if isinstance(value, (list, range)):
        del getattr(message, field)[:]
        getattr(message, field).extend(value)
    else:
        setattr(message, field, value)


def reason_of(parse):
    with pytest.raises(MessageError) as refused:
        parse()
    return refused.value.reason


def parsed(kind, message):
    return parse_observation(kind, message.SerializeToString(), node=NODE, now_ns=NOW_NS)


def test_every_kind_has_a_type_and_a_good_message_passes_unchanged():
    assert set(checks.TYPES) == set(Kind)
    for kind in Kind:
        assert parsed(kind, good(kind)) == good(kind)
    assert parse_status(good_status().SerializeToString(), node=NODE, now_ns=NOW_NS) == good_status()


@pytest.mark.parametrize(("kind", "field", "values", "reason"), SPOILT)
def test_a_field_beyond_its_bounds_is_refused_with_the_reason(kind, field, values, reason):
    for value in values:
        message = good(kind)
        set_field(message, field, value)
        assert reason_of(lambda message=message: parsed(kind, message)) == reason


def test_every_field_of_every_observation_is_spoilt_somewhere_above():
    # Counters that any number fits, and a flag.
    free = {(Kind.SPOTS, "n_dropped"), (Kind.LRF_SCAN, "scan"), (Kind.TILT, "has_steps"), (Kind.LRF_INFO, "last_step")}
    spoilt = {(kind, field) for kind, field, _, _ in SPOILT}
    fields = {(kind, field.name) for kind, type_ in checks.TYPES.items() for field in type_.DESCRIPTOR.fields}
    assert {pair for pair in fields if pair[1] != "header"} == spoilt | free


@pytest.mark.parametrize(("field", "values", "reason"), SPOILT_HEADER)
def test_a_header_beyond_its_bounds_is_refused_in_every_kind(field, values, reason):
    for kind in Kind:
        for value in values:
            message = good(kind)
            setattr(message.header, field, value)
            assert reason_of(lambda kind=kind, message=message: parsed(kind, message)) == reason


@pytest.mark.parametrize(
    ("clock", "reason"),
    [
        (pb.ClockQuality(source="CLOCK_SOURCE_PTP", sigma_s=-1), "header.clock.sigma_s: out of bounds"),
        (pb.ClockQuality(sigma_s=NAN), "header.clock.sigma_s: out of bounds"),
        (pb.ClockQuality.FromString(b"\x08\x09"), "header.clock.source: unknown"),
    ],
)
def test_a_clock_beyond_its_bounds_is_refused(clock, reason):
    message = good(Kind.EVENT)
    message.header.clock.CopyFrom(clock)
    assert reason_of(lambda: parsed(Kind.EVENT, message)) == reason


@pytest.mark.parametrize(("field", "values", "reason"), SPOILT_STATUS)
def test_a_status_beyond_its_bounds_is_refused(field, values, reason):
    for value in values:
        status = good_status()
        set_field(status, field, value)
        payload = status.SerializeToString()
        assert reason_of(lambda payload=payload: parse_status(payload, node=NODE, now_ns=NOW_NS)) == reason


def test_a_message_that_is_too_large_is_refused_before_it_is_parsed():
    payload = bytes(checks.MAX_MESSAGE_BYTES + 1)
    assert reason_of(lambda: parse_observation(Kind.SPOTS, payload, node=NODE, now_ns=NOW_NS)) == "message: too large"
    assert reason_of(lambda: parse_rows(payload)) == "message: too large"


@pytest.mark.parametrize("kind", Kind)
def test_mutated_and_truncated_messages_are_refused_or_within_bounds_and_raise_nothing_else(kind):
    rng = random.Random(4)
    whole = good(kind).SerializeToString()
    for _ in range(1500):
        payload = bytearray(whole)
        for _ in range(rng.randint(1, 4)):
            payload[rng.randrange(len(payload))] = rng.randrange(256)
        del payload[rng.randint(1, 2 * len(payload)) :]
        try:
            message = parse_observation(kind, bytes(payload), node=NODE, now_ns=NOW_NS)
        except MessageError:
            continue
        # What passed is still good when it is written and read again.
        assert parsed(kind, message) == message


@given(payload=st.binary(max_size=300), kind=st.sampled_from(Kind))
def test_random_bytes_are_refused_by_every_door(payload, kind):
    doors = [
        lambda: parse_observation(kind, payload, node=NODE, now_ns=NOW_NS),
        lambda: parse_status(payload, node=NODE, now_ns=NOW_NS),
        lambda: parse_command(payload, now_ns=NOW_NS),
        lambda: parse_reply(payload, node=NODE, now_ns=NOW_NS),
        lambda: parse_summary(payload, node=NODE, now_ns=NOW_NS),
    ]
    for door in doors:
        with pytest.raises(MessageError):
            door()
    # Rows have no header: some bytes pass, and each of their payloads then goes through its own door.
    with suppress(MessageError):
        parse_rows(payload)


@pytest.mark.parametrize(
    ("parse", "message", "reason"),
    [
        (parse_command, pb.Command(header=header(), number=NAN), "number: none"),
        (parse_command, pb.Command(header=header(), tilts_rad=[0.1, NAN]), "tilts_rad: too many, or out of bounds"),
        (parse_command, pb.Command(header=header(), tilts_rad=[0.1] * 257), "tilts_rad: too many, or out of bounds"),
        (parse_reply, pb.Reply(header=header(), code="MAYBE"), "code: unknown"),
        (parse_reply, pb.Reply(header=header(), code="OK", message=TEXT + "x"), "message: too long"),
        (
            parse_summary,
            pb.JournalSummary(header=header(), spans=[pb.JournalSpan(boot=b"short", last=1)]),
            "spans.boot: not 16 bytes",
        ),
        (
            parse_summary,
            pb.JournalSummary(header=header(), spans=[pb.JournalSpan(boot=bytes(16), first=5, last=3)]),
            "spans.first, last: no span",
        ),
        (
            parse_summary,
            pb.JournalSummary(header=header(), spans=[pb.JournalSpan(boot=bytes(16), first=5, last=2**64 - 1)]),
            "spans.first, last: no span",
        ),
    ],
)
def test_calls_and_answers_beyond_their_bounds_are_refused(parse, message, reason):
    payload = message.SerializeToString()
    of_node = {} if parse is parse_command else {"node": NODE}
    assert reason_of(lambda: parse(payload, now_ns=NOW_NS, **of_node)) == reason


def test_a_span_that_holds_nothing_any_more_is_a_good_one():
    summary = pb.JournalSummary(header=header(), spans=[pb.JournalSpan(boot=bytes(16), first=5, last=4, n_dropped=5)])
    assert parse_summary(summary.SerializeToString(), node=NODE, now_ns=NOW_NS) == summary
