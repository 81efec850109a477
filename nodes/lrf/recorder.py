"""Recorders of what an LRF node's devices sent: one that keeps nothing, one that writes lines of JSON, each at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Protocol, TextIO

from network_calib.errors import InputError
from nodes.closing import Closing
from nodes.devices.mti import ImuSample
from nodes.devices.scip import Scan

SCANS, IMU, EVENTS = "scans.jsonl", "imu.jsonl", "events.jsonl"


class Recorder(Protocol):
    """Keeps what the devices sent."""

    def scan(self, scan: Scan) -> None:
        """A scan, as it came."""
        ...

    def imu(self, sample: ImuSample) -> None:
        """A sample, as it came."""
        ...

    def tilt(self, now_s: float, tilt_rad: float, steps: int | None) -> None:
        """The tilt unit arrived."""
        ...

    def event(self, now_s: float, text: str) -> None:
        """Something happened: a phase, a loss, a return."""
        ...


class NullRecorder:
    """Keeps nothing."""

    def scan(self, scan: Scan) -> None:
        """See `Recorder`."""

    def imu(self, sample: ImuSample) -> None:
        """See `Recorder`."""

    def tilt(self, now_s: float, tilt_rad: float, steps: int | None) -> None:
        """See `Recorder`."""

    def event(self, now_s: float, text: str) -> None:
        """See `Recorder`."""


class JsonlRecorder(Closing):
    """Writes `scans.jsonl`, `imu.jsonl` and `events.jsonl` (moves, phases, losses) into a folder.

    A recording that is cut off anywhere is whole up to its last line. Times are seconds on the node's clock.

    Args:
        folder: made when missing; a recording that is there already is never overwritten.

    Raises:
        InputError: the folder holds a recording.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        held = [name for name in (SCANS, IMU, EVENTS) if (folder / name).exists()]
        if held:
            raise InputError(f"{folder} holds {held[0]} already", advice="Name another folder, or move the old one.")
        self._files: dict[str, TextIO] = {
            name: (folder / name).open("x", encoding="utf-8") for name in (SCANS, IMU, EVENTS)
        }

    def scan(self, scan: Scan) -> None:
        """One line, with every reading."""
        intensity = {} if scan.intensity is None else {"intensity": scan.intensity.tolist()}
        times = {"device_s": scan.device_s, "stamp_s": scan.stamp_s, "sigma_s": scan.sigma_s}
        readings = {"arrival_s": scan.arrival_s, "readings_mm": scan.readings_mm.tolist()}
        self._write(SCANS, {"sequence": scan.sequence, **times, **readings, **intensity})

    def imu(self, sample: ImuSample) -> None:
        """One line."""
        times = {"device_s": sample.device_s, "arrival_s": sample.arrival_s}
        rate, force = sample.rate_rad_s.tolist(), sample.acceleration_m_s2.tolist()
        self._write(IMU, {"sequence": sample.sequence, **times, "rate_rad_s": rate, "acceleration_m_s2": force})

    def tilt(self, now_s: float, tilt_rad: float, steps: int | None) -> None:
        """One line among the events."""
        self._write(EVENTS, {"time_s": now_s, "tilt_rad": tilt_rad, "steps": steps})

    def event(self, now_s: float, text: str) -> None:
        """One line."""
        self._write(EVENTS, {"time_s": now_s, "event": text})

    def close(self) -> None:
        """Close the files; further calls do nothing."""
        for file in self._files.values():
            file.close()

    def _write(self, name: str, record: dict[str, object]) -> None:
        file = self._files[name]
        file.write(json.dumps(record, separators=(",", ":")) + "\n")
        file.flush()
