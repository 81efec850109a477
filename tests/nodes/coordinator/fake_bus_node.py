"""A node on the bus made of a list and raw Zenoh, that loses, freezes and lies as a test wants."""

import os
import socket
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context

import zenoh

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind
from nodes.bus.seal import seal
from nodes.bus.session import BusOptions, open_bus, open_router

SITE, SESSION = "t", "s1"
KEYS = Keys(SITE)
REPLY_BYTES = 256_000
# Zenoh and threads on a busy machine; nothing here takes more than a fraction of it when all is well.
PATIENCE_S = 30.0


def batch(node, boot, sequence, *, session=SESSION, stamp_ns=None, x_px=100.5):
    """A SpotBatch of one frame, told apart by its frame number."""
    stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
    header = pb.Header(schema=1, node=node, boot=boot, sequence=sequence, stamp_ns=stamp_ns, session=session)
    return pb.SpotBatch(
        header=header,
        camera="C0",
        width_px=640,
        height_px=480,
        rate_hz=30,
        frame_sequence=[sequence],
        frame_stamp_ns=[stamp_ns],
        spot_frame=[0],
        x_px=[x_px],
        y_px=[200.25],
        sigma_px=[0.1],
        score=[0.9],
    )


def parameters_of(query):
    return dict(part.split("=") for part in str(query.parameters).split(";"))


def wait_until(condition):
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.01)
    return True


@dataclass
class FakeNode:
    """Attributes: journal: rows by boot; n_rows_asked: how many rows were ever asked for."""

    zenoh: zenoh.Session
    name: str
    journal: dict = field(default_factory=dict)
    boot: bytes = field(default_factory=lambda: os.urandom(16))
    n_dropped: int = 0
    n_rows_asked: int = 0
    n_summaries_asked: int = 0
    rows_refused: set = field(default_factory=set)
    queryables: list = field(default_factory=list)
    frozen: list = field(default_factory=list)

    @property
    def key(self):
        return KEYS.observation(self.name, Kind.SPOTS)

    def serve(self):
        self.queryables = [
            self.zenoh.declare_queryable(KEYS.replay_rows(self.name), self._rows),
            self.zenoh.declare_queryable(KEYS.replay_summary(self.name), self._summary),
        ]

    def freeze(self):
        """From now on questions are taken and never answered."""
        for queryable in self.queryables:
            queryable.undeclare()
        self.queryables = [
            self.zenoh.declare_queryable(key, self.frozen.append)
            for key in (KEYS.replay_rows(self.name), KEYS.replay_summary(self.name))
        ]

    def thaw(self):
        """Answer again; what was asked meanwhile stays without an answer."""
        for queryable in self.queryables:
            queryable.undeclare()
        for query in self.frozen:
            query.drop()
        self.serve()

    def observe(self, *, is_lost=False):
        rows = self.journal.setdefault(self.boot, {})
        sequence = len(rows)
        rows[sequence] = batch(self.name, self.boot, sequence).SerializeToString()
        if not is_lost:
            self.publish(rows[sequence])

    def publish(self, payload, *, attachment=None):
        self.zenoh.put(
            self.key,
            payload,
            attachment=attachment or seal(payload),
            congestion_control=zenoh.CongestionControl.BLOCK,  # what is lost here is lost on purpose
        )

    def restart(self):
        self.boot = os.urandom(16)

    @property
    def payloads(self):
        return sorted(payload for rows in self.journal.values() for payload in rows.values())

    def _rows(self, query):
        with query:
            asked = parameters_of(query)
            first, last = int(asked["from"]), int(asked["to"])
            self.n_rows_asked += last - first + 1
            rows = self.journal.get(bytes.fromhex(asked["boot"]), {})
            reply = pb.JournalRows()
            for sequence in range(first, min(last, len(rows) - 1) + 1):
                if sequence >= self.n_dropped and sequence not in self.rows_refused:
                    reply.rows.add(key=self.key, payload=rows[sequence])
                if reply.ByteSize() > REPLY_BYTES // 8:
                    query.reply(KEYS.replay_rows(self.name), reply.SerializeToString())
                    reply = pb.JournalRows()
            if reply.rows:
                query.reply(KEYS.replay_rows(self.name), reply.SerializeToString())

    def _summary(self, query):
        with query:
            self.n_summaries_asked += 1
            summary = pb.JournalSummary(header=batch(self.name, self.boot, 0).header)
            if parameters_of(query)["session"] == SESSION:
                for boot, rows in self.journal.items():
                    summary.spans.add(boot=boot, first=self.n_dropped, last=len(rows) - 1, n_dropped=self.n_dropped)
            query.reply(KEYS.replay_summary(self.name), summary.SerializeToString())


@dataclass
class Bus:
    """A router of its own, and sessions at it that end with the test."""

    endpoints: tuple
    stack: ExitStack

    def session(self):
        return self.stack.enter_context(open_bus(BusOptions(SITE, self.endpoints)))

    def node(self, name, *, is_serving=True):
        node = FakeNode(self.session(), name)
        if is_serving:
            node.serve()
        return node


def route(endpoints, pipe):
    with open_router(endpoints):
        pipe.send("ready")
        pipe.recv()


@contextmanager
def router_process():
    """The endpoints of a router in a process of its own.

    All sessions of a process share Zenoh's few receiving threads: a router that waits for room on the way to a
    subscriber of the same process would keep it from reading.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoints = (f"tcp/127.0.0.1:{probe.getsockname()[1]}",)
    context = get_context("spawn")
    pipe, its_pipe = context.Pipe()
    process = context.Process(target=route, args=(endpoints, its_pipe))
    process.start()
    its_pipe.close()
    try:
        assert pipe.poll(PATIENCE_S)
        pipe.recv()
        yield endpoints
        pipe.send("end")
        process.join(PATIENCE_S)
    finally:
        process.kill()
        process.join()
        pipe.close()


@contextmanager
def bus_at(endpoints):
    with ExitStack() as stack:
        yield Bus(endpoints, stack)
