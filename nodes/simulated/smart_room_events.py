"""What happens in the simulated smart room, in a file that all its processes read: the one thing they share.

A line of `events.jsonl` is one event: `{"kind": "wave", "begin_s": .., "seconds": ..}`,
`{"kind": "stop", "time_s": ..}`, `{"kind": "rest", "time_s": .., "tilt_rad": ..}`, `{"kind": "move", "time_s": ..}`;
times are seconds of the Unix epoch.
Lines are only ever added, and what an event changes lies at least LEAD_S after its time: so every process knows it by
then, and the truth of an instant does not depend on who asks.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from network_calib.errors import InputError

EVENTS_FILE = "events.jsonl"
# Longer than any process takes to read the file again.
LEAD_S = 0.6


@dataclass(frozen=True, slots=True)
class Wave:
    """The person waves the spot all over the room.

    Attributes:
        begin_s: when; LEAD_S or more after it is written.
        seconds: how long.
    """

    begin_s: float
    seconds: float
    kind: str = "wave"


@dataclass(frozen=True, slots=True)
class Stop:
    """The person ends the wave early, at `time_s`; LEAD_S or more after it is written."""

    time_s: float
    kind: str = "stop"


@dataclass(frozen=True, slots=True)
class Rest:
    """The tilt unit came to rest at `time_s`, at a true tilt."""

    time_s: float
    tilt_rad: float
    kind: str = "rest"


@dataclass(frozen=True, slots=True)
class Move:
    """The tilt unit began to move at `time_s`: the person puts the spot away LEAD_S later."""

    time_s: float
    kind: str = "move"


Event = Wave | Stop | Rest | Move
_KINDS: dict[str, type[Wave] | type[Stop] | type[Rest] | type[Move]] = {
    "wave": Wave,
    "stop": Stop,
    "rest": Rest,
    "move": Move,
}


class EventFile:
    """The file: appended to whole lines at a time, and read on from where it was read before."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / EVENTS_FILE
        self._n_read = 0
        self._rest = b""

    def append(self, event: Event) -> None:
        """Add one event; safe with several processes, since short appends are not mixed up."""
        line = json.dumps(asdict(event)).encode() + b"\n"
        target = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(target, line)
        finally:
            os.close(target)

    def new(self) -> list[Event]:
        """Events that were added since the last call.

        Raises:
            InputError: a line is no event.
        """
        try:
            if self.path.stat().st_size == self._n_read:
                return []
            with self.path.open("rb") as file:
                file.seek(self._n_read)
                data = file.read()
        except FileNotFoundError:
            return []
        self._n_read += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [_event(line, self.path) for line in lines if line.strip()]


def _event(line: bytes, path: Path) -> Event:
    try:
        fields = json.loads(line)
        return _KINDS[fields["kind"]](**fields)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: {line[:200]!r} is no event of the smart room: {error}") from None
