import random
from collections import Counter

import numpy as np
import pytest

from nodes.bus import spotcal_pb2 as pb
from nodes.frames import StampOrigin
from nodes.recording.session_data import read_session
from tests.nodes.recording.conftest import FRAME_NS, START_NS


def same(one, other):
    """Two sets of columns are equal, bit for bit."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if hasattr(one, "__slots__") and not isinstance(one, Counter | pb.LrfInfo):
        return all(same(getattr(one, name), getattr(other, name)) for name in one.__slots__)
    return one == other


def test_batches_become_the_columns_of_the_detector(recorded, node):
    camera = node("n0")
    camera.batch(0, 3, spots=[(0, 1.0, 2.0, 0.1, 0.9), (0, 3.0, 4.0, 0.2, 0.5), (2, 5.0, 6.0, 0.3, 0.8)], n_dropped=1)
    # A smear of more than MAX_SIGMA_PX is left out, as the detector's own tables do.
    camera.batch(3, 2, spots=[(1, 7.0, 8.0, 2.0, 0.7), (1, 9.0, 9.0, 2.01, 0.7)], n_dropped=4)
    data = read_session(recorded(camera.rows, site="name = 'lab'"))
    (found,) = data.cameras
    assert (data.session, data.site_toml, data.n_rows) == ("s1", "name = 'lab'", 2)
    assert (found.name, found.size_px, found.rate_hz, found.origin) == ("C0", (640, 480), 20, StampOrigin.CAMERA)
    assert found.sequence.tolist() == [0, 1, 2, 3, 4]
    assert found.stamp_ns.tolist() == [START_NS + k * FRAME_NS for k in range(5)]
    assert found.picture.tolist() == [0, 0, 2, 4]
    assert found.px.tolist() == [[1, 2], [3, 4], [5, 6], [7, 8]]
    assert found.sigma_px.tolist() == [0.1, 0.2, 0.3, 2.0]
    assert found.score.tolist() == [0.9, 0.5, 0.8, 0.7]
    assert found.n_dropped == 4
    assert not data.refused
    assert data.missing == ()


def all_rows(node):
    """Two cameras, one of them restarted, and an LRF."""
    first, second, lrf = node("n0"), node("n1", b"\x02" * 16), node("n2", b"\x03" * 16)
    for k in range(6):
        first.batch(2 * k, spots=[(0, k + 0.25, 1.0, 0.2, 0.9), (1, k + 0.5, 2.0, 0.2, 0.9)])
        second.batch(2 * k, camera="C10")
    again = first.restarted(b"\x00")
    for k in range(3):
        again.batch(2 * k, begin_ns=START_NS + 20 * FRAME_NS)
    lrf.info()
    for setting in (0, 1):
        lrf.tilt(setting)
        lrf.lrf_spot(setting, 1.0 + setting)
    lrf.tilts(0.1, 0.2)
    return [*first.rows, *second.rows, *again.rows, *lrf.rows]


def test_the_order_of_arrival_and_doubled_rows_make_no_difference(recorded, node):
    sent = all_rows(node)
    expected = read_session(recorded(sent))
    assert len(expected.cameras) == 2
    assert len(expected.lrfs[0].spots) == 2
    for seed in range(5):
        shuffled = random.Random(seed).sample([*sent, *sent[::3]], len(sent) + len(sent[::3]))
        found = read_session(recorded(shuffled, f"shuffled{seed}"))
        assert same((found.cameras, found.lrfs, found.missing), (expected.cameras, expected.lrfs, expected.missing))
        assert not found.refused


def test_a_restarted_camera_goes_on_by_the_time_that_passed(recorded, node):
    before = node("n0", b"\x09" * 16)
    before.batch(0, 4, camera="C2")
    # The later boot has the lesser bytes: time decides. Its numbers begin anew, 6 frames after the last.
    after = before.restarted(b"\x01")
    after.batch(0, 4, camera="C2", begin_ns=START_NS + 9 * FRAME_NS)
    (found,) = read_session(recorded([*after.rows, *before.rows])).cameras
    assert found.sequence.tolist() == [0, 1, 2, 3, 9, 10, 11, 12]
    assert found.stamp_ns.tolist() == [START_NS + int(k) * FRAME_NS for k in found.sequence]
    assert found.picture.tolist() == [0, 4]
    assert found.notes == ("C2: started 2 times",)


@pytest.mark.parametrize("begin_ns", [START_NS, START_NS - 5 * FRAME_NS])
def test_a_source_that_starts_again_within_a_boot_never_repeats_a_number(recorded, node, begin_ns):
    camera = node("n0")
    camera.batch(7, 3)
    camera.batch(0, 3, begin_ns=begin_ns + FRAME_NS // 2)
    (found,) = read_session(recorded(camera.rows)).cameras
    assert len(set(found.sequence.tolist())) == 6
    assert (np.diff(found.sequence) > 0).all()


def test_a_restart_in_another_century_stays_within_the_numbers(recorded, node):
    camera = node("n0")
    camera.batch(0, 4, spots=(), frame_stamp_ns=[START_NS + k for k in range(4)])
    camera.batch(0, 4, spots=(), begin_ns=946_684_801 * 10**9)
    (found,) = read_session(recorded(camera.rows)).cameras
    assert (np.diff(found.sequence) > 0).all()
    assert found.sequence[-1] < 2**33


def test_the_worst_origin_of_a_camera_counts(recorded, node):
    camera = node("n0")
    camera.batch(0, origin=pb.STAMP_ORIGIN_CAMERA)
    camera.batch(2, origin=pb.STAMP_ORIGIN_ARRIVAL)
    camera.batch(4, origin=pb.STAMP_ORIGIN_DRIVER)
    assert read_session(recorded(camera.rows)).cameras[0].origin is StampOrigin.ARRIVAL


def test_bad_rows_are_refused_and_counted_and_stand_as_missing(recorded, node):
    camera = node("n0")
    sent = [camera.batch(2 * k) for k in range(6)]
    key, _, stamp_ns = sent[0]
    outside = pb.SpotBatch.FromString(sent[2][1])
    outside.x_px[0] = float("nan")
    strange = [
        (key, outside.SerializeToString(), stamp_ns),
        (key, b"\xff\xff\xff", stamp_ns),
        (key.replace("n0", "n9"), sent[1][1], stamp_ns),
        ("another/key", b"x", stamp_ns),
        ("spotcal/@v1/lab/session/state", b"", stamp_ns),
    ]
    data = read_session(recorded([*sent[:2], *sent[3:], *strange]))
    assert data.refused == {
        "spots: x_px: out of bounds": 1,
        "spots: message: no protobuf of its type": 1,
        "spots: header.node: not the key's": 1,
        "key: of no observation": 1,
    }
    assert [(gap.node, gap.boot, gap.first, gap.last) for gap in data.missing] == [("n0", camera.boot, 2, 2)]
    assert data.cameras[0].sequence.tolist() == [0, 1, 2, 3, 6, 7, 8, 9, 10, 11]


def test_a_row_told_twice_and_differently_counts_once_whichever_came_first(recorded, node):
    one, other = node("n0"), node("n0")
    one.batch(0)
    other.batch(0, spots=[(0, 99.0, 99.0, 0.2, 0.9)])
    found = [
        read_session(recorded(sent, name, is_merged=False))
        for sent, name in (([*one.rows, *other.rows], "a"), ([*other.rows, *one.rows, *other.rows], "b"))
    ]
    assert same(found[0].cameras, found[1].cameras)
    assert found[0].refused == found[1].refused == {"header.sequence: told twice, differently": 1}


def test_rows_of_another_session_are_left_out_but_fill_the_gaps(recorded, node):
    camera = node("n0")
    camera.batch(0)
    camera.session = "s0"
    camera.batch(2)
    camera.session = "s1"
    camera.batch(4)
    data = read_session(recorded(camera.rows))
    assert data.cameras[0].sequence.tolist() == [0, 1, 4, 5]
    assert data.refused == {"header.session: another session": 1}
    assert data.missing == ()


def test_without_an_id_the_session_of_most_rows_is_read(recorded, node):
    camera = node("n0", session="a")
    camera.batch(0)
    camera.session = "b"
    camera.batch(2)
    camera.batch(4)
    data = read_session(recorded(camera.rows, session=""))
    assert (data.session, data.cameras[0].sequence.tolist()) == ("b", [2, 3, 4, 5])


def test_pictures_of_another_size_are_left_out(recorded, node):
    camera = node("n0")
    camera.batch(0)
    camera.batch(2, width_px=1280, height_px=720)
    camera.batch(4)
    data = read_session(recorded(camera.rows))
    assert data.cameras[0].sequence.tolist() == [0, 1, 4, 5]
    assert data.refused == {"spots: width_px, height_px: not the camera's": 1}


def test_cameras_stand_in_the_order_that_a_person_counts(recorded, node):
    camera = node("n0")
    for k, name in enumerate(("C10", "C2", "C1")):
        camera.batch(2 * k, camera=name)
    assert [one.name for one in read_session(recorded(camera.rows)).cameras] == ["C1", "C2", "C10"]


def test_the_last_acquisition_that_ended_counts_with_its_own_spots(recorded, node):
    first = node("n2")
    first.info()
    first.tilt(0)
    first.lrf_spot(0, 1.0)
    first.tilts(0.5)
    # The same boot acquires again, and sends its tilts twice: the last ones count.
    for setting in (0, 1):
        first.tilt(setting)
        first.lrf_spot(setting, 2.0 + setting)
    first.tilts(0.1, 0.2)
    first.tilts(0.11, 0.21)
    # Another boot begins, and is cut off.
    cut = first.restarted(b"\x00")
    cut.tilt(0, stamp_ns=START_NS + 10**9)
    cut.lrf_spot(0, 9.0, stamp_ns=START_NS + 10**9)
    (lrf,) = read_session(recorded([*cut.rows, *first.rows])).lrfs
    assert lrf.info is not None
    assert lrf.info.product == "URG"
    assert lrf.spots.range_m.tolist() == [2.0, 3.0]
    assert lrf.spots.setting.tolist() == [0, 1]
    assert lrf.spots.bias_bound_m.tolist() == [0.0, 0.0]
    assert lrf.angle_rad.tolist() == [0.11, 0.21]
    assert np.array_equal(lrf.covariance_rad2, 1e-6 * np.eye(2))
    assert lrf.sources == ("steps",)
    assert lrf.notes == ("L0: 3 acquisitions were begun; the last one that ended counts",)


def test_an_acquisition_without_an_end_has_no_tilts_and_says_so(recorded, node):
    lrf = node("n2")
    lrf.tilt(0)
    lrf.lrf_spot(0, 1.0)
    (found,) = read_session(recorded(lrf.rows)).lrfs
    assert (len(found.spots), len(found.angle_rad), found.covariance_rad2.shape) == (1, 0, (0, 0))
    assert found.info is None
    assert "did not come to its end" in found.notes[0]


def test_a_spot_without_a_tilt_is_refused(recorded, node):
    lrf = node("n2")
    lrf.tilt(0)
    lrf.lrf_spot(0, 1.0)
    lrf.lrf_spot(1, 2.0)
    lrf.tilts(0.1)
    data = read_session(recorded(lrf.rows))
    assert data.lrfs[0].spots.setting.tolist() == [0]
    assert data.refused == {"lrf_spot: setting: without a tilt": 1}
