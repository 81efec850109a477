import numpy as np
import pytest

from network_calib.errors import InputError
from network_calib.timing import frame_interval_ns, group_by_stamp

MS = 1_000_000


def test_stamps_within_the_tolerance_form_one_instant():
    stamp = np.array([0, 3, 40, 41, 44, 80]) * MS
    camera = np.array([0, 1, 1, 0, 2, 0])
    assert group_by_stamp(stamp, camera, tolerance_ns=5 * MS).tolist() == [0, 0, 1, 1, 1, 2]


def test_a_gap_of_exactly_the_tolerance_is_bridged_and_one_more_is_not():
    stamp, camera = np.array([0, 100]), np.array([0, 1])
    assert group_by_stamp(stamp, camera, tolerance_ns=100).tolist() == [0, 0]
    assert group_by_stamp(stamp, camera, tolerance_ns=99).tolist() == [0, 1]


def test_order_of_the_rows_does_not_matter():
    rng = np.random.default_rng(1)
    frame, camera = np.nonzero(rng.random((300, 4)) < 0.8)
    stamp = 10**18 + frame * 20 * MS + rng.integers(-2 * MS, 2 * MS, len(frame))
    expected = np.unique(frame, return_inverse=True)[1]
    shuffled = rng.permutation(len(frame))
    assert np.array_equal(group_by_stamp(stamp[shuffled], camera[shuffled]), expected[shuffled])


def test_frame_interval_is_that_of_the_camera_that_sees_most():
    stamp = np.concatenate([np.arange(50) * 40, np.arange(10) * 200]) * MS
    camera = np.repeat([0, 1], [50, 10])
    assert frame_interval_ns(stamp, camera) == 40 * MS


def test_two_detections_of_one_camera_in_an_instant_are_refused_by_name():
    stamp, camera = np.array([0, 2, 4]) * MS, np.array([0, 1, 0])
    with pytest.raises(InputError, match=r"camera 'left' has detections at 0 ns and 4000000 ns in one instant"):
        group_by_stamp(stamp, camera, tolerance_ns=3 * MS, camera_names=("left", "right"))


def test_unknown_interval_is_refused_and_nothing_is_nothing():
    with pytest.raises(InputError, match="no camera has two detections"):
        group_by_stamp(np.array([0, 1]), np.array([0, 1]))
    assert len(group_by_stamp(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))) == 0
