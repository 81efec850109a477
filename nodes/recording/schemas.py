"""What a key carries, and the channels of an MCAP file: each with the schema that decodes it."""

from __future__ import annotations

from functools import lru_cache

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from network_calib.errors import InputError
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import TYPES
from nodes.bus.keys import parse_observation, parse_status

# A site has some hundred keys, and each row asks.
address_of = lru_cache(maxsize=8192)(parse_observation)
# Ids of channels have 16 bits. Topics for viewers give way: a camera may call itself anything.
MAX_KEYS, MAX_TOPICS = 60_000, 4_000


def message_type_of(key: str) -> type[Message] | None:
    """The type of what is published under a key; None where nobody says."""
    observation = address_of(key)
    if observation is not None:
        return TYPES[observation.kind]
    if parse_status(key) is not None:
        return pb.NodeStatus
    match key.split("/"):
        case ["spotcal", "@v1", _, "session", "state"]:
            return pb.SessionState
        case ["spotcal", "@v1", _, "result", "calibration"]:
            return pb.Calibration
        case ["spotcal", "@v1", _, "proj", _]:
            return pb.Projection
    return None


class Channels:
    """Channels and schemas of one file, registered when first needed.

    Args:
        writer: of the file, started.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._keys: dict[str, int] = {}
        self._topics: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def of_key(self, key: str) -> int:
        """The channel of a key of the bus.

        Raises:
            InputError: more keys than an MCAP file can hold.
        """
        channel = self._keys.get(key)
        if channel is None:
            if len(self._keys) >= MAX_KEYS:
                raise InputError(f"{key}: the recording holds {MAX_KEYS} keys already, and can hold no more")
            channel = self._keys[key] = self._registered(key, message_type_of(key))
        return channel

    def of_topic(self, topic: str, message_type: type[Message]) -> int | None:
        """The channel of a topic for viewers; None: there are too many."""
        channel = self._topics.get(topic)
        if channel is None and len(self._topics) < MAX_TOPICS:
            channel = self._topics[topic] = self._registered(topic, message_type)
        return channel

    def _registered(self, topic: str, message_type: type[Message] | None) -> int:
        encoding = "" if message_type is None else MessageEncoding.Protobuf
        return self._writer.register_channel(topic, encoding, self._schema(message_type))

    def _schema(self, message_type: type[Message] | None) -> int:
        if message_type is None:
            return 0
        name = message_type.DESCRIPTOR.full_name
        if name not in self._schemas:
            self._schemas[name] = register_schema(self._writer, message_type)
        return self._schemas[name]
