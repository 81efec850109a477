"""Passwords of cameras: a configuration names where one stands and never holds it.

In a camera's address `${DOOR_PASSWORD}` stands for an environment variable, `${file:/etc/spotcal/door}` for the first
line of a file. Both are percent-encoded when they are put in, so that a password may hold any character.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

from network_calib.errors import InputError

ADVICE = "write ${NAME} there, an environment variable, or ${file:/path/of/its/file}"
_REFERENCE = re.compile(r"\$\{(?:file:(?P<file>[^}]+)|(?P<name>[A-Za-z_][A-Za-z0-9_]*))\}")
# What stands between `user:` and the last @, unless it is a port; and the value of a key such as `password=`.
_IN_AUTHORITY = re.compile(r"://[^:/?#@\s]*:(?!\d{1,5}[/?#])(?P<secret>\S*)@")
_IN_VALUE = re.compile(r"(?i)(?:password|passwd|passwort|pass|pwd|psw|token|secret|auth)=(?P<secret>[^&\s]*)")


def refuse_plain(source: str) -> str:
    """The source text, when no password stands in it.

    Raises:
        ValueError: one does; the message does not repeat it.
    """
    for pattern in (_IN_AUTHORITY, _IN_VALUE):
        match = pattern.search(source)
        if match is not None and match["secret"] and _REFERENCE.fullmatch(match["secret"]) is None:
            raise ValueError(f"a password stands in it; {ADVICE}")
    return source


def with_passwords(source: str, environment: Mapping[str, str] | None = None) -> str:
    """The source text with its references replaced, to be opened and not to be shown.

    Args:
        source: as in the configuration.
        environment: of this process by default.

    Raises:
        InputError: a variable that is not set, or a file that cannot be read or is empty.
    """
    known = os.environ if environment is None else environment
    return _REFERENCE.sub(lambda match: quote(_value(match, known), safe=""), source)


def _value(match: re.Match[str], known: Mapping[str, str]) -> str:
    if match["name"] is not None:
        if match["name"] not in known:
            raise InputError(
                f"the environment has no {match['name']}, which a camera's source asks for",
                advice="Set it where this node is started, for a service in its EnvironmentFile.",
            )
        return known[match["name"]]
    path = Path(match["file"])
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise InputError(f"{path}, which a camera's source asks for, cannot be read: {reason}") from None
    if not lines or not lines[0].strip():
        raise InputError(f"{path}, which a camera's source asks for, is empty")
    return lines[0].strip()
