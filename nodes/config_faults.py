"""Faults of a configuration in words: where, what stands there, what was expected, and the nearest known name."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

from nodes.config_model import (
    CameraConfig,
    CentresAnchor,
    DistanceAnchor,
    InstrumentConfig,
    LrfConfig,
    PointsAnchor,
    RoomConfig,
    SigmaConfig,
    StereoAnchor,
)

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


def hint(word: str, known: tuple[str, ...]) -> str:
    """A question after the nearest known name, in parentheses, or nothing when none is near."""
    close = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def fault(detail: ErrorDetails) -> str:
    """One fault as `path: value, what is wrong`, with the nearest known name for a mistyped key."""
    location = list(detail["loc"])
    if location[:1] == ["anchor"] and len(location) > 1:
        del location[1]  # the kind, which pydantic puts there and the user did not write
    path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".") or "room.toml"
    if detail["type"] == "extra_forbidden":
        known = _known_keys(location[:-1])
        return f"{path}: unknown key{hint(str(location[-1]), known)}"
    message = detail["msg"].removeprefix("Value error, ")
    if detail["type"] in ("missing", "value_error"):
        return f"{path}: {message[0].lower()}{message[1:]}"
    return f"{path}: {detail['input']!r:.60}, {message[0].lower()}{message[1:]}"


def _known_keys(location: list[int | str]) -> tuple[str, ...]:
    """The keys that may stand where the fault was found."""
    words = [part for part in location if isinstance(part, str)]
    if words[:1] == ["cameras"]:
        model = SigmaConfig if words[-1] == "sigma" else CameraConfig
        return tuple(model.model_fields)
    if words[:1] == ["lrfs"]:
        return tuple((InstrumentConfig if words[-1] == "sigma" else LrfConfig).model_fields)
    if words[:1] == ["anchor"]:
        models = (StereoAnchor, DistanceAnchor, CentresAnchor, PointsAnchor)
        return tuple({key: None for model in models for key in model.model_fields})
    if words:
        annotation = RoomConfig.model_fields[words[0]].default
        return tuple(type(annotation).model_fields)
    return tuple(RoomConfig.model_fields)
