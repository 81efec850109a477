"""Video files as frame sources."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import av

from network_calib.errors import InputError
from nodes.closing import Closing
from nodes.devices.cameras.source_info import SourceInfo
from nodes.devices.cameras.stamp_table import VideoStamps, check_row_count, read_video_stamps, video_table_beside
from nodes.devices.cameras.tally import FrameTally
from nodes.devices.cameras.video_decode import PicturePass, picture_time
from nodes.devices.cameras.video_open import VideoOptions, open_video
from nodes.devices.cameras.video_pixels import pixels_of
from nodes.devices.cameras.video_probe import VideoProbe, ns_from_pts, probe_video
from nodes.devices.errors import SourceError
from nodes.frames import Frame, SourceCounts, StampOrigin


class VideoFile(Closing):
    """A recorded video. Every iteration starts at its beginning; several at once do not disturb each other.

    Stamps are the presentation times of the file (origin FILE) in ns, or those of a stamp table beside it (TABLE), or
    frame number over rate where the file has no times (ORDER). Frames are delivered as the decoder gives them where
    `Frame` can hold that (`video_pixels`), as stored, without the rotation that a phone may note.

    Damaged frames are counted as dropped and leave a gap in `sequence`, as do the whole ones that are built on them
    (`video_decode`). A file that is cut delivers everything whole before the cut; `notes` then says so, and frames that
    the file's index promised are counted as dropped.

    Attributes:
        is_recording: iterating anew starts anew.
    """

    is_recording = True

    def __init__(self, path: Path, options: VideoOptions | None = None) -> None:
        """Open whole or not at all.

        Raises:
            SourceError: missing, unreadable, no video, no frame that can be decoded.
            InputError: the stamp table does not fit.
        """
        self._path, self._options = path, options or VideoOptions()
        self._is_closed = False
        self._probe = probe_video(path, self._options)
        self._tally = FrameTally(self.rate_hz)
        self._pass_notes: tuple[str, ...] = ()
        self._stamps = _stamps(path, self._options, self._probe)

    @property
    def name(self) -> str:
        return self._path.name

    @property
    def size_px(self) -> tuple[int, int]:
        return self._probe.info.size_px

    @property
    def rate_hz(self) -> float | None:
        return self._probe.info.rate_hz

    @property
    def counts(self) -> SourceCounts:
        """Of the latest iteration."""
        return self._tally.counts

    @property
    def info(self) -> SourceInfo:
        info = self._probe.info if self._stamps is None else replace(self._probe.info, stamp_origin=StampOrigin.TABLE)
        return replace(info, notes=self.notes)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know; what an iteration has found is there when it has come to the end."""
        return self._probe.info.notes + self._pass_notes

    def __iter__(self) -> Iterator[Frame]:
        if self._is_closed:
            raise SourceError(f"{self.name} is closed")
        tally = self._tally = FrameTally(self.rate_hz)
        with open_video(self._path, self._options, is_strict=self._probe.is_strict) as opened:
            pictures = PicturePass(opened, keep_damaged=self._options.keep_damaged)
            for index, picture in pictures:
                if self._is_closed:
                    return
                frame = self._frame(index, picture)
                tally.drop(_n_left_out(pictures) - tally.counts.dropped)
                tally.deliver(frame.stamp_ns)
                yield frame
        self._finish(pictures, tally)

    def _frame(self, index: int, picture: av.VideoFrame) -> Frame:
        sequence, stamp_ns, origin = self._stamp(index, picture)
        if (picture.width, picture.height) != self.size_px:
            width, height = self.size_px
            raise SourceError(
                f"{self._path}, frame {index}: {picture.width} x {picture.height} pixels, "
                f"expected {width} x {height} as before",
                advice="Each resolution needs a calibration of its own: split the recording there.",
            )
        pixels = pixels_of(picture)
        return Frame(sequence, stamp_ns, origin, pixels.image, pixels.pixel_format, pixels.bits, pixels.is_full_range)

    def _stamp(self, index: int, picture: av.VideoFrame) -> tuple[int, int, StampOrigin]:
        """Sequence, stamp and its origin."""
        if self._stamps is not None:
            if index >= len(self._stamps.frame):
                raise InputError(f"{self._stamps.path} has no row for frame {index} of {self.name}")
            return int(self._stamps.frame[index]), int(self._stamps.stamp_ns[index]), StampOrigin.TABLE
        time = picture_time(picture)
        if self._probe.info.stamp_origin is StampOrigin.FILE and time is not None:
            return index, ns_from_pts(time, self._probe.time_base), StampOrigin.FILE
        return index, ns_from_pts(index, 1 / self._probe.rate), StampOrigin.ORDER

    def _finish(self, pictures: PicturePass, tally: FrameTally) -> None:
        """Count what is missing at the end, and say in words what happened."""
        is_cut = self._probe.is_cut or bool(pictures.read_error)
        n_missing = _n_missing(self._probe, pictures) if is_cut else 0
        tally.drop(_n_left_out(pictures) + n_missing - tally.counts.dropped)
        why = f" ({pictures.read_error})" if pictures.read_error else ""
        missing = f"about {n_missing}" if n_missing else "unknown, perhaps none"
        found = (
            (is_cut, f"is cut and ends early{why}; frames missing at its end: {missing}"),
            (pictures.n_lost, f"has damaged frames: {pictures.n_lost}"),
            (pictures.n_doubtful, f"has frames built on damaged ones, which were left out: {pictures.n_doubtful}"),
            (pictures.n_backward, f"has frames not later than their predecessors, left out: {pictures.n_backward}"),
        )
        self._pass_notes = tuple(f"{self.name} {note}" for is_so, note in found if is_so)

    def close(self) -> None:
        """End every iteration at its next frame."""
        self._is_closed = True


def _n_left_out(pictures: PicturePass) -> int:
    return pictures.n_lost + pictures.n_doubtful + pictures.n_backward


def _n_missing(probe: VideoProbe, pictures: PicturePass) -> int:
    """Frames that the index of a cut file promises, or the duration in its header where it has no index."""
    if probe.n_index:
        return max(probe.n_index - pictures.n_packets, 0)
    if probe.end_ns is None or pictures.end_pts is None:
        return 0
    gap_ns = probe.end_ns - ns_from_pts(pictures.end_pts, probe.time_base)
    return max(round(gap_ns * probe.rate / 10**9), 0)


def _stamps(path: Path, options: VideoOptions, probe: VideoProbe) -> VideoStamps | None:
    """The stamp table, where there is one, with a row for each frame."""
    table = options.stamp_table or video_table_beside(path)
    if table is None:
        return None
    stamps = read_video_stamps(table)
    if len(stamps.frame) != probe.n_index:
        with open_video(path, options, is_strict=probe.is_strict) as opened:
            pictures = PicturePass(opened, keep_damaged=True)
            check_row_count(stamps, path, pictures.count_packets())
    return stamps
