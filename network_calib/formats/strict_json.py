"""Strict reading of JSON: every value is fetched by name and type, and all faults are told at once with their paths."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from network_calib.errors import InputError
from network_calib.formats.recording import read_text

MAX_BYTES = 256 * 2**20
_MAX_FAULTS_SHOWN = 20


def parse_json(path: Path) -> object:
    """The value of a JSON file. Refused: a name given twice in one object, NaN and Infinity, absurd depth or digits.

    Raises:
        InputError: with the line and column where the text ceases to be JSON.
    """
    return parse_json_text(read_text(path, limit_bytes=MAX_BYTES), path)


def parse_json_text(text: str, source: Path | str) -> object:
    """The same of text; `source` stands in the message."""
    try:
        return json.loads(text, object_pairs_hook=_unique_names, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source} is not valid JSON: {error}") from None


@dataclass(frozen=True, slots=True)
class Node:
    """A value with its path, and the list of faults that all nodes of a file share.

    A method that finds a fault notes it and returns a stand-in of the right type, so that reading goes on.
    """

    value: object
    path: str
    faults: list[str] = field(default_factory=list)

    def fail(self, expected: str) -> None:
        """Note that this value is not what was expected."""
        shown = json.dumps(self.value)
        self.faults.append(f"{self.path}: {shown if len(shown) <= 60 else shown[:57] + '...'}, expected {expected}")

    def fields(self, *names: str, optional: tuple[str, ...] = ()) -> dict[str, Node]:
        """The members of an object that has exactly these names, and those of the optional ones that are there."""
        if not isinstance(self.value, dict):
            self.fail("an object")
            return {name: Node(None, f"{self.path}.{name}", []) for name in names}
        names = (*names, *(name for name in optional if name in self.value))
        for name in self.value.keys() - set(names):
            self.faults.append(f"{self.path}.{name}: unknown field")
        out = {}
        for name in names:
            is_there = name in self.value
            if not is_there:
                self.faults.append(f"{self.path}.{name}: missing")
            # What hangs below a missing field is no further fault: it gets a list of its own.
            out[name] = Node(self.value.get(name), f"{self.path}.{name}", self.faults if is_there else [])
        return out

    def items(self, length: int | None = None) -> list[Node]:
        """The members of an array, of the given length if any."""
        if not isinstance(self.value, list) or (length is not None and len(self.value) != length):
            self.fail("an array" if length is None else f"an array of {length}")
            return [] if length is None else [Node(None, f"{self.path}[{k}]", []) for k in range(length)]
        return [Node(value, f"{self.path}[{k}]", self.faults) for k, value in enumerate(self.value)]

    def text(self, *allowed: str) -> str:
        """A string, one of `allowed` if any are given."""
        if not isinstance(self.value, str):
            self.fail("a string")
            return allowed[0] if allowed else ""
        if allowed and self.value not in allowed:
            self.fail("one of " + ", ".join(allowed))
            return allowed[0]
        return self.value

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            self.fail("true or false")
            return False
        return self.value

    def whole(self, minimum: int = 0) -> int:
        """An integer not below the minimum."""
        if not isinstance(self.value, int) or isinstance(self.value, bool) or self.value < minimum:
            self.fail(f"a whole number >= {minimum}")
            return minimum
        return self.value

    def number(self, minimum: float = -math.inf, maximum: float = math.inf) -> float:
        """A finite number within the bounds."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            self.fail("a number")
            return max(minimum, 0.0)
        number = _as_float(self.value)
        if not math.isfinite(number) or not minimum <= number <= maximum:
            self.fail("a finite number" if minimum == -math.inf else f"a finite number in {minimum:g}..{maximum:g}")
            return max(minimum, 0.0)
        return number

    def number_or_nan(self, minimum: float = -math.inf) -> float:
        """A finite number, or null for not a number."""
        return math.nan if self.value is None else self.number(minimum)

    def numbers(self, length: int) -> list[float]:
        """An array of finite numbers."""
        return [item.number() for item in self.items(length)]

    def finish(self, source: Path | str) -> None:
        """Raise what was found.

        Raises:
            InputError: lists the faults.
        """
        if self.faults:
            shown = self.faults[:_MAX_FAULTS_SHOWN]
            rest = len(self.faults) - len(shown)
            more = [f"... and {rest} more"] if rest else []
            raise InputError("\n  ".join([f"{source} holds {len(self.faults)} faults:", *shown, *more]))


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer of more than 308 digits
        return math.inf


def _unique_names(pairs: list[tuple[str, object]]) -> dict[str, object]:
    out = dict(pairs)
    if len(out) != len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the name {next(name for name in names if names.count(name) > 1)!r} is given twice")
    return out


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no JSON number")
