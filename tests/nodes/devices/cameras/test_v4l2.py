"""V4L2 without a camera: FFmpeg's own picture generator stands behind `av.open`, a scripted kernel behind ioctl."""

import errno
import struct
import time
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import av
import av.error
import pytest

from nodes.devices.cameras import v4l2_ioctl
from nodes.devices.cameras.connection import ConnectionLostError
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.cameras.live_video import open_live
from nodes.devices.cameras.v4l2 import CODINGS, V4l2Connection, wall_ns_of
from nodes.devices.errors import SourceError
from nodes.frames import FrameSettings, PixelFormat, StampOrigin

SIZE_PX, RATE_HZ = (64, 48), 30


class FakeContainer:
    """An opened device: generated pictures, with stamps in µs as the V4L2 demuxer gives them."""

    def __init__(self, coding, stamps_us, end):
        graph = f"testsrc=size={SIZE_PX[0]}x{SIZE_PX[1]}:rate={RATE_HZ},format={coding}"
        self._real = av.open(graph, format="lavfi")
        self._stamps_us, self._end = stamps_us, end
        self.streams = self._real.streams
        self.is_closed = False

    def demux(self, stream):
        for packet, stamp_us in zip(self._real.demux(stream), self._stamps_us, strict=False):
            packet.time_base, packet.pts, packet.dts = Fraction(1, 10**6), stamp_us, stamp_us
            yield packet
        if self._end is not None:
            raise self._end

    def close(self):
        self._real.close()
        self.is_closed = True


def connection(*, coding="yuyv422", stamps_us=(1, 2, 3), end=None, options=None, ioctl=None, path="/dev/null"):
    asked = {}

    def av_open(path, **arguments) -> Any:
        asked.update(arguments, path=path)
        return FakeContainer(coding, stamps_us, end)

    given = {} if ioctl is None else {"ioctl": ioctl}
    return V4l2Connection(path, options or LiveOptions(), av_open=av_open, **given), asked


def shots_of(connection):
    return [shot for shot in connection.shots() if shot is not None]


def no_control(_device, _request, _buffer):
    raise OSError(errno.EINVAL, "no such control")


def refusing(number):
    def av_open(path, **_arguments):
        raise av.error.FFmpegError(number, "refused", path)

    return av_open


def test_size_rate_and_coding_are_asked_for():
    options = LiveOptions(size_px=(1280, 720), rate_hz=29.97, coding="mjpeg")
    opened, asked = connection(options=options)
    assert (asked["path"], asked["format"]) == ("/dev/null", "v4l2")
    assert asked["options"] == {"video_size": "1280x720", "framerate": "29.97", "input_format": "mjpeg"}
    assert connection()[1]["options"] == {}
    assert (opened.size_px, opened.rate_hz) == (SIZE_PX, RATE_HZ)
    opened.close()


def test_kernel_stamps_on_the_monotonic_clock_become_wall_clock():
    second, wall_ns, monotonic_ns = 10**9, 1_800_000_000 * 10**9, 5000 * 10**9
    assert wall_ns_of(4990 * second, monotonic_ns=monotonic_ns, wall_ns=wall_ns) == wall_ns - 10 * second


def test_shots_have_the_drivers_stamp_on_the_wall_clock():
    now_us = time.monotonic_ns() // 1000
    shots = shots_of(connection(stamps_us=[now_us - 66_000, now_us - 33_000, now_us], ioctl=no_control)[0])
    assert {shot.origin for shot in shots} == {StampOrigin.DRIVER}
    # The machine was not started within this minute of 1970: a stamp on the wrong clock is off by years.
    assert all(abs(shot.stamp_ns - time.time_ns()) < 60 * 10**9 for shot in shots)


def test_drivers_that_stamp_with_the_wall_clock_are_taken_at_their_word():
    now_us = time.time_ns() // 1000
    shots = shots_of(connection(stamps_us=[now_us, now_us + 33_000], ioctl=no_control)[0])
    assert [shot.stamp_ns for shot in shots] == [now_us * 1000, (now_us + 33_000) * 1000]


@pytest.mark.parametrize(
    ("coding", "pixel_format"),
    [("gray", PixelFormat.MONO), ("yuv420p", PixelFormat.YUV420)],
)
def test_pixel_formats_that_need_no_conversion_are_not_converted(coding, pixel_format):
    shots = shots_of(connection(coding=coding, ioctl=no_control)[0])
    assert {shot.pixels.pixel_format for shot in shots} == {pixel_format}


def test_other_codings_come_in_colour():
    shots = shots_of(connection(coding="yuyv422", ioctl=no_control)[0])
    assert len(shots) == 3
    assert all(shot.pixels.pixel_format in (PixelFormat.BGR, PixelFormat.YUV420) for shot in shots)


def test_the_exposure_is_read_back_once_a_second():
    asked = []

    def ioctl(_device, request, buffer):
        assert request == v4l2_ioctl.GET_CONTROL
        asked.append(struct.unpack("=Ii", buffer)[0])
        buffer[:] = struct.pack("=Ii", asked[-1], 156)

    shots = shots_of(connection(ioctl=ioctl)[0])
    assert [shot.settings.exposure_s for shot in shots] == [pytest.approx(0.0156)] * 3
    assert asked == [v4l2_ioctl.EXPOSURE_ABSOLUTE]


def test_a_camera_that_does_not_tell_its_exposure_has_none():
    assert {shot.settings for shot in shots_of(connection(ioctl=no_control)[0])} == {FrameSettings()}


def test_an_unplugged_camera_is_lost_not_dead():
    opened, _ = connection(end=av.error.OSError(errno.ENODEV, "No such device", "/dev/video0"), ioctl=no_control)
    shots = opened.shots()
    assert len([shot for shot in islice(shots, 6) if shot is not None]) == 3
    with pytest.raises(ConnectionLostError, match="/dev/null: the device stopped: No such device"):
        next(shots)


@pytest.mark.parametrize(
    ("number", "message", "is_final"),
    [
        (errno.EACCES, "no permission", True),
        (errno.ENOENT, "there is no such camera", False),
        (errno.EBUSY, "another program uses it", False),
        (errno.EINVAL, "cannot do video_size 9x9", True),
        (errno.EIO, "cannot be opened as a camera: refused", False),
    ],
)
def test_refusals_say_what_to_do(number, message, is_final, tmp_path):
    device = tmp_path / "video7"
    device.touch()
    with pytest.raises(SourceError, match=message) as caught:
        V4l2Connection(str(device), LiveOptions(size_px=(9, 9)), av_open=refusing(number))
    assert isinstance(caught.value, ConnectionLostError) != is_final
    if number == errno.EACCES:
        # The group that owns the device; root's files are the case of a missing udev rule.
        assert device.group() in caught.value.advice or "Only root may" in caught.value.advice
    if number == errno.EBUSY:
        assert f"fuser -v {device}" in caught.value.advice


def test_an_unknown_coding_is_refused_with_the_known_ones():
    with pytest.raises(SourceError, match=r"no coding 'jpg'; expected one of yuyv422, .*mjpeg"):
        connection(options=LiveOptions(coding="jpg"))
    assert len(set(CODINGS.values())) == len(CODINGS)


def test_a_missing_device_is_refused_by_the_real_ffmpeg():
    with pytest.raises(SourceError, match="/dev/video99: there is no such camera"):
        open_live("/dev/video99")


def test_a_real_camera_delivers_frames_with_the_drivers_stamp():
    if not Path("/dev/video0").exists():
        pytest.skip("no camera: /dev/video0 does not exist")
    with open_live("/dev/video0") as source:
        frames = list(islice(source, 5))
    assert {frame.origin for frame in frames} == {StampOrigin.DRIVER}
    assert all(abs(frame.stamp_ns - time.time_ns()) < 10e9 for frame in frames)
