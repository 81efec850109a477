"""A checksum that travels beside an observation, as the attachment of its publication.

One in eight mutated messages still parses, and one whose sequence was hit would take the place of another row. The
seal tells of accidents, not of forgers: who may publish under a node's key is for the router's access control.
"""

from __future__ import annotations

import zlib


def seal(payload: bytes) -> bytes:
    """What is attached to a payload."""
    return zlib.crc32(payload).to_bytes(4, "little")


def is_intact(payload: bytes, attachment: bytes | None) -> bool:
    """Whether a payload is as it was published; true where nothing was attached."""
    return attachment is None or attachment == seal(payload)
