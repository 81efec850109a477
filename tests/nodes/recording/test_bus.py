"""`info`, `replay` and `record`; the last two over a real bus, each in its own thread."""

import threading
from collections import Counter

import pytest

from network_calib.errors import InputError
from nodes.bus.keys import Keys, Kind
from nodes.bus.seal import seal
from nodes.bus.session import BusOptions, open_bus
from nodes.recording.reader import Row, rows
from nodes.recording.record import Arrived, Recorder, record
from nodes.recording.replay import in_time, paced
from nodes.recording.session_data import read_session
from nodes.recording.writer import RecordingWriter
from tests.nodes.bus.buses import routed, wait_until
from tests.nodes.recording.conftest import FRAME_NS, START_NS

TIMEOUT_S = 60


@pytest.fixture
def session(recorded, node):
    """300 batches of two cameras, an LRF, and the state of the coordinator; late rows stand behind."""
    cameras = [node("n0"), node("n1", b"\x02" * 16)]
    for k in range(150):
        cameras[0].batch(2 * k)
        cameras[1].batch(2 * k, camera="C1")
    lrf = node("n2", b"\x03" * 16)
    lrf.info()
    lrf.tilt(0)
    lrf.tilts(0.5)
    del cameras[1].rows[20:23]
    return recorded([*cameras[1].rows, *cameras[0].rows, *lrf.rows], site="name = 'lab'")


def test_info_tells_what_is_there_and_what_is_not(session, spotcal):
    status, out, err = spotcal("info", session)
    assert (status, err) == (0, "")
    assert "session s1: 300 rows, with site.toml, recorded by spotcal" in out
    lines = out.splitlines()
    # 150 batches of two frames at 20 Hz: 14.9 s between the first and the last.
    assert any(line.split() == ["n0", "01010101", "150", "spots", "10.0", "14.9", "0"] for line in lines)
    assert any(line.split()[:3] == ["n1", "02020202", "147"] and line.split()[-1] == "3" for line in lines)
    assert any(line.split()[:5] == ["C0", "640", "x", "480", "300"] for line in lines)
    assert any(line.split() == ["L0", "URG", "7", "28.65", "0"] for line in lines)
    assert "missing: n1, boot 02020202: 20 to 22 (3)" in out


def test_info_of_nothing_is_an_error_with_advice(tmp_path, spotcal):
    status, _, err = spotcal("info", tmp_path)
    assert status == 2
    assert "holds no recording" in err


def test_rows_are_replayed_at_the_pace_of_their_stamps(session):
    ordered = in_time(session)
    assert [row.publish_ns for row in ordered] == sorted(row.publish_ns for row in rows(session))
    now_s, waits = [100.0], []

    def wait(seconds):
        waits.append(seconds)
        now_s[0] += seconds + 0.001
        return False

    told = [(row, now_s[0]) for row in paced(ordered, speed=4, wait=wait, clock_s=lambda: now_s[0])]
    assert [row for row, _ in told] == ordered
    for row, at_s in told:
        # A millisecond is lost at each wait, and made up for at the next; rows of one instant come one after another.
        late_s = at_s - (100 + (row.publish_ns - START_NS) * 1e-9 / 4)
        assert -1e-6 < late_s < 0.02
    assert sum(waits) <= 149 * 2 * FRAME_NS * 1e-9 / 4


def test_a_replay_that_is_told_to_stop_stops():
    ordered = [Row("k", b"", k, k) for k in range(10)]
    stopped = iter([False, False, True])
    assert len(list(paced(ordered, speed=0, wait=lambda _: next(stopped)))) == 2


def test_the_recorder_takes_whole_messages_and_counts_the_others(tmp_path, node):
    camera = node("n0")
    key, payload, stamp_ns = camera.batch(0)
    arrival_ns = stamp_ns + 1
    with RecordingWriter(tmp_path / "s") as writer:
        recorder = Recorder(writer, Keys("lab"))
        for one in (
            Arrived(key, payload, None, arrival_ns),
            Arrived(key, payload, seal(payload), arrival_ns),
            Arrived(key, payload, b"1234", arrival_ns),
            Arrived(key, payload[:-3], None, arrival_ns),
            Arrived("spotcal/@v1/lab/node/n0/obs/nonsense", payload, None, arrival_ns),
            Arrived(key, payload, None, stamp_ns - 3600 * 10**9),
        ):
            recorder.take(one)
    assert recorder.n_rows == 2
    assert recorder.refused == {
        "seal: broken": 1,
        "message: no protobuf of its type": 1,
        "key: of no observation": 1,
        "header.stamp_ns: in the future": 1,
    }
    # The merge drops the doubled one.
    assert [row.payload for row in rows(tmp_path / "s")] == [payload]


def test_what_is_replayed_is_recorded_as_it_was(session, tmp_path, spotcal):
    stop, done = threading.Event(), []
    n_rows = sum(1 for _ in rows(session))
    has_all = threading.Event()

    def told(recorder):
        if recorder.n_rows >= n_rows:
            has_all.set()

    def run():
        done.append(record(bus, tmp_path / "again", stop=stop, told=told))

    with routed() as endpoint:
        bus = BusOptions(site="lab", endpoints=(endpoint,))
        recording = threading.Thread(target=run)
        recording.start()
        try:
            _wait_for_subscribers(bus)
            status, _, err = spotcal("replay", session, "--speed", 0, "--router", endpoint)
            assert (status, err.split("\n")[-2]) == (0, f"{n_rows} of {n_rows} messages published")
            assert has_all.wait(TIMEOUT_S)
        finally:
            stop.set()
            recording.join(TIMEOUT_S)
    (recorded,) = done
    assert (recorded.n_rows, recorded.refused) == (n_rows, Counter())
    assert Counter((row.key, row.payload, row.publish_ns) for row in rows(recorded.path)) == Counter(
        (row.key, row.payload, row.publish_ns) for row in rows(session)
    )
    before, after = read_session(session), read_session(recorded.path)
    assert [one.sequence.tolist() for one in after.cameras] == [one.sequence.tolist() for one in before.cameras]
    assert after.missing == before.missing
    assert after.session == "s1"


def _wait_for_subscribers(bus):
    with open_bus(bus) as session:
        publisher = session.declare_publisher(Keys(bus.site).observation("n0", Kind.SPOTS))
        is_heard = lambda: publisher.matching_status.matching  # noqa: E731  # pyright: ignore[reportAttributeAccessIssue]
        wait_until(is_heard, "the recorder's subscription")


def test_a_site_that_cannot_be_one_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(InputError, match="cannot stand in a key"):
        record(BusOptions(site="a b"), tmp_path / "s", stop=threading.Event(), told=lambda _: None)
    assert not (tmp_path / "s").exists()
