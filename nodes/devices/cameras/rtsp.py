"""RTSP cameras, H.264 and H.265, through FFmpeg: one connection, decoded and stamped with the camera's clock."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from fractions import Fraction
from typing import TYPE_CHECKING

import av
import av.error

from nodes.devices.cameras.connection import ConnectionLostError, Shot
from nodes.devices.cameras.ffmpeg_errors import source_error_of, timed_out
from nodes.devices.cameras.live_options import LiveOptions, Transport
from nodes.devices.cameras.stream_clock import Stamp, StreamClock
from nodes.devices.cameras.video_pixels import pixels_of
from nodes.devices.cameras.whole_pictures import WholePictures
from nodes.devices.errors import SourceError

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

CODECS = ("h264", "hevc")
# A camera sends a key frame every few seconds; one whose pictures stay damaged for so long needs a new connection.
_MAX_DAMAGED_S = 20.0
_SOCKET_BYTES = 4 << 20


class RtspConnection:
    """A camera that plays.

    Args:
        address: with user name and password, if it wants them.
        name: of the source, without.
        options: transport, time-outs, decoder threads, and how long to wait for the camera's clock.

    Raises:
        SourceError: the camera refuses, or sends neither H.264 nor H.265.
        ConnectionLostError: it cannot be reached, or has no such stream.
    """

    def __init__(self, address: str, name: str, options: LiveOptions) -> None:
        self._name, self._timeout_s = name, options.timeout_s
        self._container = _opened(address, name, options)
        try:
            self._stream = _video_stream(self._container, name)
        except SourceError:
            self._container.close()
            raise
        self._codec = self._stream.codec_context
        self._codec.thread_count = options.n_decoder_threads
        self._codec.copy_opaque = True
        self._whole = WholePictures(self._codec, is_lossy=options.transport is Transport.UDP)
        self._clock = StreamClock(wait_s=options.clock_wait_s)
        self._size_px = self._codec.width, self._codec.height
        self._rate_hz = _plausible_rate(self._stream.average_rate or self._stream.guessed_rate)

    @property
    def size_px(self) -> tuple[int, int]:
        return self._size_px

    @property
    def rate_hz(self) -> float | None:
        return self._rate_hz

    @property
    def n_clock_steps(self) -> int:
        return self._clock.n_steps

    def shots(self) -> Iterator[Shot | None]:
        """Pictures that are whole and have a stamp; None after every packet.

        Raises:
            ConnectionLostError: no data within the time-out, the stream ended, or stays damaged.
        """
        n_lost, good_s = 0, time.monotonic()
        for packet in self._packets():
            packet.opaque = self._stamp(packet)
            frames = self._whole.frames_of(packet)
            n_lost += self._whole.n_lost
            for frame in frames:
                if isinstance(frame.opaque, Stamp):
                    yield Shot(frame.opaque.stamp_ns, frame.opaque.origin, pixels_of(frame), n_lost)
                    n_lost = 0
                else:
                    n_lost += 1
            if frames:
                good_s = time.monotonic()
            elif time.monotonic() - good_s > _MAX_DAMAGED_S:
                raise ConnectionLostError(f"{self._name}: no undamaged picture for {_MAX_DAMAGED_S:g} s")
            yield None

    def close(self) -> None:
        self._container.close()

    def _packets(self) -> Iterator[av.Packet[VideoStream]]:
        try:
            yield from (packet for packet in self._container.demux(self._stream) if packet.size)
            return
        except av.error.ExitError:
            failure = timed_out(self._name, self._timeout_s)
        except av.error.FFmpegError as error:
            failure = source_error_of(error, self._name)
        raise failure

    def _stamp(self, packet: av.Packet[VideoStream]) -> Stamp | None:
        stream_ns = None if packet.pts is None else int(packet.pts * packet.time_base * 10**9)
        return self._clock.stamp(stream_ns, _wall_ns(packet), time.time_ns())


def _opened(address: str, name: str, options: LiveOptions) -> InputContainer:
    """Raises: as `RtspConnection`."""
    ffmpeg_options = {
        "rtsp_transport": options.transport.value,
        # With sound, FFmpeg would shift the presentation times at the first sender report.
        "allowed_media_types": "video",
        # Probing ends with the first key frame, and the frames it took are delivered after all. `nobuffer` would throw
        # them away, the key frame among them, and no picture come until the next; the camera's stamps make the delay
        # harmless.
        "analyzeduration": str(round(options.timeout_s * 1e6)),
        "fpsprobesize": "0",
        "buffer_size": str(_SOCKET_BYTES),
    }
    begin_s = time.monotonic()
    try:
        return av.open(address, options=ffmpeg_options, timeout=(options.timeout_s, options.timeout_s))
    except av.error.InvalidDataError as error:
        # What FFmpeg's RTSP says too when it was interrupted at the time-out.
        is_timed_out = time.monotonic() - begin_s >= options.timeout_s
        failure = timed_out(name, options.timeout_s) if is_timed_out else source_error_of(error, name)
    except av.error.ExitError:
        failure = timed_out(name, options.timeout_s)
    except av.error.FFmpegError as error:
        failure = source_error_of(error, name)
    raise failure


def _video_stream(container: InputContainer, name: str) -> VideoStream:
    """Raises: SourceError."""
    stream = next(iter(container.streams.video), None)
    if stream is None:
        raise SourceError(f"{name}: the camera sends no video at this path")
    codec = stream.codec_context
    if codec is None or codec.name not in CODECS:
        found = "one that FFmpeg does not know" if codec is None else codec.name
        raise SourceError(
            f"{name}: the codec is {found}; expected h264 or hevc", advice="Set H.264 or H.265 in the camera."
        )
    if not (codec.width > 0 and codec.height > 0):
        raise ConnectionLostError(
            f"{name}: the camera sent no key frame in time", advice="Set a shorter key frame interval."
        )
    return stream


def _wall_ns(packet: av.Packet[VideoStream]) -> int | None:
    """The wall clock of `prft` (AVProducerReferenceTime: int64 µs since the epoch, int flags)."""
    if not packet.has_sidedata("prft"):
        return None
    (wall_us,) = struct.unpack_from("=q", bytes(packet.get_sidedata("prft")))
    return wall_us * 1000


def _plausible_rate(rate: Fraction | None) -> float | None:
    """FFmpeg guesses 90000 or so where the stream does not tell."""
    return float(rate) if rate is not None and 0.5 <= rate <= 1000 else None
