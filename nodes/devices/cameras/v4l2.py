"""Cameras of this machine (USB, MIPI) through Video4Linux: opened by FFmpeg, stamped by the kernel.

The kernel stamps each buffer on its monotonic clock; the stamp is moved to the wall clock by what the two clocks show
when the frame comes, so that it follows the wall clock as NTP steers it. It is the driver's idea of the instant (most
USB cameras: the first bytes of the picture came in), off from mid-exposure by a part that stays the same while the
exposure does; the calibration estimates it with the clock's offset.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import av
import av.error

from nodes.devices.cameras import v4l2_ioctl
from nodes.devices.cameras.connection import ConnectionLostError, Shot
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.cameras.video_pixels import pixels_of
from nodes.devices.errors import SourceError
from nodes.devices.permission import permission_advice
from nodes.frames import FrameSettings, StampOrigin

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

# What `LiveOptions.coding` may be: FFmpeg's name of each four-character code.
CODINGS = {
    "YUYV": "yuyv422",
    "UYVY": "uyvy422",
    "MJPG": "mjpeg",
    "H264": "h264",
    "GREY": "gray",
    "Y16 ": "gray16le",
    "NV12": "nv12",
    "YU12": "yuv420p",
    "RGB3": "rgb24",
    "BGR3": "bgr24",
    "RGGB": "bayer_rggb8",
    "GRBG": "bayer_grbg8",
    "GBRG": "bayer_gbrg8",
    "BA81": "bayer_bggr8",
}
_SETTINGS_EVERY_S = 1.0
_EXPOSURE_UNIT_S = 100e-6


class V4l2Connection:
    """A video device that streams.

    Args:
        path: such as /dev/video0.
        options: size, rate and coding to ask for.
        av_open: `av.open`.
        ioctl: asks the kernel.

    Raises:
        SourceError: no such device, no permission, or it cannot do what is asked.
        ConnectionLostError: it is busy, or was just unplugged.
    """

    def __init__(
        self,
        path: str,
        options: LiveOptions,
        *,
        av_open: Callable[..., InputContainer] = av.open,
        ioctl: v4l2_ioctl.Ioctl = v4l2_ioctl.kernel_ioctl,
    ) -> None:
        self._path, self._ioctl = path, ioctl
        self._container = _opened(path, options, av_open)
        self._stream = next(iter(self._container.streams.video))
        codec = self._stream.codec_context
        codec.thread_count = options.n_decoder_threads
        codec.copy_opaque = True
        self._size_px = codec.width, codec.height
        rate = self._stream.average_rate
        self._rate_hz = float(rate) if rate else None
        self._settings, self._settings_s = FrameSettings(), -_SETTINGS_EVERY_S

    @property
    def size_px(self) -> tuple[int, int]:
        return self._size_px

    @property
    def rate_hz(self) -> float | None:
        return self._rate_hz

    @property
    def n_clock_steps(self) -> int:
        return 0

    def shots(self) -> Iterator[Shot | None]:
        """Pictures with the kernel's stamp; None after every buffer.

        Raises:
            ConnectionLostError: unplugged.
        """
        n_lost = 0
        for packet in self._packets():
            packet.opaque = _stamp_ns(packet)
            try:
                frames = self._stream.codec_context.decode(packet)
            except av.error.FFmpegError:
                frames = []
            n_lost += not frames  # cameras send cut JPEGs now and then
            for frame in frames:
                if frame.is_corrupt or not isinstance(frame.opaque, int):
                    n_lost += 1
                    continue
                yield Shot(frame.opaque, StampOrigin.DRIVER, pixels_of(frame), n_lost, self._read_settings())
                n_lost = 0
            yield None

    def close(self) -> None:
        self._container.close()

    def _packets(self) -> Iterator[av.Packet[VideoStream]]:
        try:
            yield from (packet for packet in self._container.demux(self._stream) if packet.size)
            return
        except av.error.FFmpegError as error:
            failure = ConnectionLostError(
                f"{self._path}: the device stopped: {error.strerror}", advice="Check the camera's cable."
            )
        raise failure

    def _read_settings(self) -> FrameSettings:
        """Once a second: each question to a USB camera takes a turn on its bus.

        V4L2 gives no unit of gain, so that is not told.
        """
        now_s = time.monotonic()
        if now_s - self._settings_s >= _SETTINGS_EVERY_S:
            self._settings_s = now_s
            value = _asked(self._path, v4l2_ioctl.EXPOSURE_ABSOLUTE, self._ioctl)
            exposure_s = value * _EXPOSURE_UNIT_S if value is not None and value > 0 else None
            self._settings = FrameSettings(exposure_s=exposure_s)
        return self._settings


def _opened(path: str, options: LiveOptions, av_open: Callable[..., InputContainer]) -> InputContainer:
    """Raises: as `V4l2Connection`."""
    asked: dict[str, str] = {}
    if options.size_px is not None:
        asked["video_size"] = "x".join(map(str, options.size_px))
    if options.rate_hz is not None:
        asked["framerate"] = f"{options.rate_hz:g}"
    if options.coding is not None:
        if options.coding not in CODINGS.values():
            raise SourceError(f"{path}: no coding {options.coding!r}; expected one of {', '.join(CODINGS.values())}")
        asked["input_format"] = options.coding
    try:
        return av_open(path, format="v4l2", options=asked, timeout=(options.timeout_s, options.timeout_s))
    except av.error.FFmpegError as error:
        failure = _error_of(error, path, ", ".join(f"{name} {value}" for name, value in asked.items()))
    raise failure


def _error_of(error: av.error.FFmpegError, path: str, asked: str) -> SourceError:
    if error.errno == errno.EACCES:
        return SourceError(f"{path}: no permission to open it", advice=permission_advice(Path(path)))
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return ConnectionLostError(f"{path}: there is no such camera", advice="Is it plugged in, and its number right?")
    if error.errno == errno.EBUSY:
        return ConnectionLostError(
            f"{path}: another program uses it", advice=f"`fuser -v {path}` tells which; end that one."
        )
    if error.errno == errno.EINVAL and asked:
        return SourceError(f"{path}: the camera cannot do {asked}", advice="Choose a size, rate and coding it lists.")
    return ConnectionLostError(f"{path}: cannot be opened as a camera: {error.strerror}")


def wall_ns_of(stamp_ns: int, *, monotonic_ns: int, wall_ns: int) -> int:
    """A kernel stamp on the wall clock, given what both clocks show now; old drivers stamp with the wall clock."""
    is_monotonic = abs(stamp_ns - monotonic_ns) < abs(stamp_ns - wall_ns)
    return stamp_ns + (wall_ns - monotonic_ns if is_monotonic else 0)


def _stamp_ns(packet: av.Packet[VideoStream]) -> int | None:
    if packet.pts is None:
        return None
    stamp_ns = int(packet.pts * packet.time_base * 10**9)
    return wall_ns_of(stamp_ns, monotonic_ns=time.monotonic_ns(), wall_ns=time.time_ns())


def _asked(path: str, control: int, ioctl: v4l2_ioctl.Ioctl) -> int | None:
    try:
        device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        return v4l2_ioctl.control(device, control, ioctl)
    finally:
        os.close(device)
