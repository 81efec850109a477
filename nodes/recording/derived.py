"""What viewers get of a recording: for each row the messages in the Foxglove schemas that follow from it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from google.protobuf.message import Message

from network_calib.errors import InputError
from network_calib.formats.calibration_json import load
from network_calib.result import Calibration
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MessageError, Observation, parse, parse_observation
from nodes.bus.keys import Kind
from nodes.recording import foxglove
from nodes.recording.reader import Row
from nodes.recording.schemas import address_of, message_type_of


@dataclass(frozen=True, slots=True)
class DerivedMessage:
    """One message for viewers, at the time of what it shows."""

    topic: str
    message: Message
    stamp_ns: int


@dataclass(slots=True)
class Derivation:
    """What must be known of the whole recording before its rows can be turned.

    Attributes:
        calibration: the last one; None: not calibrated.
        infos: what each LRF is.
        annotated: cameras whose last annotation shows something.
    """

    calibration: Calibration | None = None
    infos: dict[str, pb.LrfInfo] = field(default_factory=dict)
    annotated: set[str] = field(default_factory=set)

    @classmethod
    def over(cls, rows: Iterable[Row], calibration: Path) -> Derivation:
        """Look through all rows.

        Args:
            rows: of the recording.
            calibration: file that counts more than what the rows say; need not be there.
        """
        self, last_calibration = cls(), None
        for row in rows:
            key = address_of(row.key)
            if key is not None and key.kind is Kind.LRF_INFO:
                observation = observation_of(row)
                if isinstance(observation, pb.LrfInfo):
                    self.infos[observation.lrf] = observation
            elif key is None and message_type_of(row.key) is pb.Calibration:
                last_calibration = row
        with suppress(InputError):
            if calibration.is_file():
                self.calibration = load(calibration)
        if self.calibration is None and last_calibration is not None:
            self.calibration = _calibration_of(last_calibration)
        return self

    def at_start(self, stamp_ns: int) -> Iterator[DerivedMessage]:
        """The calibration, which holds for the whole recording."""
        if self.calibration is None:
            return
        for camera in self.calibration.cameras:
            message = foxglove.camera_calibration(camera, stamp_ns)
            yield DerivedMessage(foxglove.calibration_topic(camera.name), message, stamp_ns)
        transforms = foxglove.all_transforms(self.calibration, stamp_ns)
        yield DerivedMessage(foxglove.TRANSFORMS, transforms, stamp_ns)

    def of(self, observation: Observation) -> Iterator[DerivedMessage]:
        """What follows from one observation."""
        if isinstance(observation, pb.SpotBatch):
            yield from self._annotations(observation)
        elif isinstance(observation, pb.LrfScan) and observation.lrf in self.infos:
            scan = foxglove.laser_scan(observation, self.infos[observation.lrf])
            if scan is not None:
                yield DerivedMessage(foxglove.scan_topic(observation.lrf), scan, observation.stamp_ns)
        elif isinstance(observation, pb.TiltSample) and self.calibration is not None:
            stamp_ns = observation.header.stamp_ns
            for lrf in self.calibration.lrfs:
                if lrf.name == observation.lrf:
                    transforms = foxglove.tilted_transform(lrf, observation, stamp_ns)
                    yield DerivedMessage(foxglove.TRANSFORMS, transforms, stamp_ns)

    def _annotations(self, batch: pb.SpotBatch) -> Iterator[DerivedMessage]:
        """Frames with candidates, and the first one without any after these."""
        px: list[list[tuple[float, float]]] = [[] for _ in batch.frame_stamp_ns]
        for frame, x_px, y_px in zip(batch.spot_frame, batch.x_px, batch.y_px, strict=True):
            px[frame].append((x_px, y_px))
        topic = foxglove.spots_topic(batch.camera)
        for stamp_ns, spots in zip(batch.frame_stamp_ns, px, strict=True):
            if spots or batch.camera in self.annotated:
                yield DerivedMessage(topic, foxglove.spot_annotations(stamp_ns, spots), stamp_ns)
            (self.annotated.add if spots else self.annotated.discard)(batch.camera)


def observation_of(row: Row) -> Observation | None:
    """The observation in a row; None for other rows, and for what is refused."""
    key = address_of(row.key)
    if key is None:
        return None
    try:
        return parse_observation(key.kind, row.payload, node=key.node, now_ns=row.log_ns)
    except MessageError:
        return None


def _calibration_of(row: Row) -> Calibration | None:
    try:
        message = parse(pb.Calibration, row.payload, node=None, now_ns=row.log_ns)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "calibration.json"
            path.write_bytes(message.calibration_json)
            return load(path)
    except (MessageError, InputError):
        return None
