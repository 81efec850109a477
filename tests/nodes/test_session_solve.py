"""From what nodes recorded to what the solve asks for."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from network_calib.errors import InputError
from nodes.recording.checked_rows import MissingRows
from nodes.recording.join_cameras import join_cameras
from nodes.recording.join_lrfs import LrfRecord, LrfSpotColumns
from nodes.recording.session_data import SessionData
from nodes.session_solve import is_session, prepare
from tests.nodes.coordinator.waved_room import waved_room

TILTS_RAD = np.radians([2.0, 23.0])


@pytest.fixture(scope="module")
def waved():
    return waved_room(n_frames=120, n_cameras=3)


def session_of(waved, *, names=None, lrfs=(), missing=()):
    batches = [batch for name in names or waved.names for batch in waved.batches[name]]
    cameras = join_cameras(batches, Counter())
    return SessionData("s", "", cameras, tuple(lrfs), len(batches), Counter(), tuple(missing))


def crossings(stamp_ns, *, setting=None):
    n = len(stamp_ns)
    one = np.ones(n)
    settings = np.zeros(n, dtype=np.int64) if setting is None else np.asarray(setting)
    spots = LrfSpotColumns(
        np.asarray(stamp_ns), settings, 2 * one, 0.1 * one, 0.004 * one, 0.002 * one, 0.004 * one, 0 * one
    )
    return LrfRecord("L0", None, spots, TILTS_RAD, np.diag([1e-8, 1e-8]), ("steps",), ())


def seen_instants(waved):
    """Stamps (F,) in which two cameras or more saw the spot."""
    count = Counter(
        batch.frame_stamp_ns[k] for name in waved.names for batch in waved.batches[name] for k in batch.spot_frame
    )
    return np.array(sorted(stamp for stamp, n in count.items() if n >= 2))


def test_cameras_are_ordered_by_the_configuration_whatever_came_first(waved):
    config = waved.config.model_copy(update={"cameras": list(reversed(waved.config.cameras))})
    backwards = replace(session_of(waved), cameras=tuple(reversed(session_of(waved).cameras)))
    first, second = prepare(session_of(waved), config), prepare(backwards, config)
    assert first.resolved.observations.camera_names == tuple(reversed(waved.names))
    assert first.input_sha256 == second.input_sha256


def test_a_crossing_joins_the_nearest_instant_with_its_delay(waved):
    stamps = seen_instants(waved)
    shift_ns = 7_000_000
    prepared = prepare(session_of(waved, lrfs=[crossings(stamps[[5, 20]] + shift_ns, setting=[0, 1])]), waved.config)
    assert prepared.lrfs is not None
    spots = prepared.lrfs.spots
    observations = prepared.resolved.observations
    assert observations.stamp_ns is not None
    for row, stamp in enumerate(stamps[[5, 20]]):
        assert set(observations.stamp_ns[observations.frame == spots.frame[row]]) == {stamp}
    np.testing.assert_allclose(spots.delay_s, shift_ns / 1e9, atol=1e-6)  # rounding of seconds in a double
    np.testing.assert_array_equal(spots.setting, [0, 1])


def test_two_lrfs_keep_their_tilts_apart(waved):
    stamps = seen_instants(waved)
    other = replace(crossings(stamps[[8]]), name="L1", angle_rad=TILTS_RAD[:1], covariance_rad2=np.array([[4e-8]]))
    lrfs = prepare(session_of(waved, lrfs=[crossings(stamps[[5, 20]], setting=[0, 1]), other]), waved.config).lrfs
    assert lrfs is not None
    assert lrfs.names == ("L0", "L1")
    np.testing.assert_array_equal(lrfs.settings.scanner, [0, 0, 1])
    np.testing.assert_array_equal(lrfs.spots.setting, [0, 1, 2])
    np.testing.assert_array_equal(np.diag(lrfs.settings.covariance_rad2), [1e-8, 1e-8, 4e-8])


def test_an_acquisition_that_did_not_end_is_left_out_and_told(waved):
    unfinished = replace(crossings(seen_instants(waved)[[5]]), angle_rad=np.empty(0), covariance_rad2=np.empty((0, 0)))
    prepared = prepare(session_of(waved, lrfs=[unfinished]), waved.config)
    assert prepared.lrfs is None
    assert "L0: its acquisition did not end; left out" in prepared.notes


def test_a_camera_that_saw_nothing_is_left_out_and_told(waved):
    session = session_of(waved)
    blind = replace(
        session.cameras[2],
        picture=np.empty(0, dtype=np.int64),
        px=np.empty((0, 2)),
        sigma_px=np.empty(0),
        score=np.empty(0),
    )
    prepared = prepare(replace(session, cameras=(*session.cameras[:2], blind)), waved.config)
    assert prepared.resolved.observations.camera_names == waved.names[:2]
    assert f"{waved.names[2]}: saw no spot; left out" in prepared.notes


def test_one_seeing_camera_is_refused_with_what_each_saw(waved):
    with pytest.raises(InputError, match=rf"fewer than two cameras saw a spot: {waved.names[0]} in \d+ of 120 frames"):
        prepare(session_of(waved, names=waved.names[:1]), waved.config)


def test_what_the_recording_lacks_is_told(waved):
    gap = MissingRows("camera-C0", bytes(16), 3, 7)
    assert (
        "camera-C0: 5 of its messages are not in the recording"
        in prepare(session_of(waved, missing=[gap]), waved.config).notes
    )


def test_what_is_a_recorded_session(tmp_path):
    assert not is_session(tmp_path)
    assert is_session(tmp_path / "walk.MCAP")
    (tmp_path / "parts").mkdir()
    assert is_session(tmp_path)
