"""Which frames of several recordings show one instant: by their stamps where these are a clock's, else by number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from network_calib.candidates import Candidates
from network_calib.errors import InputError
from network_calib.observations import IntArray
from network_calib.timing import frame_interval_ns, group_by_stamp
from nodes.camera.camera_detections import CameraDetections
from nodes.frames import StampOrigin

# Stamps of these say when a picture was taken; the others say no more than its place in a file or on a network.
CLOCKS = (StampOrigin.CAMERA, StampOrigin.DRIVER, StampOrigin.TABLE)
# A nominal rate is written as 29.97 or 30000/1001; cameras that differ by more do not share a trigger.
MAX_RATE_DIFFERENCE = 0.01
# Part of a frame: containers that count milliseconds write 33 and 34 for 33.3.
MAX_UNEVENNESS = 0.25


@dataclass(frozen=True, slots=True)
class Matched:
    """Frame numbers of several recordings.

    Attributes:
        frames: for each recording (F,) the number of each of its frames; equal numbers mean one instant.
        is_by_stamp: the stamps decided.
        notes: what was assumed or left over, one sentence each.
    """

    frames: tuple[IntArray, ...]
    is_by_stamp: bool
    notes: tuple[str, ...]


def match_frames(recordings: Sequence[CameraDetections], *, tolerance_ns: int | None = None) -> Matched:
    """Number the instants of recordings.

    Args:
        recordings: one for each camera.
        tolerance_ns: for stamps, see `timing.group_by_stamp`.

    Raises:
        InputError: stamps that no tolerance groups, rates that differ, or recordings without a common frame.
    """
    is_by_stamp = all(recording.origin in CLOCKS for recording in recordings)
    frames, notes = _by_stamp(recordings, tolerance_ns) if is_by_stamp else _by_number(recordings)
    _refuse_strangers(recordings, frames, is_by_stamp=is_by_stamp)
    return Matched(frames, is_by_stamp, (*notes, *_length_notes(recordings)))


def candidates_of(recordings: Sequence[CameraDetections], matched: Matched) -> Candidates:
    """One table of all recordings, cameras in their order; stamps only where they are a clock's."""
    per_camera = list(zip(recordings, matched.frames, strict=True))
    return Candidates.from_columns(
        tuple(recording.name for recording in recordings),
        camera=np.concatenate([np.full(len(r.picture), c) for c, r in enumerate(recordings)]),
        frame=np.concatenate([frame[r.picture] for r, frame in per_camera]),
        px=np.concatenate([r.px for r in recordings]),
        sigma_px=np.concatenate([r.sigma_px for r in recordings]),
        score=np.concatenate([r.score for r in recordings]),
        stamp_ns=np.concatenate([r.stamp_ns[r.picture] for r in recordings]) if matched.is_by_stamp else None,
    )


def _by_stamp(
    recordings: Sequence[CameraDetections], tolerance_ns: int | None
) -> tuple[tuple[IntArray, ...], tuple[str, ...]]:
    names = tuple(recording.name for recording in recordings)
    camera = np.concatenate([np.full(r.n_frames, c) for c, r in enumerate(recordings)])
    stamp_ns = np.concatenate([r.stamp_ns for r in recordings])
    instant = group_by_stamp(stamp_ns, camera, tolerance_ns=tolerance_ns, camera_names=names)
    number = _counted(instant, stamp_ns, frame_interval_ns(stamp_ns, camera))
    ends = np.cumsum([r.n_frames for r in recordings])[:-1]
    told = f"frames are matched by their stamps: {len(np.unique(instant))} instants"
    return tuple(np.split(number, ends)), (told,)


def _counted(instant: IntArray, stamp_ns: IntArray, interval_ns: int) -> IntArray:
    """Instants renumbered by time over the frame interval, so that numbers step evenly over lost frames.

    Where the cameras keep no even step and two instants would get one number, they stay counted.
    """
    begin_ns = np.full(int(instant.max()) + 1, np.iinfo(np.int64).max)
    np.minimum.at(begin_ns, instant, stamp_ns)
    step = np.rint(np.diff(begin_ns) / interval_ns).astype(np.int64)
    return instant if (step < 1).any() else np.concatenate([[0], np.cumsum(step)])[instant]


def _by_number(recordings: Sequence[CameraDetections]) -> tuple[tuple[IntArray, ...], tuple[str, ...]]:
    _refuse_rates(recordings)
    is_from_file = any(recording.origin is StampOrigin.FILE for recording in recordings)
    reason = "a video file does not say when it began" if is_from_file else "they carry no stamps of a clock"
    notes = [f"frames are matched by their numbers, because {reason}: frame 0 of each must show the same instant"]
    numbers = tuple(_number(recording) for recording in recordings)
    for recording, number in zip(recordings, numbers, strict=True):
        n_missing = int((number - recording.sequence).max(initial=0))
        if n_missing:
            notes.append(f"{recording.name}: by the times in the file {n_missing} frames were never recorded")
    return numbers, tuple(notes)


def _number(recording: CameraDetections) -> IntArray:
    """(F,) frame numbers; where the times in a file leave gaps of whole frames, so do the numbers.

    A recorder that loses frames writes the others with their own times. Times that step by anything else than whole
    frames are not an even camera's, and say nothing.
    """
    if recording.origin is not StampOrigin.FILE or recording.n_frames < 2:
        return recording.sequence
    step_ns = np.diff(recording.stamp_ns)
    counted = np.diff(recording.sequence)
    steps = step_ns / max(float(np.median(step_ns / np.maximum(counted, 1))), 1.0)
    whole = np.rint(steps).astype(np.int64)
    if (np.abs(steps - whole) > MAX_UNEVENNESS).any() or (whole < counted).any():
        return recording.sequence
    return recording.sequence[0] + np.concatenate([[0], np.cumsum(whole)])


def _refuse_rates(recordings: Sequence[CameraDetections]) -> None:
    known = [(recording.name, recording.rate_hz) for recording in recordings if recording.rate_hz]
    if not known:
        return
    slow, fast = min(known, key=lambda one: one[1]), max(known, key=lambda one: one[1])
    if fast[1] > (1 + MAX_RATE_DIFFERENCE) * slow[1]:
        raise InputError(
            f"{slow[0]} has {slow[1]:.6g} frames a second and {fast[0]} has {fast[1]:.6g}: frames of equal number are "
            "not of one instant",
            advice="Record all cameras at one rate from a common trigger, or give stamps: a folder of images with a "
            "table of stamps.",
        )


def _refuse_strangers(recordings: Sequence[CameraDetections], frames: Sequence[IntArray], *, is_by_stamp: bool) -> None:
    """A camera whose frames meet those of no other camera."""
    numbers, n_cameras = np.unique(np.concatenate([np.unique(frame) for frame in frames]), return_counts=True)
    shared = numbers[n_cameras > 1]
    lonely = [r.name for r, frame in zip(recordings, frames, strict=True) if not np.isin(frame, shared).any()]
    if lonely:
        key = "stamp" if is_by_stamp else "number"
        raise InputError(
            f"no frame of {', '.join(lonely)} has the {key} of a frame of another camera",
            advice="Give recordings of one and the same walk.",
        )


def _length_notes(recordings: Sequence[CameraDetections]) -> tuple[str, ...]:
    lengths = [recording.n_frames for recording in recordings]
    notes = []
    if min(lengths) != max(lengths):
        listed = ", ".join(f"{r.name} {r.n_frames}" for r in recordings)
        notes.append(f"the recordings differ in length (frames: {listed}); what only one camera recorded is of no use")
    dropped = [(r.name, r.n_dropped) for r in recordings if r.n_dropped]
    if dropped:
        notes.append("frames that could not be read: " + ", ".join(f"{name} {n}" for name, n in dropped))
    return tuple(notes)
