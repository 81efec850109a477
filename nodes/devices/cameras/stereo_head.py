"""Stereo heads: two cameras, C0 and C1, behind one source or two.

`StereoHead.pairs` gives both views of each instant and is the way for one process that serves both cameras. `left` and
`right` are frame sources of their own. A recording is read once for each of them, from its beginning. A live head is
read once for both: whoever asks first gets the next frame cut, and the other view waits for the other consumer, at most
`N_WAITING` frames of it; older ones are dropped and counted. Views of a live head may be iterated from two threads.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import replace

from nodes.closing import Closing
from nodes.devices.cameras.source_info import SourceInfo, describe
from nodes.devices.cameras.stereo_split import StereoLayout, layout_fault, split_image
from nodes.devices.cameras.tally import FrameTally
from nodes.devices.errors import SourceError
from nodes.frames import Frame, FrameSource, SourceCounts

N_WAITING = 8


class StereoHead(Closing):
    """Both views of a stereo head that sends them through one source. It owns the source.

    Both views of one instant carry the same sequence and stamp. For ALTERNATING these are half the sequence of the
    source, and the stamp of the first of both frames: such a head exposes both at once and sends them one by one. An
    eye whose frame was lost leaves its partner out too, and both views count it.

    Attributes:
        left: the left view as a frame source.
        right: the right view.
    """

    def __init__(self, source: FrameSource, layout: StereoLayout, *, is_swapped: bool = False) -> None:
        """Take over an open source; it is closed when it cannot be cut.

        Args:
            source: images that hold both views.
            layout: how.
            is_swapped: right and left change places.

        Raises:
            SourceError: the size of the image does not fit the layout.
        """
        self._source, self._layout, self._is_swapped = source, layout, is_swapped
        self.left = StereoView(self, 0)
        self.right = StereoView(self, 1)
        self._lock = threading.Lock()
        self._live: Iterator[tuple[Frame, Frame]] | None = None
        self._closed_sides: set[int] = set()
        self._waiting: tuple[deque[Frame], deque[Frame]] = (deque(), deque())
        info = describe(source)
        fault = None if info.pixel_format is None else layout_fault(layout, info.pixel_format, info.size_px)
        if fault is not None:
            source.close()
            raise _cannot_cut(source.name, layout, fault)

    @property
    def source(self) -> FrameSource:
        """What is cut."""
        return self._source

    @property
    def is_recording(self) -> bool:
        """Whether iterating anew starts anew."""
        return bool(getattr(self._source, "is_recording", False))

    @property
    def view_size_px(self) -> tuple[int, int]:
        """Width and height of one view."""
        width, height = self._source.size_px
        if self._layout is StereoLayout.LEFT_RIGHT:
            return width // 2, height
        return width, height if self._layout is StereoLayout.ALTERNATING else height // 2

    @property
    def view_rate_hz(self) -> float | None:
        """Nominal frames a second of one view."""
        rate = self._source.rate_hz
        return rate / 2 if rate is not None and self._layout is StereoLayout.ALTERNATING else rate

    def pairs(self) -> Iterator[tuple[Frame, Frame]]:
        """Left and right view of each instant.

        Raises:
            SourceError: the source failed, or delivered what cannot be cut.
        """
        both = self._alternating() if self._layout is StereoLayout.ALTERNATING else self._cut()
        for first, second in both:
            yield (second, first) if self._is_swapped else (first, second)

    def _cut(self) -> Iterator[tuple[Frame, Frame]]:
        for frame in self._source:
            fault = layout_fault(self._layout, frame.pixel_format, frame.size_px)
            if fault is not None:
                raise _cannot_cut(self._source.name, self._layout, fault)
            first, second = split_image(frame, self._layout)
            yield replace(frame, image=first), replace(frame, image=second)

    def _alternating(self) -> Iterator[tuple[Frame, Frame]]:
        first: Frame | None = None
        for frame in self._source:
            sequence, is_second = divmod(frame.sequence, 2)
            if is_second and first is not None and first.sequence == sequence:
                yield first, replace(frame, sequence=sequence, stamp_ns=first.stamp_ns, origin=first.origin)
            # A copy: the source may reuse the memory of a frame when the next one is asked for.
            first = None if is_second else replace(frame, sequence=sequence, image=frame.image.copy())

    def view_frames(self, side: int) -> Iterator[Frame]:
        """Frames of one view (0 left, 1 right); `StereoView` is the way to use it."""
        if self.is_recording:
            yield from (pair[side] for pair in self.pairs())
            return
        while (frame := self._next_live(side)) is not None:
            yield frame

    def _next_live(self, side: int) -> Frame | None:
        with self._lock:
            mine, others = self._waiting[side], self._waiting[1 - side]
            if mine:
                return mine.popleft()
            if self._live is None:
                self._live = self.pairs()
            pair = next(self._live, None)
            if pair is None:
                return None
            if len(others) == N_WAITING:
                others.popleft()
            # Copies: the other thread may ask for the next frame, and the source reuse its memory, at any time.
            others.append(replace(pair[1 - side], image=pair[1 - side].image.copy()))
            return replace(pair[side], image=pair[side].image.copy())

    def close_view(self, side: int) -> None:
        """One view is closed; with the second the source is too."""
        self._closed_sides.add(side)
        if len(self._closed_sides) == 2:
            self.close()

    def close(self) -> None:
        """Give the device back; further calls do nothing."""
        self._source.close()


class StereoView(Closing):
    """One view of a stereo head as a frame source. When both are closed, the head's source is."""

    def __init__(self, head: StereoHead, side: int) -> None:
        self._head, self._side = head, side
        self._is_closed = False
        self._tally = FrameTally(None)

    @property
    def name(self) -> str:
        return f"{self._head.source.name} ({'left' if self._side == 0 else 'right'})"

    @property
    def is_recording(self) -> bool:
        """Whether iterating anew starts anew."""
        return self._head.is_recording

    @property
    def size_px(self) -> tuple[int, int]:
        return self._head.view_size_px

    @property
    def rate_hz(self) -> float | None:
        return self._head.view_rate_hz

    @property
    def counts(self) -> SourceCounts:
        """Of the latest iteration; dropped: gaps of the sequence between delivered frames."""
        return self._tally.counts

    @property
    def info(self) -> SourceInfo:
        whole = describe(self._head.source)
        return replace(whole, name=self.name, kind="stereo", size_px=self.size_px, rate_hz=self.rate_hz)

    def __iter__(self) -> Iterator[Frame]:
        tally = self._tally = FrameTally(self.rate_hz)
        last_sequence: int | None = None
        frames = self._head.view_frames(self._side)
        while not self._is_closed and (frame := next(frames, None)) is not None:
            if last_sequence is not None:
                tally.drop(max(frame.sequence - last_sequence - 1, 0))
            last_sequence = frame.sequence
            tally.deliver(frame.stamp_ns)
            yield frame

    def close(self) -> None:
        """End the iteration at its next frame."""
        self._is_closed = True
        self._head.close_view(self._side)


def split_stereo(
    source: FrameSource, layout: StereoLayout, *, is_swapped: bool = False
) -> tuple[StereoView, StereoView]:
    """Left and right view of a stereo head as two frame sources that share the given one, and close it together.

    Raises:
        SourceError: the size of the image does not fit the layout.
    """
    head = StereoHead(source, layout, is_swapped=is_swapped)
    return head.left, head.right


def paired(left: FrameSource, right: FrameSource, *, tolerance_ns: int) -> Iterator[tuple[Frame, Frame]]:
    """Frames of a head whose eyes are two devices or two recordings: those that are of one instant, in lock-step.

    Frames keep their own sequence and stamp; one without a partner within the tolerance is left out. Both stamps must
    be on one clock.

    Args:
        left: the left eye.
        right: the right eye.
        tolerance_ns: largest difference of both stamps, below half the frame interval: no frame then has two partners.
    """
    lefts, rights = iter(left), iter(right)
    a, b = next(lefts, None), next(rights, None)
    while a is not None and b is not None:
        if abs(a.stamp_ns - b.stamp_ns) <= tolerance_ns:
            yield a, b
            a, b = next(lefts, None), next(rights, None)
        elif a.stamp_ns < b.stamp_ns:
            a = next(lefts, None)
        else:
            b = next(rights, None)


def _cannot_cut(name: str, layout: StereoLayout, fault: str) -> SourceError:
    return SourceError(
        f"{name} cannot be cut as {layout.value}: {fault}",
        advice="Choose the layout that the head sends, or set the head to another image size.",
    )
