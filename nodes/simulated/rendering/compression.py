"""A frame source whose pictures went through a video codec, as those of an IP camera do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from network_calib.errors import InputError
from nodes.closing import Closing
from nodes.devices.errors import SourceError
from nodes.frames import Frame, FrameSource, SourceCounts
from nodes.simulated.rendering.video_codec import VideoCodec, picture_of, rate_fraction

if TYPE_CHECKING:
    import av
    from av.video.codeccontext import VideoCodecContext

DEFAULT_RATE_HZ = 25.0
# A key picture so many seconds, as cameras are usually set.
KEY_PICTURE_S = 2.0


class CompressedSource(Closing):
    """Encodes each frame of a source in memory at a given bit rate, decodes it, and delivers what came out.

    Frames are YUV420 as a decoder gives them; sequence, stamp and settings are those of the frame that went in, so the
    truth about frame k of a rendered camera stays the truth. Nothing is lost or delayed: the encoder does not reorder.

    Args:
        source: mono or BGR frames with 8 bits and even sides; closed with this one.
        bit_rate: bits a second that the encoder aims at.
        codec: H264 or H265.

    Raises:
        InputError: a codec without loss, or a bit rate that is not positive; while iterating: frames that the codec
            cannot hold.
    """

    def __init__(self, source: FrameSource, *, bit_rate: int, codec: VideoCodec = VideoCodec.H264) -> None:
        if codec.is_lossless:
            raise InputError(f"codec {codec.value} loses nothing, expected h264 or h265")
        if bit_rate <= 0:
            raise InputError(f"bit_rate is {bit_rate}, expected more than 0")
        self._source, self._bit_rate, self._codec = source, bit_rate, codec

    @property
    def name(self) -> str:
        return self._source.name

    @property
    def size_px(self) -> tuple[int, int]:
        return self._source.size_px

    @property
    def rate_hz(self) -> float | None:
        return self._source.rate_hz

    @property
    def counts(self) -> SourceCounts:
        return self._source.counts

    def __iter__(self) -> Iterator[Frame]:
        import av
        from av.video.codeccontext import VideoCodecContext

        rate = rate_fraction(self.rate_hz or DEFAULT_RATE_HZ)
        encoder, decoder = self._encoder(), av.CodecContext.create(self._codec.decoder, "r")
        assert isinstance(decoder, VideoCodecContext)
        decoder.thread_count = 1  # more would hold pictures back
        waiting: list[Frame] = []
        for number, frame in enumerate(self._source):
            coded_format = self._codec.coded_format(frame.pixel_format, frame.bits, frame.size_px)
            waiting.append(replace(frame, image=frame.image[:0]))
            for packet in encoder.encode(picture_of(frame, coded_format, number=number, rate=rate)):
                for picture in decoder.decode(packet):
                    yield self._delivered(picture, waiting)
        for packet in [*encoder.encode(None), None]:
            for picture in decoder.decode(packet):
                yield self._delivered(picture, waiting)

    def _encoder(self) -> VideoCodecContext:
        import av
        from av.video.codeccontext import VideoCodecContext

        rate = rate_fraction(self.rate_hz or DEFAULT_RATE_HZ)
        encoder = av.CodecContext.create(self._codec.encoder, "w")
        assert isinstance(encoder, VideoCodecContext)
        encoder.width, encoder.height = self.size_px
        encoder.pix_fmt = "yuv420p"
        encoder.framerate, encoder.time_base = rate, 1 / rate
        encoder.bit_rate = self._bit_rate
        encoder.gop_size = max(1, round(KEY_PICTURE_S * float(rate)))
        encoder.thread_count = 1  # the same bits on every machine
        encoder.options = self._codec.options(is_live=True)
        return encoder

    def _delivered(self, picture: av.VideoFrame, waiting: list[Frame]) -> Frame:
        """The decoded picture with what is known of the frame that went in; it is the oldest one waiting."""
        from nodes.devices.cameras.video_pixels import pixels_of

        if not waiting:
            raise SourceError(f"{self.name}: the {self._codec.value} decoder gave more pictures than went in")
        pixels = pixels_of(picture)
        return replace(
            waiting.pop(0),
            image=pixels.image,
            pixel_format=pixels.pixel_format,
            bits=pixels.bits,
            is_full_range=pixels.is_full_range,
        )

    def close(self) -> None:
        """Close the source."""
        self._source.close()
