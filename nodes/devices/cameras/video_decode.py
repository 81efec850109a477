"""Decoding a video file frame by frame, so that every frame has its number, and damage neither stops nor deceives.

Numbers come from presentation times: a decoder delivers pictures in the order of presentation, so a packet whose time
lies before that of a delivered picture, and whose picture has not come, is lost. The next pictures may be built on the
lost one, with pieces of other instants in them; they are left out up to the next key frame, which needs no other.

Where a decoder refuses a packet, the whole picture that it would have given at that moment is lost with it.

A codec without checksums does not tell every damage: flipped bits inside a picture of H.264, H.265 or MJPEG often
decode to a picture that is merely wrong. Cut files, broken headers, frames that the recorder never got, and lost
packets of transport streams are told (but for packets of the very first frame).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import av
from av.error import FFmpegError

from nodes.devices.cameras.h264_watch import H264Watch
from nodes.devices.cameras.video_open import OpenVideo

# A demuxer that has lost its way fails once and finds the next packet; behind the end of a cut file it fails forever.
_MAX_READ_ERRORS = 8


class PicturePass:
    """One pass through the pictures of a stream; iterating gives (number in the file from 0, picture).

    Attributes:
        n_packets: coded frames read so far.
        n_lost: frames that could not be decoded.
        n_doubtful: frames that were decoded, but are built on lost ones.
        n_backward: frames whose time was not later than their predecessor's.
        end_pts: end of the last frame in units of the stream's time base; None while no frame had a time.
        read_error: why reading ended before the end of the file; empty when it did not.
    """

    def __init__(self, video: OpenVideo, *, keep_damaged: bool, max_packets: int | None = None) -> None:
        self._video, self._keep_damaged, self._max_packets = video, keep_damaged, max_packets
        # Heap of (presentation time, place in the order of decoding) of packets whose pictures have not come.
        self._pending: list[tuple[int, int]] = []
        self._next_index = 0
        self._last_time: int | None = None
        # A recording that begins between key frames begins damaged.
        self._damage = _Damage(0, 0) if video.is_strict and not keep_damaged else None
        self._watch = H264Watch.of(video.stream)
        self._key: tuple[int, int] | None = None  # the latest key frame, in the same way
        self._swallowed: set[int] = set()  # places of whole frames that were lost with the next damaged one
        self.n_packets = self.n_lost = self.n_doubtful = self.n_backward = 0
        self.end_pts: int | None = None
        self.read_error = ""

    def __iter__(self) -> Iterator[tuple[int, av.VideoFrame]]:
        n_pictures = 0
        for packet in self._packets():
            for picture in self._decode(packet):
                n_pictures += 1
                index, place = self._number(picture)
                if self._is_doubtful(picture, place):
                    self.n_doubtful += 1
                elif self._is_backward(picture):
                    self.n_backward += 1
                else:
                    yield index, picture
        is_timed = self.end_pts is not None
        self.n_lost = self.n_lost + len(self._pending) if is_timed else max(self.n_packets - n_pictures, 0)
        self._pending.clear()

    def count_packets(self) -> int:
        """How many frames there are, by reading to the end without decoding; instead of an iteration."""
        return sum(1 for packet in self._packets() if packet is not None and not packet.is_discard)

    def _packets(self) -> Iterator[av.Packet | None]:
        """Packets with content, and None at the end: the decoder then gives what it holds back."""
        n_errors = 0
        demuxer = self._video.container.demux(self._video.stream)
        while n_errors < _MAX_READ_ERRORS and self.n_packets != self._max_packets:
            try:
                packet = next(demuxer, None)
            except FFmpegError as error:
                n_errors += 1
                self.read_error = error.strerror or type(error).__name__
                demuxer = self._video.container.demux(self._video.stream)
                continue
            if packet is None or (packet.size == 0 and packet.dts is None):
                break
            if packet.size:
                n_errors, self.read_error = 0, ""
                yield packet
        yield None

    def _decode(self, packet: av.Packet | None) -> list[av.VideoFrame]:
        if packet is not None and not packet.is_discard:
            self._note(packet)
            if self._watch is not None and self._watch.is_gap_before(packet):
                self._mark_damage(self.n_packets, key_place=self.n_packets)
            if packet.is_corrupt:
                # The flag stands on the cut packet, or, where frames are put together out of a transport stream, on the
                # one before it.
                self._mark_damage(self.n_packets, key_place=self.n_packets + 2)
        try:
            return self._video.stream.codec_context.decode(packet)
        except FFmpegError:
            # The decoder would have given, with this packet, the earliest of the pictures that it held back.
            self._swallowed |= {place for _, place in self._pending[:1] if place < self.n_packets}
            self._lose(packet)
            return []

    def _note(self, packet: av.Packet) -> None:
        self.n_packets += 1
        if packet.pts is not None and self._video.is_timed:
            heapq.heappush(self._pending, (packet.pts, self.n_packets))
            self._key = (packet.pts, self.n_packets) if packet.is_keyframe else self._key
            end = packet.pts + (packet.duration or 0)
            self.end_pts = end if self.end_pts is None else max(end, self.end_pts)

    def _lose(self, packet: av.Packet | None) -> None:
        """A packet gives no picture; one with a time is counted when a later picture comes."""
        if packet is None or packet.pts is None or not self._is_leading(packet.pts, self.n_packets):
            self._mark_damage(self.n_packets)
        if packet is not None and (packet.pts is None or not self._video.is_timed):
            self.n_lost += 1
            self._next_index += 1

    def _number(self, picture: av.VideoFrame) -> tuple[int, int]:
        """Number of the picture in the file, and its place in the order of decoding as far as that is known."""
        place, lost = self.n_packets, list[tuple[int, int]]()
        if picture.pts is not None and any(pts == picture.pts for pts, _ in self._pending):
            pts, place = heapq.heappop(self._pending)
            while pts < picture.pts:
                lost.append((pts, place))
                pts, place = heapq.heappop(self._pending)
        for lost_pts, lost_place in lost:
            if lost_place not in self._swallowed and not self._is_leading(lost_pts, lost_place):
                self._mark_damage(lost_place)
        self.n_lost += len(lost)
        index = self._next_index + len(lost)
        self._next_index = index + 1
        return index, place

    def _is_leading(self, pts: int, place: int) -> bool:
        """Whether a frame is coded behind the latest key frame and shown before it: none shown after that needs it."""
        return self._key is not None and pts < self._key[0] and place > self._key[1]

    def _mark_damage(self, place: int, *, key_place: int | None = None) -> None:
        """Distrust what is decoded from `place` on, to a key frame at or after `key_place` (by default behind it)."""
        if self._keep_damaged:
            return
        damage = _Damage(place, place + 1 if key_place is None else key_place)
        if self._damage is not None:
            damage = _Damage(min(damage.first, self._damage.first), max(damage.key_place, self._damage.key_place))
        self._damage = damage

    def _is_doubtful(self, picture: av.VideoFrame, place: int) -> bool:
        """Whether a damaged frame was decoded before this one, and no key frame between; or it is itself damaged."""
        if picture.is_corrupt:
            self._mark_damage(place)
        if self._damage is None or place < self._damage.first:
            return False
        if picture.key_frame and place >= self._damage.key_place:
            self._damage = None
            return False
        return True

    def _is_backward(self, picture: av.VideoFrame) -> bool:
        time = picture_time(picture) if self._video.is_timed else None
        is_backward = time is not None and self._last_time is not None and time <= self._last_time
        if time is not None and not is_backward:
            self._last_time = time
        return is_backward


@dataclass(frozen=True, slots=True)
class _Damage:
    """What to distrust, by places in the order of decoding: from the first on, to a key frame at or after the other."""

    first: int
    key_place: int


def picture_time(picture: av.VideoFrame) -> int | None:
    """Presentation time in units of the time base; containers such as AVI tell only that of decoding."""
    return picture.pts if picture.pts is not None else picture.dts
