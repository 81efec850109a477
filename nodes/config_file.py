"""A TOML file as one of the project's configurations: checked whole, with all its faults told at once."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from network_calib.errors import InputError
from network_calib.formats.recording import read_text
from nodes.config_faults import fault
from nodes.devices.redaction import redact

Config = TypeVar("Config", bound=BaseModel)
_MAX_BYTES = 16 * 2**20


def read_config(path: Path, model: type[Config]) -> Config:
    """Read a configuration.

    Raises:
        InputError: no TOML, or lists every fault with its path, for example `cameras[2].lens`; shows no password.
    """
    return config_of_text(read_text(path, limit_bytes=_MAX_BYTES), model, name=str(path))


def config_of_text(text: str, model: type[Config], *, name: str) -> Config:
    """A configuration from its text; `name` says in messages where it stands. The same faults as of `read_config`."""
    try:
        document = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{name} is not valid TOML: {error}") from None
    try:
        return model.model_validate(document)
    except ValidationError as error:
        faults = [redact(fault(detail, model, Path(name).name)) for detail in error.errors(include_url=False)]
        noun = "fault" if len(faults) == 1 else "faults"
        raise InputError("\n  ".join([f"{name} holds {len(faults)} {noun}:", *faults])) from None
