"""Recordings are played at their own pace, from the beginning whenever a session begins."""

import cv2
import numpy as np
import pytest

from nodes.camera.feeds import LiveFeed, RecordingFeed, open_feed
from nodes.camera.session_marks import SessionMark
from nodes.devices.errors import SourceError
from nodes.frames import Frame, PixelFormat, SourceCounts, StampOrigin
from nodes.site.model import CameraSourceConfig

N_FRAMES = 6
BEGAN_NS = 1_700_000_000 * 10**9


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Images without stamps."""
    path = tmp_path_factory.mktemp("images")
    for k in range(N_FRAMES):
        cv2.imwrite(str(path / f"{k:04d}.png"), np.full((24, 32), k, np.uint8))
    return path


class Clock:
    """Wall time that passes a little with every look."""

    def __init__(self):
        self.ns = BEGAN_NS

    def __call__(self):
        self.ns += 10_000_000
        return self.ns


def test_nothing_comes_before_a_session(folder):
    feed = RecordingFeed(str(folder), None)
    frames = feed.frames()
    assert [next(frames) for _ in range(2)] == [None, None]
    feed.close()
    assert list(frames) in ([], [None])


def test_frames_come_at_their_time_with_stamps_of_now(folder):
    clock = Clock()
    feed = RecordingFeed(str(folder), None, clock_ns=clock)
    feed.begin()
    came = []
    for frame in feed.frames():
        if frame is not None:
            came.append((frame.sequence, frame.stamp_ns - feed.began_ns))
            assert clock.ns >= frame.stamp_ns
        elif came:
            feed.close()
    assert [sequence for sequence, _ in came] == list(range(N_FRAMES))
    steps = np.diff([since_ns for _, since_ns in came])
    assert came[0][1] == 0
    assert (steps > 0).all()


def test_a_session_that_goes_on_has_the_same_stamps(folder):
    mark = SessionMark("s", 0, BEGAN_NS)
    stamps = []
    for _ in range(2):
        feed = RecordingFeed(str(folder), mark)
        frames = feed.frames()
        # Long past: all frames come at once.
        stamps.append([frame.stamp_ns for frame in (next(frames) for _ in range(N_FRAMES)) if frame is not None])
        feed.close()
        list(frames)
    assert stamps[0] == stamps[1]
    assert stamps[0][0] == BEGAN_NS


def test_another_session_begins_at_the_first_frame_again(folder):
    feed = RecordingFeed(str(folder), SessionMark("s", 0, BEGAN_NS))
    frames = feed.frames()
    assert [frame.sequence for frame in (next(frames), next(frames)) if frame] == [0, 1]
    feed.begin()
    frame = next(frame for frame in frames if frame is not None)
    assert (frame.sequence, feed.n_plays) == (0, 2)
    feed.close()
    list(frames)


class Source:
    """Two frames, then whatever `end` does."""

    name, size_px, rate_hz, counts = "fake", (32, 24), None, SourceCounts()

    def __init__(self):
        self.is_closed = False

    def __iter__(self):
        for k in range(2):
            yield Frame(k, BEGAN_NS + k, StampOrigin.DRIVER, np.zeros((24, 32), np.uint8), PixelFormat.MONO)

    def close(self):
        self.is_closed = True

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        self.close()


def test_a_live_camera_that_ends_is_a_failure():
    feed = LiveFeed(Source())
    with pytest.raises(SourceError, match="the camera ended"):
        list(feed.frames())
    assert feed.rate_hz == 0.0


def test_a_live_camera_that_was_closed_is_none():
    source = Source()
    feed = LiveFeed(source)
    frames = feed.frames()
    next(frames)
    feed.close()
    list(frames)
    assert source.is_closed


def test_what_is_configured_decides(folder):
    assert isinstance(open_feed(CameraSourceConfig(name="C0", source=str(folder)), None), RecordingFeed)
