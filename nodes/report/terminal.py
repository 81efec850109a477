"""Consoles of the command line: notes and errors go to standard error, results to standard output."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console
from rich.text import Text


def stderr_console(*, quiet: bool = False) -> Console:
    """For what is not the result."""
    return Console(stderr=True, quiet=quiet, highlight=False)


def print_notes(console: Console, notes: Iterable[str]) -> None:
    """One line each, as it is."""
    for note in notes:
        console.print(f"note: {note}", markup=False, soft_wrap=True)


def print_error(message: str, advice: str) -> None:
    """What went wrong, and what to do next."""
    text = Text.assemble(("error: ", "bold red"), message)
    if advice:
        text.append(f"\n{advice}", style="bold")
    stderr_console().print(text, soft_wrap=True)
