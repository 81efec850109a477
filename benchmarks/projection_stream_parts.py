"""The processes of `projection_stream`: an LRF node that publishes scans, and a tracker that receives pixels."""

from __future__ import annotations

import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event

import numpy as np
import zenoh

from benchmarks.projection_site import FAST_STEPS, RATE_HZ, TILT_RAD
from network_calib.observations import FloatArray, IntArray
from nodes.bus import qos
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.keys import Keys, Kind
from nodes.bus.session import BusOptions, open_bus
from nodes.simulation.lrf_simulation import LRF_NAME

KEYS = Keys("bench")
NODE = "n-lrf"
WARM_S, TAIL_S = 2.0, 2.0


@dataclass(frozen=True, slots=True)
class Received:
    """What came at the tracker.

    Attributes:
        scan_us: (S,) of each scan, as published, until it came over the bus itself; NaN when it did not.
        pixels_us: (S,) until its pixels had come, in the last camera; NaN when none came.
        n_messages: with pixels.
        n_bytes: of them.
        n_dropped: scans that the stream says it gave up.
    """

    scan_us: FloatArray
    pixels_us: FloatArray
    n_messages: int
    n_bytes: int
    n_dropped: int


def publish(endpoint: str, readings_mm: IntArray, n_scans: int) -> None:
    """Publish scans at RATE_HZ, their number and stamp that of the moment of `put`."""
    columns = [row.tolist() for row in readings_mm]
    with open_bus(BusOptions(KEYS.site, (endpoint,))) as session:
        info, tilt, scans = (_publisher(session, kind) for kind in (Kind.LRF_INFO, Kind.TILT, Kind.LRF_SCAN))
        time.sleep(WARM_S / 2)
        info.put(_info().SerializeToString())
        tilt.put(_tilt().SerializeToString())
        time.sleep(WARM_S / 2)
        begin = time.perf_counter()
        # The first second warms all processes up, and does not count: its numbers are below zero, brought up.
        for k in range(n_scans + int(RATE_HZ)):
            wait_s = begin + k / RATE_HZ - time.perf_counter()
            if wait_s > 0:
                time.sleep(wait_s)
            message = pb.LrfScan(lrf=LRF_NAME, scan=k, readings_mm=columns[k % len(columns)])
            message.header.CopyFrom(_header())
            message.stamp_ns = time.time_ns()
            scans.put(message.SerializeToString())
        time.sleep(TAIL_S)


def receive(endpoint: str, n_scans: int, ready: Event, stop: Event, out: Connection) -> None:
    """Send what came, at the end."""
    raw: list[tuple[int, bytes]] = []
    pixels: list[tuple[int, bytes]] = []
    status: list[bytes] = []

    with open_bus(BusOptions(KEYS.site, (endpoint,))) as session:
        session.declare_subscriber(
            KEYS.observations_of(Kind.LRF_SCAN), lambda sample: raw.append((time.time_ns(), sample.payload.to_bytes()))
        )
        session.declare_subscriber(
            KEYS.projection("C0").replace("C0", "*"),
            # The head of a message holds its number and stamp; a site's pixels would fill the memory.
            lambda sample: pixels.append((time.time_ns(), sample.payload.to_bytes())),
        )
        session.declare_subscriber(KEYS.status("projection"), lambda sample: status.append(sample.payload.to_bytes()))
        ready.set()
        stop.wait()
    out.send(_received(raw, pixels, status, n_scans))


def _received(
    raw: list[tuple[int, bytes]], pixels: list[tuple[int, bytes]], status: list[bytes], n_scans: int
) -> Received:
    first = int(RATE_HZ)
    stamps, scan_us, pixels_us = np.zeros(n_scans), np.full(n_scans, np.nan), np.full(n_scans, np.nan)
    stamps = np.zeros(n_scans, np.int64)
    for at_ns, payload in raw:
        scan = pb.LrfScan.FromString(payload)
        if scan.scan >= first:
            stamps[scan.scan - first] = scan.stamp_ns
            scan_us[scan.scan - first] = (at_ns - scan.stamp_ns) / 1e3
    n_messages = n_bytes = 0
    for at_ns, payload in pixels:
        message = pb.Projection.FromString(payload)
        if message.scan >= first:
            n_messages, n_bytes = n_messages + 1, n_bytes + len(payload)
            pixels_us[message.scan - first] = (at_ns - message.stamp_ns) / 1e3
    n_dropped = pb.NodeStatus.FromString(status[-1]).n_dropped if status else 0
    return Received(scan_us, pixels_us, n_messages, n_bytes, n_dropped)


def _publisher(session: zenoh.Session, kind: Kind) -> zenoh.Publisher:
    return session.declare_publisher(
        KEYS.observation(NODE, kind), congestion_control=qos.CONGESTION, priority=qos.OBSERVATION.priority
    )


def _header() -> pb.Header:
    return pb.Header(schema=1, node=NODE, boot=bytes(16), stamp_ns=time.time_ns())


def _info() -> pb.LrfInfo:
    steps = FAST_STEPS
    return pb.LrfInfo(
        header=_header(),
        lrf=LRF_NAME,
        front_step=steps.front_step,
        steps_per_turn=steps.steps_per_turn,
        first_step=steps.first_step,
        last_step=steps.last_step,
        range_min_m=steps.range_min_m,
        range_max_m=steps.range_max_m,
        turn_s=steps.turn_s,
    )


def _tilt() -> pb.TiltSample:
    return pb.TiltSample(header=_header(), lrf=LRF_NAME, tilt_rad=TILT_RAD, has_steps=True)
