"""Where a session began in each camera's frames, so that a node that was killed can look at the same frames again.

Only for sources that can be asked for the same frames twice: recordings and simulated cameras. The detector is fed
with them anew from the mark on, which gives the same spots, bit for bit, and what the journal holds is left out.
"""

from __future__ import annotations

import json
import os
import threading
from dataclasses import asdict, dataclass, replace
from pathlib import Path

SUFFIX = ".marks"


@dataclass(frozen=True, slots=True)
class SessionMark:
    """Of one camera.

    Attributes:
        session: its id.
        first_sequence: of the first frame from which the background was learnt.
        began_ns: when that was, on this machine's clock.
        relearnt: sequences of the frames before which the background was to be learnt anew.
    """

    session: str
    first_sequence: int
    began_ns: int
    relearnt: tuple[int, ...] = ()


class SessionMarks:
    """The marks of a node's cameras, in a file beside its journal."""

    def __init__(self, journal: Path) -> None:
        self._path = journal.with_name(journal.name + SUFFIX)
        self._lock = threading.Lock()
        self._marks = _read(self._path)

    def of(self, camera: str, session: str) -> SessionMark | None:
        """Of a camera and session; None where it has none."""
        mark = self._marks.get(camera)
        return mark if mark is not None and mark.session == session else None

    def begin(self, camera: str, mark: SessionMark) -> None:
        """Note where a session begins; it is on disk when this returns."""
        with self._lock:
            self._marks[camera] = mark
            self._write()

    def relearn(self, camera: str, sequence: int) -> None:
        """Note before which frame the background is to be learnt anew."""
        with self._lock:
            if (mark := self._marks.get(camera)) is not None:
                self._marks[camera] = replace(mark, relearnt=(*mark.relearnt, sequence))
                self._write()

    def _write(self) -> None:
        part = self._path.with_name(self._path.name + ".part")
        with part.open("w", encoding="utf-8") as file:
            json.dump({camera: asdict(mark) for camera, mark in self._marks.items()}, file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(self._path)


def _read(path: Path) -> dict[str, SessionMark]:
    """What stands there; nothing where the file is missing or none of ours."""
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        return {
            camera: SessionMark(
                str(mark["session"]), int(mark["first_sequence"]), int(mark["began_ns"]), tuple(mark["relearnt"])
            )
            for camera, mark in given.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
