"""Keys of a terminal, read one at a time without waiting; where there is no terminal there are none."""

from __future__ import annotations

import os
import select
import sys
from types import TracebackType
from typing import Any, Self

from nodes.coordinator.phases import Press

KEYS = {
    "\n": Press.ON,
    "\r": Press.ON,
    " ": Press.ON,
    "s": Press.SOLVE,
    "r": Press.RELEARN,
    "n": Press.TILT,
    "q": Press.QUIT,
}
HELP = "Enter: go on   s: solve now   r: relearn backgrounds   n: next tilt   q: stop"


def presses_of(text: str) -> tuple[Press, ...]:
    """What typed text asks for; other keys ask for nothing."""
    return tuple(KEYS[character] for character in text.lower() if character in KEYS)


class Keyboard:
    """The terminal on standard input, for as long as the `with` lasts: keys come at once and are not shown.

    A terminal that belongs to another job, as for a program in the background, is left alone.
    """

    def __init__(self) -> None:
        self._fd: int | None = None
        self._before: list[Any] = []

    @property
    def is_there(self) -> bool:
        """Somebody can press keys."""
        return self._fd is not None

    def __enter__(self) -> Self:
        import termios
        import tty

        fd = _own_terminal()
        if fd is not None:
            self._before = termios.tcgetattr(fd)
            tty.setcbreak(fd)
            self._fd = fd
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        import termios

        if self._fd is not None:
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
            self._fd = None

    def presses(self) -> tuple[Press, ...]:
        """What was pressed since the last call."""
        if self._fd is None or not select.select([self._fd], [], [], 0)[0]:
            return ()
        return presses_of(os.read(self._fd, 1024).decode(errors="ignore"))


def _own_terminal() -> int | None:
    try:
        fd = sys.stdin.fileno()
        return fd if os.isatty(fd) and os.tcgetpgrp(fd) == os.getpgrp() else None
    except (OSError, ValueError, AttributeError):  # closed, replaced, or none at all
        return None
