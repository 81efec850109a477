"""Frames of several recordings that show one instant."""

import numpy as np
import pytest

from network_calib.errors import InputError
from nodes.camera.camera_detections import CameraDetections
from nodes.camera.matching_frames import candidates_of, match_frames
from nodes.frames import StampOrigin

PERIOD_NS = 40_000_000


def recording(name, sequence, *, origin=StampOrigin.FILE, stamp_ns=None, rate_hz=25.0, n_dropped=0):
    """One candidate in every frame, at (sequence, 0)."""
    sequence = np.asarray(sequence, dtype=np.int64)
    n = len(sequence)
    return CameraDetections(
        name=name,
        source=f"{name}.mp4",
        size_px=(640, 480),
        rate_hz=rate_hz,
        origin=origin,
        sequence=sequence,
        stamp_ns=sequence * PERIOD_NS if stamp_ns is None else np.asarray(stamp_ns, dtype=np.int64),
        picture=np.arange(n),
        px=np.stack([sequence, np.zeros(n)], axis=1).astype(np.float64),
        sigma_px=np.full(n, 0.2),
        score=np.full(n, 0.5),
        n_dropped=n_dropped,
    )


def stamped(name, instants, *, jitter_ns=0, offset_ns=10**18, origin=StampOrigin.TABLE):
    """A camera that saw these instants, its own frame counter starting anywhere."""
    instants = np.asarray(instants)
    jitter = np.random.default_rng(len(name)).integers(-jitter_ns, jitter_ns + 1, len(instants))
    return recording(
        name, 100 + np.arange(len(instants)), origin=origin, stamp_ns=offset_ns + instants * PERIOD_NS + jitter
    )


def test_videos_are_matched_by_number():
    a, b = recording("A", range(10)), recording("B", [0, 1, 2, 5, 6, 7])
    matched = match_frames([a, b])
    assert [frame.tolist() for frame in matched.frames] == [a.sequence.tolist(), b.sequence.tolist()]
    assert not matched.is_by_stamp
    assert "frame 0 of each must show the same instant" in matched.notes[0]
    assert "frames: A 10, B 6" in matched.notes[1]
    assert candidates_of([a, b], matched).stamp_ns is None


def test_stamps_of_a_clock_are_matched_whatever_the_counters_say():
    # 2 ms of jitter against a quarter of 40 ms. Instant 3 is lost to all: the numbers step over it all the same.
    a = stamped("A", [0, 1, 2, 4, 5, 6, 9], jitter_ns=2_000_000)
    b = stamped("BB", [1, 2, 4, 6, 7, 8, 9], jitter_ns=2_000_000)
    matched = match_frames([a, b])
    assert [frame.tolist() for frame in matched.frames] == [[0, 1, 2, 4, 5, 6, 9], [1, 2, 4, 6, 7, 8, 9]]
    assert matched.is_by_stamp
    table = candidates_of([a, b], matched)
    assert table.stamp_ns is not None
    # Each candidate bears its own picture's number: the x of the picture's counter goes with its instant.
    for camera, one in enumerate((a, b)):
        rows = table.camera == camera
        assert np.array_equal(table.px[rows, 0], one.sequence)
        assert np.array_equal(table.frame[rows], matched.frames[camera])


def test_one_source_without_a_clock_leaves_only_the_numbers():
    a = stamped("A", range(5))
    b = recording("B", range(100, 105), origin=StampOrigin.ORDER)
    assert not match_frames([a, b]).is_by_stamp


def test_stamps_that_step_unevenly_are_counted():
    # The pointer's owner stepped the camera by hand: instants 10 s, then 0.3 s apart.
    stamp_ns = np.array([0, 10, 10.3, 20, 30]) * 10**9
    a = recording("A", range(5), origin=StampOrigin.TABLE, stamp_ns=stamp_ns)
    b = recording("B", range(5), origin=StampOrigin.TABLE, stamp_ns=stamp_ns)
    matched = match_frames([a, b], tolerance_ns=10**7)
    assert matched.frames[0].tolist() == [0, 1, 2, 3, 4]


def test_free_running_cameras_are_refused_by_name():
    a, b = stamped("A", range(20)), stamped("B", range(20), offset_ns=10**18 + 9_000_000)
    c = stamped("C", range(20), offset_ns=10**18 + 18_000_000)
    d, e = (stamped(n, range(20), offset_ns=10**18 + o) for n, o in (("D", 27_000_000), ("E", 36_000_000)))
    with pytest.raises(InputError, match="no tolerance separates"):
        match_frames([a, b, c, d, e])


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ([recording("B", range(10), rate_hz=30.0)], "A has 25 frames a second and B has 30"),
        ([recording("B", range(10, 20))], "no frame of A, B has the number of a frame of another camera"),
        ([recording("B", range(9)), recording("C", range(50, 60))], "no frame of C has the number"),
    ],
)
def test_recordings_that_do_not_fit_are_refused(others, message):
    with pytest.raises(InputError, match=message):
        match_frames([recording("A", range(10)), *others])


def test_stamps_of_other_days_are_refused():
    with pytest.raises(InputError, match="no frame of A, B has the stamp"):
        match_frames([stamped("A", range(9)), stamped("B", range(9), offset_ns=2 * 10**18)])


def test_ntsc_rates_are_one_rate():
    pair = recording("A", range(9), rate_hz=29.97), recording("B", range(9), rate_hz=30.0)
    assert len(match_frames(pair).frames) == 2


def test_unreadable_frames_are_told():
    notes = match_frames([recording("A", range(9), n_dropped=3), recording("B", range(9))]).notes
    assert "frames that could not be read: A 3" in notes


def test_gaps_in_the_times_of_a_file_are_lost_frames():
    taken = np.array([0, 1, 2, 5, 6, 7])
    # A container that counts milliseconds at 30 Hz: steps of 33 and 34.
    stamp_ns = np.rint(taken * 1000 / 30).astype(np.int64) * 10**6
    a = recording("A", range(6), stamp_ns=stamp_ns, rate_hz=30.0)
    b = recording("B", range(8), stamp_ns=np.arange(8) * 33_333_333, rate_hz=30.0)
    matched = match_frames([a, b])
    assert matched.frames[0].tolist() == taken.tolist()
    assert matched.frames[1].tolist() == list(range(8))
    assert "A: by the times in the file 2 frames were never recorded" in matched.notes


def test_damaged_frames_leave_the_gap_that_the_source_counts():
    a = recording("A", [0, 1, 4, 5])
    assert match_frames([a, recording("B", range(6))]).frames[0].tolist() == [0, 1, 4, 5]


def test_uneven_times_of_a_file_say_nothing():
    a = recording("A", range(6), stamp_ns=np.cumsum([0, 40, 54, 66, 40, 40]) * 10**6)
    assert match_frames([a, recording("B", range(6))]).frames[0].tolist() == list(range(6))
