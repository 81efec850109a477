"""How each kind of message travels. Nothing is ever published with BLOCK: one stuck subscriber would stop all others.

What DROP loses, the journal gives back. `express` stops batching and a third of the throughput is left: only for what
a person waits for.
"""

from __future__ import annotations

from dataclasses import dataclass

import zenoh

CONGESTION = zenoh.CongestionControl.DROP


@dataclass(frozen=True, slots=True)
class Qos:
    """Of one kind of message."""

    priority: zenoh.Priority
    express: bool = False


OBSERVATION = Qos(zenoh.Priority.DATA_HIGH)
STATUS = Qos(zenoh.Priority.DATA)
COMMAND = Qos(zenoh.Priority.INTERACTIVE_HIGH, express=True)
STATE = Qos(zenoh.Priority.INTERACTIVE_LOW, express=True)
REPLAY = Qos(zenoh.Priority.DATA_LOW)
RESULT = Qos(zenoh.Priority.DATA_LOW)
PROJECTION = Qos(zenoh.Priority.INTERACTIVE_LOW)


def encoding_of(message_type: type) -> zenoh.Encoding:
    """What a message's payload is, by the name of its type."""
    return zenoh.Encoding.APPLICATION_PROTOBUF.with_schema(f"spotcal.v1.{message_type.__name__}")
