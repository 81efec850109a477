from nodes.devices.cameras.stream_clock import Stamp, StreamClock
from nodes.frames import StampOrigin

SECOND = 10**9
PERIOD = SECOND // 25
NOW = 1_800_000_000 * SECOND
DELAY = 30_000_000  # from capture to arrival


def stamps(clock, wall_offsets_ns, *, start=0):
    """Stamps of an even stream; for each packet how far the camera's clock is from the truth, or None: no wall time."""
    given = []
    for k, offset_ns in enumerate(wall_offsets_ns, start):
        true_ns = NOW + k * PERIOD
        wall_ns = None if offset_ns is None else true_ns + offset_ns
        given.append(clock.stamp(k * PERIOD, wall_ns, true_ns + DELAY))
    return given


def errors_ns(given, *, start=0):
    return [None if stamp is None else stamp.stamp_ns - NOW - k * PERIOD for k, stamp in enumerate(given, start)]


def test_frames_before_the_first_report_are_withheld_and_later_ones_have_the_cameras_clock():
    given = stamps(StreamClock(wait_s=3), [None] * 10 + [0] * 5)
    assert given[:10] == [None] * 10
    assert errors_ns(given)[11:] == [0] * 4
    assert {stamp.origin for stamp in given[11:]} == {StampOrigin.CAMERA}


def test_the_first_wall_time_which_belongs_to_the_next_packet_is_not_believed():
    given = stamps(StreamClock(wait_s=3), [None, None, PERIOD, 0, 0, 0])
    assert errors_ns(given) == [None, None, None, None, 0, 0]


def test_a_packet_without_presentation_time_has_no_stamp():
    clock = StreamClock(wait_s=3)
    stamps(clock, [0, 0, 0])
    assert clock.stamp(None, NOW, NOW) is None


def test_without_any_report_the_arrival_is_the_stamp_after_the_wait():
    given = stamps(StreamClock(wait_s=1), [None] * 30)
    assert given[:25] == [None] * 25
    assert given[25:] == [Stamp(NOW + k * PERIOD + DELAY, StampOrigin.ARRIVAL) for k in range(25, 30)]


def test_a_report_after_the_wait_does_not_change_the_clock_of_the_connection():
    given = stamps(StreamClock(wait_s=1), [None] * 30 + [0] * 10)
    assert {stamp.origin for stamp in given[25:]} == {StampOrigin.ARRIVAL}


def test_a_clock_that_was_never_set_is_not_believed():
    since_1970_ns = 1_800_000_000 * SECOND
    given = stamps(StreamClock(wait_s=1), [-since_1970_ns] * 30)
    assert given[:25] == [None] * 25
    assert {stamp.origin for stamp in given[25:]} == {StampOrigin.ARRIVAL}


def test_a_slewed_clock_is_followed_at_once_and_is_no_step():
    clock = StreamClock(wait_s=3)
    given = stamps(clock, [0] * 5 + [20_000_000] * 5)
    assert errors_ns(given)[5:] == [20_000_000] * 5
    assert clock.n_steps == 0


def test_a_clock_that_was_set_is_followed_when_three_packets_agree_and_counted():
    for step_ns in (7 * SECOND, -3600 * SECOND):
        clock = StreamClock(wait_s=3)
        given = stamps(clock, [0] * 5 + [step_ns] * 5)
        assert errors_ns(given)[1:] == [0] * 6 + [step_ns] * 3
        assert clock.n_steps == 1


def test_single_wild_reports_are_ignored():
    clock = StreamClock(wait_s=3)
    given = stamps(clock, [0] * 5 + [SECOND, 2 * SECOND, 0, 5 * SECOND, 5 * SECOND, 0, 0])
    assert errors_ns(given)[1:] == [0] * 11
    assert clock.n_steps == 0
