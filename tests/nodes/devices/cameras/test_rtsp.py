"""RTSP against a real server. Without Debian's GStreamer packages these tests are skipped, and say so."""

import gc
import logging
import os
import socket
import threading
import time
import traceback
from contextlib import ExitStack
from itertools import islice, pairwise

import av.error
import numpy as np
import pytest

from nodes.devices.cameras.connection import ConnectionLostError
from nodes.devices.cameras.ffmpeg_errors import source_error_of
from nodes.devices.cameras.live_options import LiveOptions, Transport
from nodes.devices.cameras.live_video import open_live
from nodes.devices.errors import SourceError
from nodes.frames import PixelFormat, StampOrigin
from tests.nodes.devices.rtsp_server import RtspServer, drawn_ns, why_not

USER, PASSWORD = "someone", "hunter2"
PERIOD_MS = 40.0
# The server stamps a picture when it is pushed, at once after it was drawn, and its report relates the clocks to the
# microsecond: only a wait of the server's thread between the two is left, a few ms on a busy machine. A stamp of the
# neighbouring picture is a whole period off: half a period tells the two apart.
STAMP_MS = PERIOD_MS / 2


@pytest.fixture(scope="module")
def server():
    if reason := why_not():
        pytest.skip(reason)
    with RtspServer() as running:
        yield running


@pytest.fixture
def restartable():
    """A server of its own for tests that freeze or kill it."""
    if reason := why_not():
        pytest.skip(reason)
    servers = [RtspServer()]
    yield servers
    servers[-1].close()


@pytest.fixture(scope="module")
def captured(server):
    """Frames of both codecs by both transports, with the time drawn into each, and the sources; all at once."""
    ways = [(codec, transport) for codec in ("h264", "h265") for transport in Transport]
    with ExitStack() as stack:
        sources = {}
        for codec, transport in ways:
            options = LiveOptions(transport=transport, n_queued=1000)
            sources[codec, transport] = stack.enter_context(open_live(server.url(codec), options))
        return {
            way: (source, [(frame, drawn_ns(frame)) for frame in islice(source, 15)]) for way, source in sources.items()
        }


@pytest.mark.parametrize("transport", Transport)
@pytest.mark.parametrize("codec", ["h264", "h265"])
def test_frames_come_in_order_with_the_cameras_clock(server, captured, codec, transport):
    source, frames = captured[codec, transport]
    assert (source.size_px, source.rate_hz, source.name) == ((320, 240), 25.0, server.url(codec))
    assert (source.counts.delivered, source.counts.reconnects) == (15, 0)
    kept = [frame for frame, _ in frames]
    assert {frame.origin for frame in kept} == {StampOrigin.CAMERA}
    assert {(frame.pixel_format, frame.image.shape, frame.is_full_range) for frame in kept} == {
        (PixelFormat.YUV420, (360, 320), False)
    }
    assert kept[0].sequence == 0
    assert all(later.sequence > earlier.sequence for earlier, later in pairwise(kept))
    assert all(later.stamp_ns > earlier.stamp_ns for earlier, later in pairwise(kept))
    assert all(later > earlier for (_, earlier), (_, later) in pairwise(frames))
    errors_ms = np.array([frame.stamp_ns - drawn for frame, drawn in frames]) / 1e6
    assert abs(np.median(errors_ms)) < STAMP_MS


def test_closing_leaves_neither_thread_nor_file(server):
    def now():
        gc.collect()  # what is left in cycles of earlier tests is none of this one's
        return len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))

    with open_live(server.url("h264")):  # what the first use loads for good is not counted
        pass
    before = now()
    for codec in ("h264", "h265", "h264"):
        with open_live(server.url(codec), LiveOptions(n_decoder_threads=2)):
            pass
    for _ in range(100):  # the kernel lists a thread for a moment after it was joined
        if now() == before:
            break
        time.sleep(0.05)
    assert now() == before
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("capture")]


def test_a_wrong_password_is_refused_and_shown_nowhere(caplog, capfd):
    if reason := why_not():
        pytest.skip(reason)
    caplog.set_level(logging.DEBUG)
    with RtspServer(login=(USER, PASSWORD)) as guarded:
        with open_live(guarded.url("h264", login=f"{USER}:{PASSWORD}")) as source:
            shown = f"{source.name} {source!r} {source}"
        with pytest.raises(SourceError, match="refuses user name or password") as caught:
            open_live(guarded.url("h264", login=f"{USER}:{PASSWORD}no"))
        with pytest.raises(SourceError, match="refuses user name or password"):
            open_live(guarded.url("h264"))
        assert not isinstance(caught.value, ConnectionLostError)  # trying again would lock the account
    shown += "".join(traceback.format_exception(caught.value)) + repr(caught.value)
    shown += caplog.text + "".join(capfd.readouterr())
    assert PASSWORD not in shown
    assert USER not in shown


def test_what_cannot_be_played_is_refused_at_once(server):
    with pytest.raises(SourceError, match="no stream at this path"):
        open_live(server.url("nothing"))
    with pytest.raises(SourceError, match="codec is mjpeg; expected h264 or hevc"):
        open_live(server.url("mjpeg"))


def test_a_port_where_nothing_listens_is_said_without_the_password():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(SourceError, match=rf"127\.0\.0\.1:{port}/live: nothing listens there") as caught:
        open_live(f"rtsp://{USER}:{PASSWORD}@127.0.0.1:{port}/live")
    assert PASSWORD not in "".join(traceback.format_exception(caught.value))


def test_a_camera_that_accepts_and_says_nothing_is_given_up():
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1]
        with pytest.raises(SourceError, match=r"no answer or data for 0\.3 s"):
            open_live(f"rtsp://{USER}:{PASSWORD}@127.0.0.1:{port}/live", LiveOptions(timeout_s=0.3))


def test_a_killed_and_restarted_server_is_reconnected(restartable):
    port = restartable[0].port
    options = LiveOptions(clock_wait_s=0.0)  # arrival stamps: no need to wait for the server's report
    with open_live(restartable[0].url("h264"), options) as source:
        frames = iter(source)
        before = [next(frames) for _ in range(5)]
        restartable[0].close()
        restartable.append(RtspServer(port=port))
        after = [next(frames)]
        while source.counts.reconnects == 0:
            after.append(next(frames))
        after += [next(frames) for _ in range(5)]
    assert source.counts.reconnects == 1
    kept = [*before, *after]
    assert all(later.sequence > earlier.sequence for earlier, later in pairwise(kept))
    assert all(later.stamp_ns > earlier.stamp_ns for earlier, later in pairwise(kept))
    assert {frame.origin for frame in kept} == {StampOrigin.ARRIVAL}


def test_a_frozen_server_is_noticed_and_the_source_ends_when_it_stays_so(restartable):
    with ExitStack() as stack:
        sources = []
        for transport in Transport:
            options = LiveOptions(transport=transport, timeout_s=1.5, max_away_s=0.5, clock_wait_s=0.0)
            sources.append(stack.enter_context(open_live(restartable[0].url("h264"), options)))
            next(iter(sources[-1]))
        restartable[0].freeze()
        for source in sources:
            with pytest.raises(SourceError, match=r"away for more than 0\.5 s; the last attempt: .*no answer or data"):
                list(source)
    restartable[0].thaw()


@pytest.mark.parametrize(
    "name",
    [
        "HTTPUnauthorizedError",
        "HTTPNotFoundError",
        "ExitError",
        "InvalidDataError",
        "ConnectionRefusedError",
        "OSError",
    ],
)
def test_no_error_of_ffmpeg_shows_the_address(name):
    address = f"rtsp://{USER}:{PASSWORD}@camera/live?password={PASSWORD}"
    error = getattr(av.error, name)(5, f"could not open {address}", address)
    shown = str(source_error_of(error, "rtsp://camera/live"))
    assert "rtsp://camera/live" in shown
    assert PASSWORD not in shown


def test_only_what_will_not_cure_itself_is_final():
    for name in ("HTTPNotFoundError", "ExitError", "InvalidDataError", "ConnectionRefusedError", "OSError"):
        assert isinstance(source_error_of(getattr(av.error, name)(5, "x"), "x"), ConnectionLostError)
    for name in ("HTTPUnauthorizedError", "HTTPForbiddenError", "DecoderNotFoundError"):
        error = source_error_of(getattr(av.error, name)(5, "x"), "x")
        assert not isinstance(error, ConnectionLostError)
