"""The scanner's driver on a real pty, in real time, through a bad cable: `python -m benchmarks.lrf_pty_hour`.

The emulated URG-04LX runs in a process of its own behind the emulator server. Every scan carries the instant of its
step 0 in its first beams and numbers drawn from that instant in all others, so that whoever reads it can tell a right
scan from a wrong one, and knows the error of its stamp.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from benchmarks.report import Row, at_most, markdown_table
from network_calib.observations import IntArray
from nodes.devices import scip
from nodes.devices.errors import DeviceError, LineLostError
from nodes.devices.transport import Transport, open_transport
from nodes.simulated.emulator_server import EmulatorServer
from nodes.simulated.line_faults import LineFaults
from nodes.simulated.scip_device import FIRST_RANGE_MM, ScipDevice
from nodes.simulated.scip_model import URG_04LX

FLIPS_PER_BYTE, N_UNPLUGS, UNPLUGGED_S, APART_S = 1e-4, 10, 2.0, 20.0
N_BEAMS, N_TIME_BEAMS, TIME_BASE = URG_04LX.steps.n_measured, 4, 4000
TURN_S = URG_04LX.steps.turn_s
READ_S, REOPEN_S, TELL_S = 0.2, 0.25, 60.0


@dataclass(slots=True)
class PtyTally:
    """What came over the line until now.

    Attributes:
        duration_s: since the first scan was asked for.
        n_good: scans that were read and are what the scanner measured.
        n_wrong: scans that were read and are not.
        n_sent: turns of the scanner from the first scan that was read to the last, lost lines included.
        n_missed: turns that the driver counted as missed.
        n_refused: replies that the driver refused.
        n_unplugs: lines that were lost.
        stamp_rms_s: error of the stamps.
        stamp_worst_s: the greatest.
        processor: share of one core that the driver's process took.
        rss_mb: its memory now.
        rss_early_mb: its memory in its first minute.
    """

    duration_s: float = 0.0
    n_good: int = 0
    n_wrong: int = 0
    n_sent: int = 0
    n_missed: int = 0
    n_refused: int = 0
    n_unplugs: int = 0
    stamp_rms_s: float = 0.0
    stamp_worst_s: float = 0.0
    processor: float = 0.0
    rss_mb: float = 0.0
    rss_early_mb: float = 0.0

    @property
    def n_uncounted(self) -> int:
        """Turns that are neither read nor counted as missed, or counted though they were not sent."""
        return abs(self.n_sent - self.n_good - self.n_wrong - self.n_missed)

    def rows(self) -> Iterator[Row]:
        """For the table."""
        where = f"real pty, {self.duration_s:.0f} s"
        yield at_most(f"{where}: wrong ranges accepted", float(self.n_wrong), 0.0)
        yield Row(
            f"{where}: scans good, counted missed, replies refused",
            f"{self.n_good}, {self.n_missed}, {self.n_refused}; {self.n_unplugs} unplugs, {self.n_sent} turns",
        )
        # Where the line was lost, turns are counted by the host's clock, and the scanner begins its turns anew.
        yield at_most(
            f"{where}: scans uncounted", float(self.n_uncounted), float(max(self.n_unplugs, 1)), note="one an unplug"
        )
        yield Row(f"{where}: stamps", f"RMS {1e3 * self.stamp_rms_s:.2f} ms, worst {1e3 * self.stamp_worst_s:.2f} ms")
        yield at_most(f"{where}: processor of the driver's process", self.processor, 0.05, note="of one core")
        growth_mb = self.rss_mb - self.rss_early_mb
        yield at_most(f"{where}: memory gained", growth_mb, 5.0, unit=" MB", note=f"{self.rss_mb:.0f} MB at the end")


def run_on_pty(duration_s: float, *, tell_each_s: float | None = None) -> PtyTally:
    """Read scans for so long, wait for the line to come back whenever it is lost.

    Args:
        duration_s: real time.
        tell_each_s: print how it stands so often.
    """
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        here, there = context.Pipe()
        link = Path(folder) / "scanner"
        server = context.Process(target=_serve, args=(link, duration_s, there), daemon=True)
        server.start()
        try:
            return _Reader(str(link), emulator_begin_s=here.recv()).run(duration_s, tell_each_s)
        finally:
            here.close()
            server.join(10.0)
            server.terminate()


def readings_of(begin_s: float) -> IntArray:
    """(B,) what the emulated scanner measures in the turn that begins at an emulator's time."""
    time_us = round(1e6 * begin_s)
    digits = time_us // TIME_BASE ** np.arange(N_TIME_BEAMS) % TIME_BASE
    drawn = np.random.default_rng(time_us).integers(0, TIME_BASE, N_BEAMS - N_TIME_BEAMS)
    return FIRST_RANGE_MM + np.concatenate([digits, drawn])


def begin_s_of(readings_mm: IntArray) -> float:
    """The time that readings tell to be of."""
    digits = readings_mm[:N_TIME_BEAMS] - FIRST_RANGE_MM
    return 1e-6 * float(digits @ TIME_BASE ** np.arange(N_TIME_BEAMS))


def _serve(link: Path, duration_s: float, parent: Connection) -> None:
    n_unplugs = min(N_UNPLUGS, int(duration_s / APART_S))
    unplugs = [(duration_s * (k + 0.5) / n_unplugs, UNPLUGGED_S) for k in range(n_unplugs)]
    faults = LineFaults(np.random.default_rng(0), flips_per_byte=FLIPS_PER_BYTE, unplugs=unplugs)
    server, parent_id = EmulatorServer(), os.getppid()
    server.add_pty(ScipDevice(readings_of), link, faults=faults)
    with server:
        parent.send(time.monotonic() - server.now_s)
        while os.getppid() == parent_id and server.error is None:
            try:
                if parent.poll(1.0):
                    parent.recv()
            except EOFError:
                return


class _Reader:
    """Reads and judges."""

    def __init__(self, address: str, *, emulator_begin_s: float) -> None:
        self._address, self._emulator_begin_s = address, emulator_begin_s
        self._tally = PtyTally()
        self._first_s: float | None = None
        self._square_s2 = 0.0

    def run(self, duration_s: float, tell_each_s: float | None) -> PtyTally:
        """See `run_on_pty`."""
        begin_s, begin_processor_s = time.monotonic(), time.process_time()
        line = self._open()
        scanner = scip.Scip(line)
        try:
            scanner.start()
        except DeviceError:
            line.close()
            line = self._reopen(scanner)
        tally, told_s = self._tally, begin_s
        while (now_s := time.monotonic()) < begin_s + duration_s:
            try:
                for scan in scanner.read(READ_S):
                    self._judge(scan)
            except LineLostError:
                tally.n_unplugs += 1
                line.close()
                line = self._reopen(scanner)
            tally.duration_s = now_s - begin_s
            tally.processor = (time.process_time() - begin_processor_s) / max(tally.duration_s, 1.0)
            tally.n_missed, tally.n_refused = scanner.counts.missed, scanner.counts.refused
            tally.rss_mb = _rss_mb()
            if tally.duration_s < min(60.0, duration_s / 4):
                tally.rss_early_mb = max(tally.rss_early_mb, tally.rss_mb)
            if tell_each_s is not None and now_s > told_s + tell_each_s:
                told_s = now_s
                print(self._line(), flush=True)
        scanner.stop()
        line.close()
        return tally

    def _judge(self, scan: scip.Scan) -> None:
        tally, turn_s = self._tally, begin_s_of(scan.readings_mm)
        if not np.array_equal(scan.readings_mm, readings_of(turn_s)):
            tally.n_wrong += 1
            return
        tally.n_good += 1
        if self._first_s is None:
            self._first_s = turn_s
        tally.n_sent = round((turn_s - self._first_s) / TURN_S) + 1
        error_s = scan.stamp_s - self._emulator_begin_s - turn_s
        self._square_s2 += error_s**2
        tally.stamp_rms_s = (self._square_s2 / tally.n_good) ** 0.5
        tally.stamp_worst_s = max(tally.stamp_worst_s, abs(error_s))

    def _open(self) -> Transport:
        return open_transport(self._address, baud=scip.BAUD)

    def _reopen(self, scanner: scip.Scip) -> Transport:
        while True:
            time.sleep(REOPEN_S)
            line = None
            try:
                line = self._open()
                scanner.resume(line)
                return line
            except DeviceError:
                if line is not None:
                    line.close()

    def _line(self) -> str:
        tally = self._tally
        return (
            f"{tally.duration_s:6.0f} s: good {tally.n_good}, missed {tally.n_missed}, uncounted {tally.n_uncounted}, "
            f"wrong {tally.n_wrong}, refused {tally.n_refused}, unplugs {tally.n_unplugs}, "
            f"stamp RMS {1e3 * tally.stamp_rms_s:.2f} ms, worst {1e3 * tally.stamp_worst_s:.2f} ms, "
            f"processor {100 * tally.processor:.2f} %, memory {tally.rss_mb:.1f} MB"
        )


def _rss_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> None:
    """Run as long as told, print how it stands, then the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="how long to read")
    seconds = parser.parse_args().seconds
    print(markdown_table(list(run_on_pty(seconds, tell_each_s=TELL_S).rows())), flush=True)


if __name__ == "__main__":
    main()
