"""A bus for tests: routers on free ports, nodes with journals, and a subscriber that remembers."""

import socket
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind
from nodes.bus.session import BusOptions, open_bus, open_router

SITE = "s1"
KEYS = Keys(SITE)
# Far above what anything here takes, so that only a fault reaches it.
PATIENCE_S = 20.0
EVENTS = KEYS.observation("n1", Kind.EVENT)
STAMP_NS = 1_700_000_000 * 10**9


def free_endpoint():
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{held.getsockname()[1]}"


def wait_until(is_so: Callable[[], bool], what: str):
    end = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < end, f"waited in vain: {what}"
        time.sleep(0.01)


def event(text="hello"):
    return pb.NodeEvent(text=text)


def options_of(endpoint):
    return BusOptions(SITE, (endpoint,))


@contextmanager
def routed():
    """An endpoint with a router in this process."""
    endpoint = free_endpoint()
    with open_router((endpoint,)):
        yield endpoint


class Heard:
    """Samples of a subscription, in order of arrival."""

    def __init__(self):
        self.samples = []
        self._lock = threading.Lock()

    def take(self, sample):
        with self._lock:
            self.samples.append((str(sample.key_expr), sample.payload.to_bytes(), sample.kind))

    def messages(self, message_type):
        return [message_type.FromString(payload) for _, payload, _ in list(self.samples)]

    def sequences(self):
        return [message.header.sequence for message in self.messages(pb.NodeEvent)]


@contextmanager
def listening(endpoint, key=EVENTS):
    """A client that hears a key, and its session."""
    heard = Heard()
    with open_bus(options_of(endpoint)) as session:
        session.declare_subscriber(key, heard.take)
        yield session, heard
