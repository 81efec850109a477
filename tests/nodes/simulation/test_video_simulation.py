"""Rooms that are filmed: the files of a recording, and the truth."""

import csv

import numpy as np
import pytest

from network_calib.formats.calibration_json import load
from nodes.config import load_room
from nodes.devices.cameras.open_source import open_source
from nodes.frames import StampOrigin


@pytest.mark.parametrize(("format_name", "suffix"), [("ffv1", ".mkv"), ("images", "")])
def test_a_filmed_room_opens_and_has_its_truth(spotcal, tmp_path, format_name, suffix):
    status, _, err = spotcal(
        "simulate", "stereo_only", "--out", tmp_path / "r", "--frames", 4, "--video", format_name, "--seed", 3
    )
    assert status == 0, err
    truth = load(tmp_path / "r" / "truth.json")
    assert [camera.name for camera in load_room(tmp_path / "r" / "room.toml").cameras] == ["C0", "C1"]
    for camera in truth.cameras:
        with open_source(tmp_path / "r" / "videos" / f"{camera.name}{suffix}") as source:
            frames = list(source)
            assert source.size_px == camera.size_px
        assert [frame.sequence for frame in frames] == [0, 1, 2, 3]
        assert frames[0].origin is StampOrigin.TABLE
        assert np.diff([frame.stamp_ns for frame in frames]).tolist() == [40_000_000] * 3
        with (tmp_path / "r" / "videos" / f"{camera.name}.truth.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert [int(one["frame"]) for one in rows] == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("ballroom", "--video", "h264"), "no room 'ballroom'"),
        (("lrf_room", "--video", "h264"), "lrf_room holds a laser range finder and is not filmed"),
        (("smart_room", "--video", "vhs"), "--video vhs: expected one of h264, ffv1, images"),
        (("smart_room", "--video", "h264", "--scene", "opera"), "no scene 'opera', expected one of clean"),
    ],
)
def test_what_cannot_be_filmed_is_refused(spotcal, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    status, _, err = spotcal("simulate", *arguments)
    assert (status, message in err) == (2, True), err
    assert list(tmp_path.iterdir()) == []
