"""One coordinator under load, and under attack: router, ingest, nodes and attacker each in processes of their own.

`python -m benchmarks.bus_load --nodes 100 --rate 30 --frames 1 --seconds 600`: one case, as long as wanted.
"""

from __future__ import annotations

import argparse
import os
import queue
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from benchmarks.report import Row, Run, at_least, at_most, markdown_table
from nodes.bus import qos
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind
from nodes.bus.seal import seal
from nodes.bus.session import BusOptions, open_bus, open_router
from nodes.coordinator.ingest import Ingest
from nodes.coordinator.received import Received
from tests.nodes.coordinator.hostile_messages import Attack, flood

SITE, SESSION = "load", "s1"
KEYS = Keys(SITE)
N_PROCESSES = 4
COMPLETE_S = 120.0
REPLY_ROWS = 500
# Resident memory may grow by this from the middle to the end of a run: an allocator's, not a list's of rows.
FLAT_MB = 8.0
# The queue is full then, with small messages, and the refusals, too.
ATTACKED_MB = 300.0
LATENCY_BINS_S = np.geomspace(1e-5, 1e3, 400)


@dataclass(frozen=True, slots=True)
class Load:
    """What the nodes send.

    Attributes:
        rate_hz: messages a second of each node.
        n_frames: in each message.
        nodes_a_session: that share a session.
    """

    n_nodes: int
    rate_hz: float
    n_frames: int
    seconds: float
    nodes_a_session: int = 1

    @property
    def what(self) -> str:
        return f"{self.n_nodes} nodes x {self.rate_hz:g} messages/s of {self.n_frames} frames, {self.seconds:g} s"


@dataclass(frozen=True, slots=True)
class Tally:
    """What the coordinator's process found.

    Attributes:
        cpu: share of one core while the nodes sent.
        rss_mb: each second.
    """

    n_taken: int
    missing: str
    is_complete: bool
    n_refused: int
    n_doubled: int
    cpu: float
    rss_mb: tuple[float, ...]
    p50_s: float
    p99_s: float


class LoadNode:
    """A camera node without camera and disk: its journal is a list."""

    def __init__(self, session: zenoh.Session, name: str, n_frames: int) -> None:
        self._n_frames, self._name, self._boot = n_frames, name, os.urandom(16)
        self._rows: list[bytes] = []
        self._key = KEYS.observation(name, Kind.SPOTS)
        self._batch = pb.SpotBatch(
            header=pb.Header(schema=1, node=name, boot=self._boot, session=SESSION),
            camera=name, width_px=1920, height_px=1080, rate_hz=30, origin=pb.STAMP_ORIGIN_DRIVER,
            spot_frame=range(n_frames), x_px=[812.25] * n_frames, y_px=[411.5] * n_frames,
            sigma_px=[0.08] * n_frames, score=[0.97] * n_frames,
        )  # fmt: skip
        self._publisher = session.declare_publisher(
            self._key, congestion_control=qos.CONGESTION, priority=qos.OBSERVATION.priority
        )
        session.declare_queryable(KEYS.replay_rows(name), self._answer_rows)
        session.declare_queryable(KEYS.replay_summary(name), self._answer_summary)

    def send(self) -> None:
        batch, k, now_ns = self._batch, len(self._rows), time.time_ns()
        batch.header.sequence, batch.header.stamp_ns = k, now_ns
        batch.frame_sequence[:] = range(k * self._n_frames, (k + 1) * self._n_frames)
        batch.frame_stamp_ns[:] = [now_ns - 33_000_000 * j for j in reversed(range(self._n_frames))]
        payload = batch.SerializeToString()
        self._rows.append(payload)
        self._publisher.put(payload, attachment=seal(payload))

    @property
    def n_rows(self) -> int:
        return len(self._rows)

    def _answer_rows(self, query: zenoh.Query) -> None:
        with query:
            first, last = (int(query.parameters.get(name, "0") or "0") for name in ("from", "to"))
            rows = [pb.JournalRow(key=self._key, payload=row) for row in self._rows[first : last + 1]]
            for k in range(0, len(rows), REPLY_ROWS):
                reply = pb.JournalRows(rows=rows[k : k + REPLY_ROWS])
                query.reply(KEYS.replay_rows(self._name), reply.SerializeToString())

    def _answer_summary(self, query: zenoh.Query) -> None:
        with query:
            summary = pb.JournalSummary(header=self._batch.header)
            summary.header.stamp_ns = time.time_ns()
            if self._rows:
                summary.spans.add(boot=self._boot, first=0, last=len(self._rows) - 1)
            query.reply(KEYS.replay_summary(self._name), summary.SerializeToString())


def route(pipe: Connection, endpoints: tuple[str, ...]) -> None:
    """A router's process."""
    with open_router(endpoints):
        pipe.send("ready")
        pipe.recv()


def send_load(pipe: Connection, endpoints: tuple[str, ...], load: Load, names: tuple[str, ...]) -> None:
    """A process of nodes: begins when told, tells how much it sent, and gives rows back until told to end."""
    with ExitStack() as stack:
        nodes: list[LoadNode] = []
        for k in range(0, len(names), load.nodes_a_session):
            session = stack.enter_context(open_bus(BusOptions(SITE, endpoints)))
            nodes += [LoadNode(session, name, load.n_frames) for name in names[k : k + load.nodes_a_session]]
        pipe.send("ready")
        pipe.recv()
        begin_s = time.monotonic()
        for turn in range(round(load.seconds * load.rate_hz)):
            for k, node in enumerate(nodes):
                if k % max(len(nodes) // 25, 1) == 0:  # spread over the period, but not a sleep for each message
                    time.sleep(max(0.0, begin_s + (turn + k / len(nodes)) / load.rate_hz - time.monotonic()))
                node.send()
        pipe.send(sum(node.n_rows for node in nodes))
        pipe.recv()


def attack(pipe: Connection, endpoints: tuple[str, ...], n: int) -> None:
    """The attacker's process: listens to a node, and makes its messages from the first that it hears."""
    with open_bus(BusOptions(SITE, endpoints)) as session:
        heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        session.declare_subscriber(
            KEYS.observation("n0", Kind.SPOTS), lambda sample: heard.put(sample.payload.to_bytes())
        )
        pipe.send("ready")
        pipe.recv()
        genuine = heard.get(timeout=COMPLETE_S)
    pipe.send(flood(endpoints, SITE, genuine, "n0", n, 5))
    pipe.recv()


class _Sink:
    def __init__(self) -> None:
        self.n = 0
        self.latencies = np.zeros(LATENCY_BINS_S.size + 1, dtype=np.int64)

    def __call__(self, received: Received) -> None:
        self.n += 1
        waited_s = 1e-9 * (time.time_ns() - received.message.header.stamp_ns)
        self.latencies[np.searchsorted(LATENCY_BINS_S, waited_s)] += 1

    def quantile_s(self, share: float) -> float:
        at = int(np.searchsorted(np.cumsum(self.latencies), share * self.latencies.sum()))
        return float(LATENCY_BINS_S[min(at, LATENCY_BINS_S.size - 1)])


def coordinate(pipe: Connection, endpoints: tuple[str, ...], n_to_refuse: int) -> None:
    """The coordinator's process: the ingest and a sink that counts."""
    sink, rss_mb, is_over = _Sink(), [], threading.Event()

    def watch() -> None:
        while not is_over.wait(1.0):
            rss_mb.append(_rss_mb())

    with open_bus(BusOptions(SITE, endpoints)) as session, Ingest(session, KEYS, SESSION, sink) as ingest:
        pipe.send("ready")
        pipe.recv()
        begin_s, cpu_s = time.monotonic(), _cpu_s()
        watcher = threading.Thread(target=watch)
        watcher.start()
        pipe.recv()
        cpu = (_cpu_s() - cpu_s) / (time.monotonic() - begin_s)
        end_s = time.monotonic() + COMPLETE_S
        while ingest.refusals.n < n_to_refuse and time.monotonic() < end_s:
            time.sleep(0.1)
        report = ingest.complete(COMPLETE_S)
        is_over.set()
        watcher.join()
        rss_mb.append(_rss_mb())
        n_doubled = ingest.refusals.by_reason()["header.sequence: doubled"]
        latency = sink.quantile_s(0.5), sink.quantile_s(0.99)
        refused = ingest.refusals.n
        pipe.send(Tally(sink.n, str(report), report.is_complete, refused, n_doubled, cpu, tuple(rss_mb), *latency))
        pipe.recv()


def run_load(load: Load, *, n_hostile: int = 0) -> tuple[int, Tally, int]:
    """Run a case: rows that the nodes wrote, what the coordinator found, hostile messages that must have arrived."""
    with ExitStack() as stack:
        endpoints = (f"tcp/127.0.0.1:{_free_port()}",)
        stack.enter_context(_process(partial(route, endpoints=endpoints)))
        names = tuple(f"n{k}" for k in range(load.n_nodes))
        groups = [names[k::N_PROCESSES] for k in range(N_PROCESSES) if names[k::N_PROCESSES]]
        senders = [
            stack.enter_context(_process(partial(send_load, endpoints=endpoints, load=load, names=group)))
            for group in groups
        ]
        attacker = None
        if n_hostile:
            attacker = stack.enter_context(_process(partial(attack, endpoints=endpoints, n=n_hostile)))
        coordinator = stack.enter_context(
            _process(partial(coordinate, endpoints=endpoints, n_to_refuse=n_hostile - n_hostile // 10_000))
        )
        for pipe in (coordinator, *senders, *([attacker] if attacker else [])):
            pipe.send("go")
        n_sent = sum(pipe.recv() for pipe in senders)
        n_certain = 0
        if attacker is not None:
            attacks = attacker.recv()
            n_certain = attacks.total() - attacks[Attack.HUGE]
        coordinator.send("complete")
        return n_sent, coordinator.recv(), n_certain


def load_rows(load: Load) -> Iterator[Row]:
    """The figures of one load."""
    n_sent, tally, _ = run_load(load)
    what = load.what
    yield at_most(f"{what}: rows lost, of {n_sent}", n_sent - tally.n_taken, 0, note=tally.missing)
    yield at_most(f"{what}: rows doubled", max(tally.n_taken - n_sent, 0), 0)
    yield Row(f"{what}: coordinator's share of one core", f"{tally.cpu:.2f}")
    start, middle, end = (tally.rss_mb[k] for k in (0, len(tally.rss_mb) // 2, -1))
    note = f"start {start:.0f}, middle {middle:.0f}, end {end:.0f} MB"
    yield at_most(f"{what}: memory that came in the second half", end - middle, FLAT_MB, unit=" MB", note=note)
    yield Row(f"{what}: node to sink, p50 and p99", f"{1e3 * tally.p50_s:.2g} ms, {1e3 * tally.p99_s:.2g} ms")


def hostile_rows(n: int) -> Iterator[Row]:
    """The figures of an attack among the observations of ten nodes."""
    load = Load(10, 10, 3, seconds=max(n / 20_000, 5.0))
    n_sent, tally, n_certain = run_load(load, n_hostile=n)
    what = f"{n} hostile messages"
    yield at_least(
        f"{what}: counted, of {n_certain} that must arrive",
        tally.n_refused,
        n_certain,
        note=f"exactly {tally.n_refused}",
    )
    yield at_most(f"{what}: genuine rows lost, of {n_sent}", abs(n_sent - tally.n_taken), 0, note=tally.missing)
    note = f"at the start {tally.rss_mb[0]:.0f} MB"
    yield at_most(f"{what}: memory at most", max(tally.rss_mb), ATTACKED_MB, unit=" MB", note=note)


def measure(run: Run) -> Iterator[Row]:
    """A short time of each load; `python -m benchmarks.bus_load` takes the long ones."""
    seconds = run.pick(20, 5)
    yield from load_rows(Load(100, 30, 1, seconds))
    yield from load_rows(Load(100, 10, 3, seconds))
    yield from load_rows(Load(run.pick(1000, 200), 10, 3, seconds, nodes_a_session=50))
    yield from hostile_rows(run.pick(1_000_000, 20_000))


def main() -> None:
    """One case from the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bus_load", description=__doc__)
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--rate", type=float, default=30.0, help="messages a second of each node")
    parser.add_argument("--frames", type=int, default=1, help="in each message")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--nodes-a-session", type=int, default=1, help="50 for a thousand nodes on one machine")
    parser.add_argument("--hostile", type=int, default=0, help="instead: so many hostile messages")
    given = parser.parse_args()
    load = Load(given.nodes, given.rate, given.frames, given.seconds, given.nodes_a_session)
    print(markdown_table(list(hostile_rows(given.hostile) if given.hostile else load_rows(load))))


@contextmanager
def _process(target: Callable[[Connection], None]) -> Iterator[Connection]:
    """A process that has told it is ready; told to end when left."""
    context: Any = get_context("spawn")
    pipe, its_pipe = context.Pipe()
    process = context.Process(target=target, args=(its_pipe,))
    process.start()
    its_pipe.close()
    try:
        pipe.recv()
        yield pipe
        pipe.send("end")
        process.join(30)
    finally:
        process.kill()
        process.join()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _rss_mb() -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


if __name__ == "__main__":
    main()
