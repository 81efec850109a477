"""One camera's recording through the detector: the background from a first pass, the spots from a second."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from nodes.camera.camera_detections import CameraDetections
from nodes.camera.lasting_advice import LastingAdvice
from nodes.detection.spots import DetectorOptions, Spot
from nodes.detector_settings import DetectorSettings, NamedSource, read_mask
from nodes.devices.cameras.open_source import open_source
from nodes.devices.cameras.source_info import describe
from nodes.devices.errors import SourceError
from nodes.devices.redaction import redact
from nodes.frames import Frame, FrameSource, StampOrigin
from nodes.spot_detector import SpotDetector, learn_from

# Told to whoever waits: which pass, 0 or 1, and how many frames of it are done.
Passed = Callable[[int, int], None]
# The detector is asked for advice so often; it looks back over some 250 frames.
ADVISED_FRAMES = 125
# A place that is known to no better than this, a smear or a glow, tells a calibration nothing: its other spots are good
# to a tenth of a pixel.
MAX_SIGMA_PX = 2.0
# Best first; what joins stamps of several kinds counts as the worst.
_ORIGINS = tuple(StampOrigin)


@dataclass(frozen=True, slots=True)
class CameraJob:
    """What one process is to do.

    Attributes:
        source: the recording.
        settings: of the detector.
    """

    source: NamedSource
    settings: DetectorSettings


def detect_camera(job: CameraJob, passed: Passed) -> CameraDetections:
    """Find the spot in one recording.

    Args:
        job: what to do.
        passed: called after every frame; what it raises ends the work.

    Raises:
        SpotcalError: the recording cannot be read, holds no frame, or the settings do not fit it.
    """
    with open_source(job.source.text) as source:
        detector = detector_for(source, job.source, job.settings, passed)
        columns = _Columns()
        advice = LastingAdvice()
        for count, frame in enumerate(source, start=1):
            columns.add(frame, [spot for spot in detector.process(frame).spots if spot.sigma_px <= MAX_SIGMA_PX])
            if count % ADVISED_FRAMES == 0:
                advice.note(detector.advice())
            passed(1, count)
        if not columns.sequence:
            raise _no_frames(job.source)
        if len(columns.sequence) < ADVISED_FRAMES:
            advice.note(detector.advice())
        return columns.of(job.source.name, source, advice.messages())


def detector_for(source: FrameSource, named: NamedSource, settings: DetectorSettings, passed: Passed) -> SpotDetector:
    """A detector for a source; with a background from the whole of it, where the settings ask for that.

    Raises:
        SpotcalError: the recording cannot be read, or the mask does not fit it.
    """
    is_whole = settings.n_learning is None
    options = DetectorOptions(
        channel=settings.channel,
        mask=None if named.mask is None else read_mask(named.mask, source.size_px),
        n_learning_frames=settings.n_learning or 0,
        max_candidates=settings.max_candidates,
    )
    if not is_whole:
        return SpotDetector(options)
    return SpotDetector(options, backgrounds=learn_from(_counted(source, named, passed), options))


def _counted(frames: Iterable[Frame], named: NamedSource, passed: Passed) -> Iterator[Frame]:
    count = 0
    for count, frame in enumerate(frames, start=1):
        yield frame
        passed(0, count)
    if not count:
        raise _no_frames(named)


def _no_frames(named: NamedSource) -> SourceError:
    return SourceError(f"{redact(named.text)} holds no frames", advice="Record again, or leave this camera out.")


class _Columns:
    """Collects what becomes CameraDetections."""

    def __init__(self) -> None:
        self.sequence: list[int] = []
        self._stamp_ns: list[int] = []
        self._origin = _ORIGINS[0]
        self._picture: list[int] = []
        self._spots: list[Spot] = []

    def add(self, frame: Frame, spots: Sequence[Spot]) -> None:
        self._picture += [len(self.sequence)] * len(spots)
        self._spots += spots
        self.sequence.append(frame.sequence)
        self._stamp_ns.append(frame.stamp_ns)
        self._origin = max(self._origin, frame.origin, key=_ORIGINS.index)

    def of(self, name: str, source: FrameSource, advice: tuple[str, ...]) -> CameraDetections:
        return CameraDetections(
            name=name,
            source=source.name,
            size_px=source.size_px,
            rate_hz=source.rate_hz,
            origin=self._origin,
            sequence=np.array(self.sequence, dtype=np.int64),
            stamp_ns=np.array(self._stamp_ns, dtype=np.int64),
            picture=np.array(self._picture, dtype=np.int64),
            px=np.array([spot.px for spot in self._spots], dtype=np.float64).reshape(-1, 2),
            sigma_px=np.array([spot.sigma_px for spot in self._spots], dtype=np.float64),
            score=np.array([spot.score for spot in self._spots], dtype=np.float64),
            n_dropped=source.counts.dropped,
            advice=advice,
            notes=describe(source).notes,
        )
