"""A scan asked of the projection service, there and back, against a bare Zenoh query of the same sizes.

Router, service and bare queryable have a process each; the two are asked in turns, so that whatever else the machine
does meets both.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zenoh

from benchmarks.measure import SPOTCAL
from benchmarks.report import Row, Run, at_most
from benchmarks.rooms import random_generator
from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import paper_scene
from lrf_stereo.synthetic_scans import ScannedRoom
from network_calib.observations import FloatArray
from nodes.bus.session import BusOptions, open_bus
from nodes.devices.errors import DeviceError
from nodes.projection.calibration import Calibration
from nodes.projection.client import ProjectionClient
from nodes.projection.points import Beams, CovarianceOf
from nodes.projection.questions import QUERY
from nodes.projection.requests import ProjectAsked
from nodes.projection.wire import encode
from nodes.projection.wire_answers import encode_answer

SITE = "bench"
BARE_KEY = "bare/query"
TILT_RAD = float(np.radians(23.2))
REACH_P50, REACH_P99 = 1.5, 2.0
TIMEOUT_S = 30.0
# Answers with as many bytes as it is told, with nothing in between.
BARE = """
import sys, zenoh
from nodes.bus.session import BusOptions, open_bus
from nodes.site.until_signal import until_signal
with until_signal() as stop, open_bus(BusOptions("bench", (sys.argv[1],))) as session:
    answers = {size: bytes(size) for size in map(int, sys.argv[2:])}
    def answer(query):
        with query:
            query.payload.to_bytes()
            query.reply(query.key_expr, answers[int(str(query.parameters)[2:])])
    session.declare_queryable("bare/query", answer)
    print("answers", flush=True)
    while not stop.wait(0.2):
        pass
"""


@dataclass(frozen=True, slots=True)
class Asked:
    """What is asked, with the sizes of request and answer."""

    what: str
    beams: Beams
    covariance: CovarianceOf | None
    request: bytes
    n_answer_bytes: int


def measure(run: Run) -> Iterator[Row]:
    """Round trips of a scan of 682 beams in 5 cameras, without and with covariance."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        calibration = _simulated(Path(folder))
        endpoint = _free_endpoint()
        asked = [_asked(Calibration.load(calibration), covariance) for covariance in (None, CovarianceOf())]
        service = (*SPOTCAL, "projection", "--calibration", str(calibration), "--site", SITE, "--router", endpoint)
        bare = (sys.executable, "-c", BARE, endpoint, *(str(one.n_answer_bytes) for one in asked))
        stack.enter_context(_running((*SPOTCAL, "router", "--listen", endpoint), n_lines=1))
        stack.enter_context(_running(service, n_lines=2))
        stack.enter_context(_running(bare, n_lines=1))
        client = stack.enter_context(ProjectionClient(SITE, router=[endpoint], timeout_s=TIMEOUT_S))
        session = stack.enter_context(open_bus(BusOptions(SITE, (endpoint,))))
        for one in asked:
            yield from _compared(one, client, session, n=run.pick(3000, 300))


def _compared(asked: Asked, client: ProjectionClient, session: zenoh.Session, *, n: int) -> Iterator[Row]:
    def bare() -> None:
        selector = f"{BARE_KEY}?n={asked.n_answer_bytes}"
        for reply in session.get(selector, payload=asked.request, timeout=TIMEOUT_S, **QUERY):
            assert reply.ok is not None
            reply.ok.payload.to_bytes()

    def ours() -> None:
        client.project(asked.beams, covariance=asked.covariance)

    bare_us, ours_us = _round_trips_us(bare, ours, n)
    percentiles = [np.percentile(times, [50, 99]) for times in (ours_us, bare_us)]
    (p50, p99), (bare_p50, bare_p99) = percentiles
    told = [f"{p50:.0f} µs over {bare_p50:.0f} µs", f"{p99:.0f} µs over {bare_p99:.0f} µs"]
    sizes = f"{len(asked.request) / 1e3:.0f} kB there, {asked.n_answer_bytes / 1e3:.0f} kB back"
    what = f"{asked.what}: there and back, against a bare query"
    if asked.covariance is not None:
        yield Row(what, f"p50 {p50 / bare_p50:.3g} ({told[0]}), p99 {p99 / bare_p99:.3g} ({told[1]}; {sizes})")
        return
    yield at_most(f"{what}, p50", p50 / bare_p50, REACH_P50, note=f"{told[0]}; {sizes}")
    yield at_most(f"{what}, p99", p99 / bare_p99, REACH_P99, note=told[1])


def _round_trips_us(first: Callable[[], None], second: Callable[[], None], n: int) -> tuple[FloatArray, FloatArray]:
    """(n,) times of either, asked in turns; the first few only warm up."""
    times = np.empty((n + n // 10, 2))
    for row in times:
        for k, ask in enumerate((first, second)):
            begin = time.perf_counter()
            ask()
            row[k] = time.perf_counter() - begin
    return 1e6 * times[-n:, 0], 1e6 * times[-n:, 1]


def _simulated(folder: Path) -> Path:
    """The true calibration of a simulated room: five cameras and an LRF."""
    subprocess.run(
        [*SPOTCAL, "simulate", "lrf_room", "--out", str(folder), "--frames", "60"], check=True, capture_output=True
    )
    return folder / "truth.json"


def _asked(calibration: Calibration, covariance: CovarianceOf | None) -> Asked:
    scene = paper_scene(rng=random_generator(5), n_room_cameras=3)
    range_m, _ = ScannedRoom.of(scene, rng=random_generator(6)).true_ranges(TILT_RAD)
    beams = Beams(calibration.lrf_names[0], range_m, ScanSteps().bearings_rad, TILT_RAD)
    answer = calibration.project(beams, covariance=covariance)
    what = f"{len(beams)} beams x {len(answer.cameras)} cameras{'' if covariance is None else ', with covariance'}"
    return Asked(what, beams, covariance, encode(ProjectAsked(beams, None, covariance)), len(encode_answer(answer)))


@contextmanager
def _running(command: Sequence[str], *, n_lines: int) -> Iterator[None]:
    """A process that is ready when it has said so many lines."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            for _ in range(n_lines):
                if not process.stdout.readline():
                    raise DeviceError(f"{' '.join(command)} ended before it was ready")
            yield
        finally:
            process.terminate()


def _free_endpoint() -> str:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{held.getsockname()[1]}"
