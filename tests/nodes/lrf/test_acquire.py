"""Recording and tables of an acquisition, on emulated instruments in virtual time; the command in real time."""

import csv
import json
import os

import numpy as np
import pytest
from rich.console import Console

from network_calib.errors import InputError
from nodes.lrf.acquire import AcquirePlan, _is_enter_pressed, acquire, parse_tilts
from nodes.lrf.acquired_tables import write_acquired
from nodes.lrf.acquisition import AcquisitionOptions
from nodes.lrf.monitor import MonitorAddresses
from nodes.lrf.recorder import JsonlRecorder
from nodes.lrf_node import LrfNode
from tests.nodes.emulated_platform import emulated


def lines(path):
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("acquired")
    platform = emulated()
    options = AcquisitionOptions((float(np.radians(12.1)),), n_crossings=2, sigma_m=np.inf)
    with JsonlRecorder(folder) as recorder:
        node = LrfNode(platform.devices, options, recorder=recorder, clock=platform.clock, sleep=platform.clock.sleep)
        acquired = node.run()
    write_acquired(folder, "L7", acquired)
    return folder, acquired


def test_every_scan_and_sample_is_a_line(recorded):
    folder, acquired = recorded
    scans, samples, events = (lines(folder / f"{name}.jsonl") for name in ("scans", "imu", "events"))
    assert [scan["sequence"] for scan in scans] == list(range(acquired.scan_counts.scans))
    assert len(samples) == acquired.imu_counts.samples
    assert {len(scan["readings_mm"]) for scan in scans} == {682}
    assert [event.get("event") for event in events] == ["moving", None, "resting", "background", "collecting", "done"]
    assert events[1]["steps"] == -235


def test_tables_hold_the_crossings_and_the_tilts(recorded):
    folder, acquired = recorded
    with (folder / "crossings.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found = acquired.settings[0].crossings
    assert len(rows) == len(found) >= 2
    assert {row["lrf"] for row in rows} == {"L7"}
    np.testing.assert_allclose([int(row["stamp_ns"]) / 1e9 for row in rows], found.time_s, atol=1e-9)
    np.testing.assert_array_equal([float(row["range_m"]) for row in rows], found.range_m)
    with (folder / "tilts.csv").open(encoding="utf-8") as file:
        (tilt,) = csv.DictReader(file)
    assert float(tilt["angle_deg"]) == pytest.approx(12.086, abs=1e-3)


def test_a_recording_is_never_overwritten(recorded):
    folder, _ = recorded
    before = (folder / "scans.jsonl").read_bytes()
    with pytest.raises(InputError, match=r"holds scans\.jsonl already"):
        JsonlRecorder(folder)
    assert (folder / "scans.jsonl").read_bytes() == before


@pytest.mark.parametrize("text", ["", "12,x", "100", "nan"])
def test_angles_that_are_none_are_refused(text):
    with pytest.raises(InputError, match="--tilts"):
        parse_tilts(text)
    assert parse_tilts("12.1, -3") == (12.1, -3.0)


def test_without_anything_that_tells_the_tilt_nothing_is_begun(tmp_path):
    plan = AcquirePlan("L0", (1.0,), 1, tmp_path / "out")
    with pytest.raises(InputError, match="nothing would tell the tilt angles"):
        acquire(MonitorAddresses("/dev/none"), plan, console=Console(quiet=True))
    assert not (tmp_path / "out").exists()


def test_enter_is_heard_once_and_not_waited_for(monkeypatch):
    read_fd, write_fd = os.pipe()
    with os.fdopen(read_fd) as reader, os.fdopen(write_fd, "w") as writer:
        monkeypatch.setattr("sys.stdin", reader)
        assert not _is_enter_pressed()
        writer.write("\n")
        writer.flush()
        assert _is_enter_pressed()
        assert not _is_enter_pressed()
