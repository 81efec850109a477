"""`spotcal projection` as a stream: 1,081 beams at 40 Hz into 5 and into 1,000 cameras, every camera subscribed to.

Router, service, LRF node and tracker have a process each. The latency is from the scan's `put` to the arrival of its
pixels in the last camera that sees it; the raw bus is the same scan's way to the same tracker.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.measure import SPOTCAL, timed
from benchmarks.projection_site import FAST_STEPS, RATE_HZ, TILT_RAD, Site, large_site, small_site
from benchmarks.projection_stream_parts import KEYS, Received, publish, receive
from benchmarks.report import Row, Run, at_least, at_most
from network_calib.formats.calibration_json import save
from nodes.devices.errors import DeviceError
from nodes.projection.projectors import Projectors
from nodes.projection.scan_projector import ScanProjector, Sweep
from nodes.simulation.lrf_simulation import LRF_NAME

REACH_MS = 5.0
START_S = 60.0
N_CAMERAS = 1000
ROOMS = (8, 5)
TURN_RAD_S = 0.5
# The diagonal of a room: no camera sees farther within its own.
ROOM_REACH_M = 8.4


@dataclass(frozen=True, slots=True)
class Streamed:
    """What came, and the share of one processor that the service took."""

    received: Received
    cpu_share: float


def measure(run: Run) -> Iterator[Row]:
    """Latency for a room, rate for a site, and what the projecting itself costs."""
    n_scans = run.pick(1200, 120)
    yield from _latency(_streamed(small_site(20), n_scans))
    site = large_site(N_CAMERAS, ROOMS, 20)
    n_scans = run.pick(800, 120)
    limit = "--max-distance", f"{ROOM_REACH_M:g}"
    yield from _rate(_streamed(site, n_scans, *limit), f", each to {ROOM_REACH_M:g} m")
    yield from _rate(_streamed(site, n_scans), ", through all walls")
    yield from _costs(site, f"{N_CAMERAS} cameras in {ROOMS[0] * ROOMS[1]} rooms", run.pick(40, 5))
    yield from _costs(large_site(N_CAMERAS, (1, 1), 20), f"{N_CAMERAS} cameras in one room", run.pick(10, 2))


def _latency(streamed: Streamed) -> Iterator[Row]:
    came = streamed.received
    bus, pixels = (np.nanpercentile(column, [50, 99]) / 1e3 for column in (came.scan_us, came.pixels_us))
    note = f"pixels p50 {pixels[0]:.2f} ms, p99 {pixels[1]:.2f} ms; raw bus p50 {bus[0]:.2f} ms, p99 {bus[1]:.2f} ms"
    what = f"5 cameras, scan published → pixels in all, {len(came.scan_us)} scans"
    yield at_most(f"{what}: p99 beyond the raw bus", float(pixels[1] - bus[1]), REACH_MS, unit=" ms", note=note)
    yield Row(f"{what}: p50 beyond the raw bus", f"{pixels[0] - bus[0]:.2f} ms")


def _rate(streamed: Streamed, how: str) -> Iterator[Row]:
    came = streamed.received
    n_scans, n_came = len(came.pixels_us), int(np.isfinite(came.pixels_us).sum())
    note = (
        f"{came.n_messages / max(n_came, 1):.0f} cameras see a scan, {came.n_dropped} scans dropped, "
        f"{came.n_bytes * RATE_HZ / n_scans / 2**20:.1f} MiB/s, service takes {streamed.cpu_share:.0%} of one core"
    )
    what = f"{N_CAMERAS} cameras in {ROOMS[0] * ROOMS[1]} rooms{how}, 1,081 beams at {RATE_HZ:g} Hz"
    yield at_least(f"{what}: scans that came as pixels", n_came / n_scans, 0.999, note=note)
    p50, p99 = np.nanpercentile(came.pixels_us, [50, 99]) / 1e3
    yield Row(f"{what}: scan published → pixels in all", f"p50 {p50:.1f} ms, p99 {p99:.1f} ms")


def _costs(site: Site, what: str, repeats: int) -> Iterator[Row]:
    """Of one scan in one thread, without the bus, at rest and while the unit turns."""
    projector = ScanProjector(Projectors(site.calibration), LRF_NAME, longest_m=FAST_STEPS.range_max_m)
    bearing_rad = FAST_STEPS.bearings_rad
    range_m = np.where(FAST_STEPS.is_range(site.readings_mm[0]), 1e-3 * site.readings_mm[0], np.nan)
    still, sigma_rad = np.full(len(bearing_rad), TILT_RAD), np.full(len(bearing_rad), 1e-3)
    turning = TILT_RAD + TURN_RAD_S * FAST_STEPS.beam_time_s(bearing_rad)
    for word, tilt_rad in (("at rest", still), ("turning", turning)):
        sweep = Sweep(range_m, bearing_rad, tilt_rad, sigma_rad)
        n_seeing = sum(len(seen.camera) for seen in projector.project(sweep, FAST_STEPS))
        best_s = min(timed(lambda sweep=sweep: list(projector.project(sweep, FAST_STEPS)), repeats=repeats).all_s)
        yield Row(
            f"{what}, {word}: a scan with σ, one thread, no bus",
            f"{1e3 * best_s:.1f} ms, {n_seeing} cameras see it: {1 / best_s:.0f} scans/s",
        )


def _streamed(site: Site, n_scans: int, *options: str) -> Streamed:
    spawn = multiprocessing.get_context("spawn")
    endpoint = _free_endpoint()
    ready, stop = spawn.Event(), spawn.Event()
    take, send = spawn.Pipe(duplex=False)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "calibration.json"
        save(site.calibration, path)
        _started(stack, "router", "--listen", endpoint)
        where = "--calibration", str(path), "--site", KEYS.site, "--router", endpoint
        service = _started(stack, "projection", *where, *options)
        tracker = spawn.Process(target=receive, args=(endpoint, n_scans, ready, stop, send), daemon=True)
        tracker.start()
        stack.callback(tracker.join, START_S)
        stack.callback(stop.set)
        if not ready.wait(START_S):
            raise DeviceError("the tracker did not start")
        lrf = spawn.Process(target=publish, args=(endpoint, site.readings_mm, n_scans), daemon=True)
        begin_s, before_s = time.monotonic(), _cpu_s(service)
        lrf.start()
        lrf.join(n_scans / RATE_HZ + START_S)
        cpu_share = (_cpu_s(service) - before_s) / (time.monotonic() - begin_s)
        stop.set()
        if not take.poll(START_S):
            raise DeviceError("the tracker told nothing")
        return Streamed(take.recv(), cpu_share)


def _started(stack: ExitStack, *arguments: str) -> int:
    """A program that has said its first line; its process."""
    program = stack.enter_context(subprocess.Popen((*SPOTCAL, *arguments), stdout=subprocess.PIPE, text=True))
    stack.callback(program.terminate)
    assert program.stdout is not None
    if not program.stdout.readline():
        raise DeviceError(f"spotcal {arguments[0]} did not start")
    return program.pid


def _cpu_s(process: int) -> float:
    """What a process has taken of the processors so far."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _free_endpoint() -> str:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{held.getsockname()[1]}"
