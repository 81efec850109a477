"""From a node's `observe` to a subscriber in another process, over a router process; against a bare Zenoh publisher."""

from __future__ import annotations

import multiprocessing
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.bus_latency_parts import publish_as_nodes, publish_bare, subscribe
from benchmarks.report import Row, Run, at_most
from nodes.devices.errors import DeviceError
from nodes.journal import Sync

RATE_HZ = 20.0
REACH = 2.0
START_S = 30.0


@dataclass(frozen=True, slots=True)
class Latency:
    """Of one way to publish.

    Attributes:
        p50_us: median.
        p99_us: 99th percentile.
        n_lost: messages that never came.
    """

    p50_us: float
    p99_us: float
    n_lost: int

    def __str__(self) -> str:
        return f"p50 {self.p50_us:.0f} µs, p99 {self.p99_us:.0f} µs, {self.n_lost} lost"


def measure(run: Run) -> Iterator[Row]:
    """Latency of few and of many nodes, and what a journal that waits for the disk adds."""
    seconds = float(run.pick(10, 2))
    # Bare and nodes take turns, so that whatever else the machine does meets both.
    n_turns = run.pick(3, 1)
    for n_nodes in (5, run.pick(100, 20)):
        bare, node, synced = _compared(n_nodes, seconds, n_turns)
        what = f"{n_nodes} nodes x {RATE_HZ:g} messages/s"
        note = f"node {node}; bare {bare}"
        yield at_most(f"{what}: observe to subscriber, p50 against bare", node.p50_us / bare.p50_us, REACH, note=note)
        yield at_most(f"{what}: observe to subscriber, p99 against bare", node.p99_us / bare.p99_us, REACH)
        yield Row(f"{what}, journal waits for the disk at each row", str(synced))


def _compared(n_nodes: int, seconds: float, n_turns: int) -> tuple[Latency, Latency, Latency]:
    taken: dict[str, list[np.ndarray]] = {"": [], Sync.EACH_FLUSH: [], Sync.EACH_ROW: []}
    for _ in range(n_turns):
        for way, turns in taken.items():
            turns.append(_latencies_us(n_nodes, seconds, way))
    n_sent = n_turns * round(seconds * RATE_HZ) * n_nodes
    bare, flushed, synced = (_latency(np.concatenate(turns), n_sent) for turns in taken.values())
    return bare, flushed, synced


def _latency(latencies_us: np.ndarray, n_sent: int) -> Latency:
    p50, p99 = np.percentile(latencies_us, [50, 99])
    return Latency(float(p50), float(p99), n_sent - len(latencies_us))


def _latencies_us(n_nodes: int, seconds: float, way: str) -> np.ndarray:
    """One turn, all processes new. `way`: when the journal syncs; empty for bare publishers."""
    spawn = multiprocessing.get_context("spawn")
    endpoint = _free_endpoint()
    ready, stop = spawn.Event(), spawn.Event()
    receive, send = spawn.Pipe(duplex=False)
    command = [sys.executable, "-c", "from nodes.cli import main; main()", "router", "--listen", endpoint]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as router,
        tempfile.TemporaryDirectory() as folder,
    ):
        assert router.stdout is not None
        router.stdout.readline()
        subscriber = spawn.Process(target=subscribe, args=(endpoint, ready, stop, send), daemon=True)
        subscriber.start()
        try:
            if not ready.wait(START_S):
                raise DeviceError("the subscriber did not start")
            arguments = (endpoint, n_nodes, RATE_HZ, seconds)
            publisher = (
                spawn.Process(target=publish_as_nodes, args=(*arguments, folder, way), daemon=True)
                if way
                else spawn.Process(target=publish_bare, args=arguments, daemon=True)
            )
            publisher.start()
            publisher.join(seconds + START_S)
            stop.set()
            if not receive.poll(START_S):
                raise DeviceError("the subscriber told nothing")
            return np.array(receive.recv()) / 1e3
        finally:
            stop.set()
            subscriber.join(START_S)
            router.terminate()


def _free_endpoint() -> str:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{held.getsockname()[1]}"
