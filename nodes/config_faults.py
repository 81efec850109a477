"""Faults of a configuration in words: where, what stands there, what was expected, and the nearest known name."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import TYPE_CHECKING, get_args

from pydantic import BaseModel

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


def hint(word: str, known: tuple[str, ...]) -> str:
    """A question after the nearest known name, in parentheses, or nothing when none is near."""
    close = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def fault(detail: ErrorDetails, model: type[BaseModel], file: str) -> str:
    """One fault as `path: value, what is wrong`, with the nearest known name for a mistyped key.

    Args:
        detail: as pydantic says it.
        model: of the whole file.
        file: its name, for a fault of the whole.
    """
    location = list(detail["loc"])
    if location[:1] == ["anchor"] and len(location) > 1:
        del location[1]  # the kind, which pydantic puts there and the user did not write
    path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".") or file
    if detail["type"] == "extra_forbidden":
        return f"{path}: unknown key{hint(str(location[-1]), known_keys(model, location[:-1]))}"
    message = detail["msg"].removeprefix("Value error, ")
    if detail["type"] in ("missing", "value_error"):
        return f"{path}: {message[0].lower()}{message[1:]}"
    return f"{path}: {detail['input']!r:.60}, {message[0].lower()}{message[1:]}"


def known_keys(model: type[BaseModel], location: Sequence[int | str]) -> tuple[str, ...]:
    """The keys that may stand at a place of a file of the model."""
    models: list[type[BaseModel]] = [model]
    for key in (part for part in location if isinstance(part, str)):
        fields = [one.model_fields[key] for one in models if key in one.model_fields]
        models = [inner for field in fields for inner in _models(field.annotation)]
    return tuple({key: None for one in models for key in one.model_fields})


def _models(annotation: object) -> list[type[BaseModel]]:
    """The models within a type such as `list[CameraConfig] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]
