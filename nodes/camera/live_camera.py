"""What a camera node does with the frames of one camera: nothing, learn, or watch. No thread, device or bus."""

from __future__ import annotations

from dataclasses import dataclass, field

from nodes.bus import spotcal_pb2 as pb
from nodes.camera.session_marks import SessionMark, SessionMarks
from nodes.camera.spot_batches import BatchOptions, SpotBatcher
from nodes.detection.spots import DetectorOptions, DetectorState
from nodes.frames import Frame
from nodes.spot_detector import SpotDetector

ADVISED_FRAMES = 25
IDLE = "waiting"
WATCHING = DetectorState.WATCHING


@dataclass(frozen=True, slots=True)
class Resumed:
    """A session that the node was in when it ended.

    Attributes:
        mark: where it began; None where the same frames cannot be had again.
        last_sequence: of the last frame that was published.
    """

    mark: SessionMark | None
    last_sequence: int = -1


@dataclass(slots=True)
class LiveCounts:
    """Running figures of one camera."""

    n_frames: int = 0
    n_detections: int = 0
    advice: tuple[str, ...] = field(default=())


class LiveCamera:
    """The detector of one camera through sessions.

    Args:
        detector: options of the detector.
        batches: options of the messages.
        marks: where the beginning of a session is noted; None where frames cannot be had again.
    """

    def __init__(self, detector: DetectorOptions, batches: BatchOptions, marks: SessionMarks | None) -> None:
        self._options, self._camera, self._marks = detector, batches.camera, marks
        self._batcher = SpotBatcher(batches)
        self._detector: SpotDetector | None = None
        self._mark: SessionMark | None = None
        self._after = -1
        self._is_room_empty = True
        self._is_relearning = False
        self.session = ""
        self.state = IDLE
        self.counts = LiveCounts()

    def mark_of(self, session: str) -> SessionMark | None:
        """Where the session began; None where it did not, or the same frames cannot be had again."""
        return None if self._marks is None else self._marks.of(self._camera, session)

    def begin(self, session: str, resumed: Resumed | None = None) -> None:
        """Learn the background from the next frames, then watch."""
        self._batcher.flush()
        self._detector, self.session, self.state = None, session, str(DetectorState.LEARNING)
        self._mark = None if resumed is None else resumed.mark
        self._after = -1 if resumed is None or resumed.mark is None else resumed.last_sequence
        # Where a session goes on with other frames, somebody with the spot may be in them.
        self._is_room_empty = resumed is None or resumed.mark is not None

    def end(self) -> None:
        """Watch no more; frames that were not published yet are no longer asked for."""
        self._batcher.flush()
        self._detector, self.session, self.state = None, "", IDLE

    def relearn(self) -> None:
        """Learn the background anew, from the next frame on."""
        self._is_relearning = self._detector is not None

    def take(self, frame: Frame, *, n_dropped: int, began_ns: int) -> list[pb.SpotBatch]:
        """The next frame; the messages that are full now.

        Raises:
            InputError: the frame is of another size or format than those before.
        """
        self.counts.n_frames += 1
        if not self.session:
            return []
        is_first = self._detector is None
        detector = self._detector or SpotDetector(self._options)
        if is_first:
            self._detector = detector
            self._note_beginning(frame, began_ns)
        self._relearn_if_due(frame, detector)
        detections = detector.process(frame)
        if is_first and not self._is_room_empty:
            detector.relearn()
        self.state = str(WATCHING if detections.state is WATCHING else DetectorState.LEARNING)
        if self.counts.n_frames % ADVISED_FRAMES == 0:
            self.counts.advice = tuple(advice.message for advice in detector.advice())
        if detections.state is not WATCHING or frame.sequence <= self._after:
            return []
        self.counts.n_detections += bool(detections.spots)
        return self._batcher.add(frame, detections.spots, n_dropped=n_dropped)

    def flush(self) -> list[pb.SpotBatch]:
        """What was gathered, full or not."""
        return self._batcher.flush()

    def _note_beginning(self, frame: Frame, began_ns: int) -> None:
        if self._marks is not None and self._mark is None:
            # Begun in a room that may not be empty, the background is learnt anew behind the first frame, see `take`.
            relearnt = () if self._is_room_empty else (frame.sequence + 1,)
            self._mark = SessionMark(self.session, frame.sequence, began_ns, relearnt)
            self._marks.begin(self._camera, self._mark)

    def _relearn_if_due(self, frame: Frame, detector: SpotDetector) -> None:
        if self._mark is not None and frame.sequence in self._mark.relearnt:
            detector.relearn()
        if self._is_relearning:
            self._is_relearning = False
            detector.relearn()
            if self._marks is not None:
                self._marks.relearn(self._camera, frame.sequence)
