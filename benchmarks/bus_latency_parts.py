"""The processes of `bus_latency`: one that publishes, as nodes or bare, and one that notes when things arrive."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path

import zenoh

from nodes.bus import qos
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind, Role
from nodes.bus.node import BusNode
from nodes.bus.session import BusOptions, open_bus
from nodes.journal import Journal, Sync

KEYS = Keys("bench")
# Three frames of one camera with four candidates: what a camera at 60 Hz sends each 50 ms.
N_FRAMES, N_SPOTS = 3, 4
# Stands where a bare message carries its stamp, to be found in the serialised bytes.
MARK = struct.pack("<q", 0x1122334455667788)
WARM_S = 1.0


def batch() -> pb.SpotBatch:
    """The message that all send."""
    columns = [float(i) + 0.5 for i in range(N_SPOTS)]
    return pb.SpotBatch(
        camera="C0",
        width_px=1920,
        height_px=1080,
        rate_hz=60.0,
        origin=pb.STAMP_ORIGIN_CAMERA,
        frame_sequence=range(N_FRAMES),
        frame_stamp_ns=[time.time_ns()] * N_FRAMES,
        spot_frame=[0, 1, 2, 2],
        x_px=columns,
        y_px=columns,
        sigma_px=columns,
        score=[0.5] * N_SPOTS,
    )


def subscribe(endpoint: str, ready: Event, stop: Event, out: Connection) -> None:
    """Send, at the end, arrival minus stamp of all observations, in ns, in order of arrival."""
    arrived: list[tuple[int, bytes]] = []

    def take(sample: zenoh.Sample) -> None:
        arrived.append((time.time_ns(), sample.payload.to_bytes()))

    with open_bus(BusOptions(KEYS.site, (endpoint,))) as session:
        session.declare_subscriber(KEYS.all_observations, take)
        ready.set()
        stop.wait()
        time.sleep(0.5)
    out.send([at_ns - pb.SpotBatch.FromString(payload).header.stamp_ns for at_ns, payload in arrived])


def publish_bare(endpoint: str, n_nodes: int, rate_hz: float, seconds: float) -> None:
    """The same payload, each "node" with a session and a publisher, and nothing else."""
    message = batch()
    message.header.CopyFrom(pb.Header(schema=1, node="n00", boot=bytes(16), sequence=1000))
    message.header.stamp_ns = struct.unpack("<q", MARK)[0]
    before, after = message.SerializeToString().split(MARK)
    with ExitStack() as stack:
        publishers: list[zenoh.Publisher] = []
        for i in range(n_nodes):
            session = stack.enter_context(open_bus(BusOptions(KEYS.site, (endpoint,))))
            publishers.append(
                session.declare_publisher(
                    KEYS.observation(f"n{i:02}", Kind.SPOTS),
                    encoding=qos.encoding_of(pb.SpotBatch),
                    congestion_control=qos.CONGESTION,
                    priority=qos.OBSERVATION.priority,
                )
            )
        time.sleep(WARM_S)

        def send(i: int) -> None:
            publishers[i].put(before + struct.pack("<q", time.time_ns()) + after)

        _in_turn(send, n_nodes, rate_hz, seconds)


def publish_as_nodes(endpoint: str, n_nodes: int, rate_hz: float, seconds: float, folder: str, sync: str) -> None:
    """Real nodes with journals, status and all."""
    with ExitStack() as stack:
        nodes: list[BusNode] = []
        for i in range(n_nodes):
            journal = stack.enter_context(Journal(Path(folder) / f"n{i:02}.journal", sync=Sync(sync)))
            options = BusOptions(KEYS.site, (endpoint,))
            nodes.append(stack.enter_context(BusNode(f"n{i:02}", Role.CAMERA, options, journal)))
            nodes[-1].beat()
        time.sleep(WARM_S)
        message = batch()

        def send(i: int) -> None:
            nodes[i].observe(Kind.SPOTS, message, stamp_ns=time.time_ns())

        _in_turn(send, n_nodes, rate_hz, seconds)


def _in_turn(send: Callable[[int], None], n_nodes: int, rate_hz: float, seconds: float) -> None:
    """Every node at its rate, evenly one after the other."""
    begin = time.perf_counter()
    n_messages = round(seconds * rate_hz) * n_nodes
    for k in range(n_messages):
        wait_s = begin + k / (n_nodes * rate_hz) - time.perf_counter()
        if wait_s > 0:
            time.sleep(wait_s)
        send(k % n_nodes)
