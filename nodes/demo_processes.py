"""Programs that the demonstration starts, watches, and ends whatever happens."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from nodes.closing import Closing
from nodes.devices.errors import DeviceError

ENDING_S = 6.0
N_TAIL_LINES = 15
# Small matrices: more threads than one make each process slower, and there are processes enough.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"}


@dataclass(slots=True)
class Child:
    """One program.

    Attributes:
        name: for messages and its log.
        process: it.
        log: what it said.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    _echo: threading.Thread | None = field(default=None)

    def tail(self) -> str:
        """The last lines that it said."""
        text = self.log.read_text(encoding="utf-8", errors="replace")
        return "\n".join(text.splitlines()[-N_TAIL_LINES:])

    def signal(self, number: signal.Signals) -> None:
        """To it and all that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def join(self) -> None:
        """Wait until all it said has been told, once it has ended."""
        if self._echo is not None:
            self._echo.join(timeout=ENDING_S)


class Children(Closing):
    """All programs, each in a process group of its own; `with` ends them.

    Args:
        logs: folder, which is there.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._all: list[Child] = []

    def start(self, name: str, command: Sequence[str], *, echo: Callable[[str], None] | None = None) -> Child:
        """Start a program.

        Args:
            name: of its log.
            command: program and arguments.
            echo: gets every line that it says, too.
        """
        log = self._logs / f"{name}.log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file if echo is None else subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env={**os.environ, **ENVIRONMENT},
            )
        child = Child(name, process, log)
        self._all.append(child)
        if echo is not None and process.stdout is not None:
            child._echo = threading.Thread(target=_tee, args=(process.stdout, log, echo), daemon=True)
            child._echo.start()
        return child

    def check(self, *, but: Child | None = None) -> None:
        """Make sure that all run.

        Raises:
            DeviceError: one has ended; with the end of its log.
        """
        for child in self._all:
            status = child.process.poll()
            if status is not None and child is not but:
                raise DeviceError(
                    f"{child.name} ended by itself with status {status}; its last words:\n{child.tail()}",
                    advice=f"All that it said is in {child.log}.",
                )

    def close(self) -> None:
        """End all, those started last first: asked to at first, then not asked."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            for child in reversed(self._all):
                if child.process.poll() is None or number is signal.SIGKILL:
                    child.signal(number)
            for child in self._all:
                try:
                    child.process.wait(timeout=ENDING_S)
                except subprocess.TimeoutExpired:
                    continue
        for child in self._all:
            child.join()
        self._all.clear()


def _tee(source: IO[bytes], log: Path, echo: Callable[[str], None]) -> None:
    with log.open("ab", buffering=0) as file, source:
        for line in source:
            file.write(line)
            echo(line.decode(errors="replace").rstrip("\r\n"))
