"""Passwords in camera addresses: what may be shown, and what of a foreign text must not."""

from __future__ import annotations

import re
from urllib.parse import SplitResult, urlsplit, urlunsplit

from network_calib.errors import InputError

HIDDEN = "***"
# Everything before the last @ of a run without spaces: a password may hold @ and / itself, and rather too much is
# hidden than a part of it shown.
_CREDENTIALS = re.compile(r"(?<=://)\S*@")
# Cheap cameras take the password in the path: rtsp://host/user=admin&password=secret&channel=1.
_SECRET_VALUE = re.compile(r"(?i)((?:password|passwd|passwort|pass|pwd|psw|token|secret|auth)=)[^&\s'\"/;,]*")


def redact(text: str) -> str:
    """The text without user names, passwords and tokens of the addresses in it."""
    return _SECRET_VALUE.sub(rf"\1{HIDDEN}", _CREDENTIALS.sub(f"{HIDDEN}@", text))


def shown_address(address: str) -> str:
    """A camera's address as it may be shown: without user name and password.

    Raises:
        InputError: the address has no host, or a character that must be percent-encoded in a password.
    """
    parts = _split(address)
    host = f"[{parts.hostname}]" if ":" in (parts.hostname or "") else parts.hostname
    authority = f"{host}:{parts.port}" if parts.port is not None else f"{host}"
    return redact(urlunsplit((parts.scheme, authority, parts.path, parts.query, "")))


def _split(address: str) -> SplitResult:
    try:
        parts = urlsplit(address)
        if parts.hostname and parts.port != 0 and not re.search(r"\s", address):
            return parts
    except ValueError:
        pass  # a port that is no number, or brackets that do not match: said below
    raise InputError(
        f"{redact(address)} is no camera address; expected rtsp://user:password@host:554/path",
        advice="In a password write @ as %40, / as %2F, : as %3A, # as %23, ? as %3F and % as %25.",
    )
