"""Makes `session.mcap` of what a recording is so far: in one file, doubled rows dropped, compressed, indexed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from nodes.bus.checks import Observation
from nodes.bus.ledger import Ledger
from nodes.recording.derived import Derivation, DerivedMessage, observation_of
from nodes.recording.disk import sync_folder, writing
from nodes.recording.folder_lock import FolderLock
from nodes.recording.layout import (
    CALIBRATION,
    METADATA,
    PARTS,
    SESSION,
    SITE_NAME,
    SITE_TYPE,
    TEMPORARY,
    part_number,
    parts_of,
)
from nodes.recording.reader import About, Row, about, rows
from nodes.recording.schemas import Channels


def merge(folder: Path, remarks: dict[str, str]) -> Path:
    """Write `session.mcap` whole, put it in place, then remove the parts that it holds.

    A crash at any moment loses and doubles nothing: until the new file stands in place the parts count, and from then
    on the number of the last part, which is written in it, says which parts it holds.

    Args:
        folder: of the recording, with its parts.
        remarks: for the metadata.

    Raises:
        OSError: the disk is full or fails; the parts stay.
    """
    told = about(folder)
    merged_to = max([told.merged_to, *(part_number(path) or 0 for path in parts_of(folder))])
    told = About(remarks["session"] or told.session, remarks["program_version"], told.site_toml, merged_to)
    temporary, session = folder / TEMPORARY, folder / SESSION
    try:
        with temporary.open("wb") as file:
            _Merged(file, told).write(folder)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(session)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(folder)
    _remove_merged(folder, merged_to)
    return session


def rewrite(folder: Path) -> Path:
    """Make `session.mcap` anew, with what viewers get of a `calibration.json` that stands beside it since.

    Raises:
        DeviceError: the disk is full or fails; the former file stays.
        InputError: no recording there, or another program records there.
    """
    told = about(folder)
    lock = FolderLock(folder)
    try:
        with writing(folder):
            return merge(folder, {"session": told.session, "program_version": told.program_version})
    finally:
        lock.release()


def _remove_merged(folder: Path, merged_to: int) -> None:
    for path in parts_of(folder):
        if (part_number(path) or 0) <= merged_to:
            path.unlink()
    parts = folder / PARTS
    if parts.is_dir() and not any(parts.iterdir()):
        parts.rmdir()


class _Merged:
    """The new file, while it is written."""

    def __init__(self, file: BinaryIO, told: About) -> None:
        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="spotcal")
        self._writer.add_metadata(
            METADATA,
            {
                "session": told.session,
                "program_version": told.program_version,
                "merged_to": str(told.merged_to),
            },
        )
        if told.site_toml:
            self._writer.add_attachment(0, 0, SITE_NAME, SITE_TYPE, told.site_toml.encode())
        self._channels = Channels(self._writer)
        self._ledger = Ledger()

    def write(self, folder: Path) -> None:
        derivation = Derivation.over(rows(folder), folder / CALIBRATION)
        is_first = True
        for row in rows(folder):
            if is_first:
                self._derive(derivation.at_start(row.log_ns))
                is_first = False
            observation = observation_of(row)
            if observation is None or self._is_new(observation):
                self._add(row)
                if observation is not None:
                    self._derive(derivation.of(observation))
        self._writer.finish()

    def _is_new(self, observation: Observation) -> bool:
        header = observation.header
        return self._ledger.insert(header.node, header.boot, header.sequence)

    def _add(self, row: Row) -> None:
        channel = self._channels.of_key(row.key)
        self._writer.add_message(channel, log_time=row.log_ns, data=row.payload, publish_time=row.publish_ns)

    def _derive(self, messages: Iterator[DerivedMessage]) -> None:
        for derived in messages:
            channel = self._channels.of_topic(derived.topic, type(derived.message))
            if channel is not None:
                data = derived.message.SerializeToString()
                self._writer.add_message(channel, log_time=derived.stamp_ns, data=data, publish_time=derived.stamp_ns)
