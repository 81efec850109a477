"""The folder of a session: what the coordinator must know to go on after it was killed, in `state.json`."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from network_calib.errors import InputError
from nodes.bus.keys import NAME, check_name
from nodes.coordinator.phases import Phase, State
from nodes.room_file import write_whole

STATE = "state.json"
VERSION = 1
_MAX_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class Saved:
    """What `state.json` holds.

    Attributes:
        session: id.
        begun_s: when the session began, seconds since the epoch.
        phase: where it is.
        since_s: since when.
        warning: about how it came there.
        was_stopped: the nodes were told to stop.
    """

    session: str
    begun_s: float
    phase: Phase
    since_s: float
    warning: str = ""
    was_stopped: bool = False

    @property
    def state(self) -> State:
        return State(self.phase, self.since_s, self.warning)


@dataclass(frozen=True, slots=True)
class SessionFolder:
    """One session's folder, which need not be there yet."""

    path: Path

    @property
    def calibration(self) -> Path:
        return self.path / "calibration.json"

    @property
    def aniposelib(self) -> Path:
        return self.path / "aniposelib.toml"

    @property
    def report(self) -> Path:
        return self.path / "report.html"

    def save(self, saved: Saved) -> None:
        """Write the state, whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        text = json.dumps({"version": VERSION, **asdict(saved)}, indent=1) + "\n"
        write_whole(self.path / STATE, lambda path: path.write_text(text, encoding="utf-8"))

    def load(self) -> Saved | None:
        """The state; None where there is none.

        Raises:
            InputError: there is a file that is none.
        """
        path = self.path / STATE
        if not path.is_file():
            return None
        try:
            if path.stat().st_size > _MAX_BYTES:
                raise ValueError("too large")
            return _saved(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path} is no state of a session: {error}",
                advice="Begin another session with --session NAME; the recording beside it is not touched.",
            ) from None


def new_name(now_s: float) -> str:
    """A session's name by local date and time."""
    return datetime.fromtimestamp(now_s).strftime("%Y-%m-%d-%H%M%S")


def choose_session(data: Path, asked: str | None, *, now_s: float) -> tuple[SessionFolder, Saved | None]:
    """The session that was asked for, or the newest one where it is not finished, or a new one.

    Args:
        data: folder of the sessions.
        asked: name of one; None for none in particular.
        now_s: seconds since the epoch.

    Returns:
        Its folder, and its state where it was begun before.

    Raises:
        InputError: a name that cannot be one, or a state that cannot be read.
    """
    if asked is not None:
        folder = SessionFolder(data / check_name(asked, of="session"))
        return folder, folder.load()
    newest = newest_session(data)
    if newest is not None and not newest[1].phase.is_over:
        return newest
    return SessionFolder(data / new_name(now_s)), None


def newest_session(data: Path) -> tuple[SessionFolder, Saved] | None:
    """The session that began last; folders without a readable state are none."""
    found: list[tuple[SessionFolder, Saved]] = []
    for path in data.iterdir() if data.is_dir() else ():
        if NAME.fullmatch(path.name) is None:
            continue
        try:
            saved = SessionFolder(path).load()
        except InputError:
            continue
        if saved is not None:
            found.append((SessionFolder(path), saved))
    return max(found, key=lambda one: one[1].begun_s, default=None)


def _saved(document: dict[str, object]) -> Saved:
    if document["version"] != VERSION:
        raise ValueError(f"version {document['version']}, expected {VERSION}")
    begun_s, since_s = document["begun_s"], document["since_s"]
    for number in (begun_s, since_s):
        if not isinstance(number, int | float) or not math.isfinite(number):
            raise ValueError(f"{number!r} is no time")
    session, warning, was_stopped = document["session"], document["warning"], document["was_stopped"]
    if not (isinstance(session, str) and NAME.fullmatch(session)):
        raise ValueError(f"{session!r} is no name of a session")
    if not isinstance(warning, str) or not isinstance(was_stopped, bool):
        raise ValueError("warning or was_stopped of another kind")
    return Saved(session, float(begun_s), Phase(str(document["phase"])), float(since_s), warning, was_stopped)  # pyright: ignore[reportArgumentType]
