import threading

import numpy as np
import pytest

from network_calib.errors import InputError
from nodes.devices.cameras.capture_thread import Surroundings
from nodes.devices.cameras.connection import ConnectionLostError
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.cameras.live_video import LiveVideo, open_live
from nodes.devices.errors import SourceError
from nodes.frames import SourceCounts, StampOrigin
from tests.nodes.devices.fake_connection import SIZE_PX, Connections, FakeConnection, shot

MANY = LiveOptions(n_queued=1000)
MS = 10**6


class Time:
    """A clock that goes on only when somebody waits, or is told to."""

    def __init__(self):
        self.now_s = 100.0
        self.waits_s = []

    def pause(self, _stop, wait_s):
        self.waits_s.append(wait_s)
        self.now_s += wait_s

    def surroundings(self):
        return Surroundings(np.random.default_rng(5), lambda: self.now_s, self.pause)


@pytest.fixture
def time():
    return Time()


@pytest.fixture
def hold():
    """Set at the end, so that no fake camera waits for ever."""
    event = threading.Event()
    yield event
    event.set()


@pytest.fixture
def live(time):
    """Open a source on scripted connections; closed at the end."""
    sources = []

    def make(*given, options=MANY):
        connections = Connections(list(given))
        sources.append(LiveVideo("fake", connections, options, time.surroundings()))
        return sources[-1], connections

    yield make
    for source in sources:
        source.close()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("capture")]


def taken(source, n_frames):
    iterator = iter(source)
    return [next(iterator) for _ in range(n_frames)]


def test_frames_are_numbered_and_keep_what_the_shot_says(live, hold):
    source, _ = live(FakeConnection([shot(k * 40 * MS) for k in range(1, 4)], hold))
    frames = taken(source, 3)
    assert [frame.sequence for frame in frames] == [0, 1, 2]
    assert [frame.stamp_ns for frame in frames] == [40 * MS, 80 * MS, 120 * MS]
    assert {frame.origin for frame in frames} == {StampOrigin.CAMERA}
    assert [int(frame.image[0, 0]) for frame in frames] == [k * 40 * MS % 256 for k in range(1, 4)]
    assert (source.name, source.size_px, source.rate_hz) == ("fake", SIZE_PX, 25.0)
    assert source.counts == SourceCounts(delivered=3)


def test_a_failure_of_the_first_connection_is_raised_at_once():
    with pytest.raises(SourceError, match="no such path"):
        LiveVideo("fake", Connections([SourceError("no such path")]), MANY)


def test_a_slow_consumer_gets_the_newest_frames_and_the_rest_is_counted(live, hold):
    is_captured = threading.Event()
    script = [*(shot(k * MS) for k in range(10)), is_captured.set]
    source, _ = live(FakeConnection(script, hold), options=LiveOptions(n_queued=3))
    assert is_captured.wait(10)
    assert [frame.sequence for frame in taken(source, 3)] == [7, 8, 9]
    assert source.counts == SourceCounts(delivered=3, dropped=7)


def test_lost_frames_are_gaps_of_the_sequence_but_not_before_the_first_frame(live, hold):
    source, _ = live(FakeConnection([shot(1, n_lost=5), shot(2), None, shot(3, n_lost=2)], hold))
    assert [frame.sequence for frame in taken(source, 3)] == [0, 1, 4]
    assert source.counts == SourceCounts(delivered=3, dropped=2)


def test_after_a_loss_it_connects_again_and_goes_on_counting(live, hold, time):
    first = FakeConnection([shot(1), shot(2)])
    again = FakeConnection([shot(11, n_lost=1), shot(12)], hold)
    source, connections = live(first, ConnectionLostError("still off"), ConnectionLostError("still off"), again)
    assert [frame.sequence for frame in taken(source, 4)] == [0, 1, 3, 4]
    assert source.counts == SourceCounts(delivered=4, dropped=1, late=0, reconnects=1)
    assert first.is_closed
    assert connections.n_asked == 4
    # Longest waits 0.5, 1 and 2 s, each at least half of that.
    assert len(time.waits_s) == 3
    assert all(longest / 2 <= wait <= longest for wait, longest in zip(time.waits_s, (0.5, 1.0, 2.0), strict=True))


def test_a_camera_that_stays_away_ends_the_iteration_with_what_was_last_wrong(live, time):
    source, _ = live(FakeConnection([shot(1)]), options=LiveOptions(max_away_s=60.0))
    with pytest.raises(SourceError, match="away for more than 60 s; the last attempt: fake: no answer"):
        list(source)
    # The last wait is cut, so that the error comes when it is due.
    assert time.now_s == pytest.approx(160.0)
    assert source.counts.delivered == 1


def test_a_refusal_while_connecting_again_is_final(live):
    source, connections = live(FakeConnection([shot(1)]), SourceError("wrong password"))
    with pytest.raises(SourceError, match="wrong password"):
        list(source)
    assert connections.n_asked == 2


def test_a_dead_thread_ends_the_iteration_without_telling_the_password(live):
    failure = RuntimeError("cannot read rtsp://me:hunter2@camera/live")
    source, _ = live(FakeConnection([shot(1), failure]))
    with pytest.raises(SourceError, match=r"RuntimeError: cannot read rtsp://\*\*\*@camera/live"):
        list(source)
    with pytest.raises(SourceError, match="RuntimeError"):  # and does so again
        list(source)


def test_a_thread_that_hangs_in_a_driver_ends_the_iteration(live, hold, time):
    def hang():
        time.now_s += 100.0
        hold.wait()

    source, _ = live(FakeConnection([shot(1), hang]))
    with pytest.raises(SourceError, match="hangs"):
        list(source)
    hold.set()


def test_stamps_rise_frames_of_a_clock_set_back_a_little_are_lost(live, hold):
    stamps_ms = [1000, 1040, 1080, 1000, 1040, 1080, 1120, 1160]
    source, _ = live(FakeConnection([shot(stamp * MS) for stamp in stamps_ms], hold))
    frames = taken(source, 5)
    assert [frame.stamp_ns // MS for frame in frames] == [1000, 1040, 1080, 1120, 1160]
    assert [frame.sequence for frame in frames] == [0, 1, 2, 6, 7]
    assert source.counts.dropped == 3


def test_a_clock_set_back_by_an_hour_is_said(live):
    source, _ = live(FakeConnection([shot(7200_000 * MS), shot(3600_000 * MS)]))
    with pytest.raises(SourceError, match=r"set back by 3600\.0 s"):
        list(source)


def test_clock_steps_of_all_connections_are_counted(live, hold):
    source, _ = live(
        FakeConnection([shot(1), shot(2)], n_clock_steps=2), FakeConnection([shot(3)], hold, n_clock_steps=1)
    )
    taken(source, 3)
    assert source.n_clock_steps == 3


def test_pictures_of_another_size_are_refused(live):
    source, _ = live(FakeConnection([shot(1)]), FakeConnection([shot(2, size_px=(4, 2))]))
    with pytest.raises(SourceError, match="changed from 8x6 to 4x2"):
        list(source)


def test_late_frames_are_counted_against_the_nominal_rate(live, hold, time):
    def wait(seconds):
        return lambda: setattr(time, "now_s", time.now_s + seconds)

    script = [shot(1), wait(0.04), shot(2), wait(0.1), shot(3), wait(0.04), shot(4)]
    source, _ = live(FakeConnection(script, hold))
    taken(source, 4)
    assert source.counts == SourceCounts(delivered=4, late=1)


def test_silence_is_visible_while_a_camera_is_away(live, hold, time):
    source, _ = live(FakeConnection([shot(1)], hold))
    taken(source, 1)
    time.now_s += 7.0
    assert source.silent_s == pytest.approx(7.0)


def test_close_ends_iteration_and_thread_from_any_state(time, hold):
    connection = FakeConnection([shot(1)], hold)
    source = LiveVideo("fake", Connections([connection]), MANY, time.surroundings())
    frames = iter(source)
    next(frames)
    threading.Timer(0.05, source.close).start()
    assert list(frames) == []
    source.close()
    assert connection.is_closed


def test_close_does_not_wait_for_a_camera_that_is_away(hold):
    # The real pause: the first wait is at least 0.25 s and ends when the source is closed.
    del hold
    source = LiveVideo("fake", Connections([FakeConnection([shot(1)])]), MANY)
    assert len(taken(source, 1)) == 1
    source.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "capture fake"]
    assert list(source) == []


@pytest.mark.parametrize("address", ["", "http://camera/live", "video.mp4", "rtsp:/camera"])
def test_what_is_no_live_camera_is_refused(address):
    with pytest.raises(InputError, match="no live camera; expected rtsp://"):
        open_live(address)


@pytest.mark.parametrize(
    "option",
    [{"timeout_s": 0.0}, {"n_queued": 0}, {"rate_hz": -5.0}, {"size_px": (640, 0)}, {"max_away_s": -1.0}],
)
def test_options_that_cannot_work_are_refused(option):
    with pytest.raises(InputError, match=f"{next(iter(option))}.* expected"):
        LiveOptions(**option)
