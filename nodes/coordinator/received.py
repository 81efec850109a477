"""An observation that was taken."""

from __future__ import annotations

from dataclasses import dataclass

from nodes.bus.checks import Observation
from nodes.bus.keys import Kind


@dataclass(frozen=True, slots=True)
class Received:
    """One row of one node's journal, checked, and not here before.

    Attributes:
        key: that it was published under.
        boot: of the node.
        sequence: within the boot.
        payload: as published, byte by byte.
        message: the payload, parsed.
        arrival_ns: this machine's clock when it came in, live or by replay.
    """

    key: str
    kind: Kind
    node: str
    boot: bytes
    sequence: int
    payload: bytes
    message: Observation
    arrival_ns: int
