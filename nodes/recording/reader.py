"""Rows of a recording: of a folder, finished or not, or of one .mcap file, whole or cut off anywhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Metadata

from network_calib.errors import InputError
from nodes.recording.layout import DERIVED, METADATA, SESSION, SITE_NAME, part_number, parts_of
from nodes.recording.mcap_records import REMARKS, Message, records


@dataclass(frozen=True, slots=True)
class Row:
    """One message as it was received.

    Attributes:
        key: it was published under.
        payload: as it arrived.
        log_ns: arrival at the recorder.
        publish_ns: `header.stamp_ns`.
    """

    key: str
    payload: bytes
    log_ns: int
    publish_ns: int


@dataclass(frozen=True, slots=True)
class About:
    """What a recording says of itself; the last word counts.

    Attributes:
        session: id; empty where the recorder was not told.
        program_version: of spotcal that wrote it.
        site_toml: text of the site's configuration; empty: none.
        merged_to: number of the last part that `session.mcap` holds; 0 for anything else.
    """

    session: str = ""
    program_version: str = ""
    site_toml: str = ""
    merged_to: int = 0


def rows(path: Path, *, faults: Counter[str] | None = None) -> Iterator[Row]:
    """All whole rows, in the order of their arrival; what was made for viewers is left out.

    Args:
        path: a session folder or a .mcap file.
        faults: counts records that were left out, by reason; the torn end of a file is none.

    Raises:
        InputError: nothing there, or no recording.
    """
    counted = Counter[str]() if faults is None else faults
    for file in files_of(path):
        yield from _rows_of(file, counted)


def about(path: Path) -> About:
    """What a recording says of itself.

    Raises:
        InputError: nothing there, or no recording.
    """
    told = About()
    for file in files_of(path):
        one = about_file(file)
        told = About(
            one.session or told.session,
            one.program_version or told.program_version,
            one.site_toml or told.site_toml,
            max(one.merged_to, told.merged_to),
        )
    return told


def about_file(path: Path) -> About:
    """What one file says of itself.

    Raises:
        InputError: no MCAP file.
    """
    words, site_toml = dict[str, str](), ""
    for record in records(path, Counter(), only=REMARKS):
        if isinstance(record, Metadata) and record.name == METADATA:
            words |= record.metadata
        elif isinstance(record, Attachment) and record.name == SITE_NAME:
            site_toml = record.data.decode("utf-8", errors="replace")
    merged_to = words.get("merged_to", "")
    return About(
        words.get("session", ""),
        words.get("program_version", ""),
        site_toml,
        int(merged_to) if merged_to.isdecimal() and len(merged_to) < 10 else 0,
    )


def files_of(path: Path) -> tuple[Path, ...]:
    """The files that make up a recording, in their order: `session.mcap`, then the parts that it does not hold.

    A crash between a merge and the removal of its parts leaves both.

    Raises:
        InputError: nothing there.
    """
    if path.is_file():
        return (path,)
    if not path.is_dir():
        raise InputError(f"{path} is not there", advice="Give a session folder, or a .mcap recording.")
    session, parts = path / SESSION, parts_of(path)
    files = parts
    if session.is_file():
        merged_to = about_file(session).merged_to if parts else 0
        files = (session, *(part for part in parts if (part_number(part) or 0) > merged_to))
    if not files:
        raise InputError(f"{path} holds no recording", advice=f"Expected {SESSION}, or parts of it.")
    return files


def _rows_of(file: Path, faults: Counter[str]) -> Iterator[Row]:
    topics: dict[int, str] = {}
    for record in records(file, faults):
        if isinstance(record, Message):
            topic = topics.get(record.channel)
            if topic is None:
                faults["recording: message without a channel"] += 1
            elif not topic.startswith(DERIVED):
                yield Row(topic, record.data, record.log_ns, record.publish_ns)
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
