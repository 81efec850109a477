"""`spotcal spot`: the detector alone on one camera or recording, with rate, spots and advice live."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text
from threadpoolctl import threadpool_limits

from network_calib.errors import InputError
from nodes.camera.detect_camera import detector_for
from nodes.detection.spots import Detections, DetectorState, Spot
from nodes.detector_settings import DetectorSettings, NamedSource, is_recording
from nodes.devices.cameras.open_source import open_source
from nodes.devices.cameras.source_info import describe
from nodes.devices.errors import SourceError
from nodes.devices.redaction import redact
from nodes.frames import Frame, FrameSource
from nodes.report.tables import plain_table, share
from nodes.spot_detector import SpotDetector

DEFAULT_LIVE_BACKGROUND = "first:50"
REFRESH_S = 0.2


@dataclass(slots=True)
class Summary:
    """Running figures of one source.

    Attributes:
        name: of the source.
        size_px: width and height.
        n_frames: processed.
        n_watched: of them with a known background.
        n_seen: of these with a spot.
        n_candidates: all spots.
        best: the best spot of the latest frame, None where there is none.
        state: of the detector in the latest frame.
        seconds: since the first frame.
        n_lost: frames that the source knows it lost.
        advice: what may be better.
        notes: what the source says of itself.
    """

    name: str
    size_px: tuple[int, int]
    n_frames: int = 0
    n_watched: int = 0
    n_seen: int = 0
    n_candidates: int = 0
    best: Spot | None = None
    state: DetectorState = DetectorState.LEARNING
    seconds: float = 0.0
    n_lost: int = 0
    advice: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def rate_hz(self) -> float:
        """Frames a second that were processed."""
        return self.n_frames / self.seconds if self.seconds > 0 else 0.0

    def add(self, detections: Detections) -> None:
        """One more frame."""
        self.n_frames += 1
        self.state = detections.state
        self.n_watched += detections.state is DetectorState.WATCHING
        self.n_seen += bool(detections.spots)
        self.n_candidates += len(detections.spots)
        self.best = detections.spots[0] if detections.spots else None


def watch(
    named: NamedSource, settings: DetectorSettings, *, max_frames: int | None, save: Path | None, console: Console
) -> Summary:
    """Run the detector until the source ends, so many frames are done, or the person interrupts.

    Args:
        named: the source; a live camera cannot be learnt from as a whole.
        settings: of the detector.
        max_frames: None for no limit.
        save: folder for pictures with the spots drawn in; made when missing.
        console: shows the figures while they change.

    Raises:
        SpotcalError: the source cannot be read, or fails for good.
    """
    if settings.n_learning is None and not is_recording(named.text):
        raise InputError(
            f"--background whole: {redact(named.text)} is no recording, which could be looked through twice",
            advice="Leave the pointer off at first, and use --background first:50.",
        )
    if save is not None:
        save.mkdir(parents=True, exist_ok=True)
    # Fits are of small matrices: with the default threads one takes a hundred times as long on a busy machine.
    with threadpool_limits(1), open_source(named.text) as source:
        summary = Summary(source.name, source.size_px)
        with Live(console=console, transient=True, refresh_per_second=1 / REFRESH_S) as live:

            def passed(_pass: int, n_frames: int) -> None:
                live.update(Text(f"{source.name}: learning the background, {n_frames} frames"))

            detector = detector_for(source, named, settings, passed)
            try:
                _run(source, detector, summary, max_frames=max_frames, save=save, live=live)
            except KeyboardInterrupt:
                if not summary.n_frames:
                    raise
        summary.notes = describe(source).notes
    if not summary.n_frames:
        raise SourceError(f"{redact(named.text)} holds no frames", advice="Check that it plays.")
    return summary


def summary_view(summary: Summary) -> Group:
    """Figures as a table, then notes and advice."""
    table = plain_table(summary.name, "", "")
    table.show_header = False
    rows = [
        ("size", f"{summary.size_px[0]} x {summary.size_px[1]} px"),
        ("frames", f"{summary.n_frames}, {summary.rate_hz:.1f} a second; {summary.n_lost} lost"),
        ("with a spot", f"{summary.n_seen} of {summary.n_watched} watched, {share(summary.n_seen, summary.n_watched)}"),
        ("candidates", f"{summary.n_candidates}"),
        ("now", _told(summary)),
    ]
    for name, value in rows:
        table.add_row(name, value)
    notes = [Text(f"note: {note}") for note in summary.notes]
    return Group(table, *notes, *(Text(f"advice: {text}", style="yellow") for text in summary.advice))


def _told(summary: Summary) -> str:
    best = summary.best
    if best is None:
        return "no spot" if summary.state is DetectorState.WATCHING else summary.state.value
    smear = f", smear {best.smear_px:.0f} px" if best.smear_px else ""
    return (
        f"{best.px[0]:.2f}, {best.px[1]:.2f} px, σ {best.sigma_px:.3f}, score {best.score:.2f}, "
        f"peak {best.peak:.0%}{smear}"
    )


def _run(
    source: FrameSource,
    detector: SpotDetector,
    summary: Summary,
    *,
    max_frames: int | None,
    save: Path | None,
    live: Live,
) -> None:
    begin = time.monotonic()
    shown = begin
    try:
        for frame in source:
            detections = detector.process(frame)
            summary.add(detections)
            if save is not None:
                _save(frame, detections, save)
            now = time.monotonic()
            is_last = summary.n_frames == max_frames
            if now - shown >= REFRESH_S or is_last:
                shown = now
                _update(summary, source, detector, now - begin)
                live.update(summary_view(summary))
            if is_last:
                break
    finally:  # the person may have ended it between two updates
        _update(summary, source, detector, time.monotonic() - begin)


def _update(summary: Summary, source: FrameSource, detector: SpotDetector, seconds: float) -> None:
    summary.seconds = seconds
    summary.n_lost = source.counts.dropped
    summary.advice = tuple(one.message for one in detector.advice())


def _save(frame: Frame, detections: Detections, folder: Path) -> None:
    from nodes.camera.annotate import annotated, save_picture

    save_picture(annotated(frame, detections), folder, frame.sequence)
