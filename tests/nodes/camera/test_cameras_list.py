"""The list of connected cameras, for a person."""

import re

from rich.console import Console

from nodes.camera.cameras_list import cameras_view
from nodes.devices.discover import CameraKind, CameraMode, FoundCamera

USB = FoundCamera(
    CameraKind.V4L2,
    "/dev/video0",
    "Webcam [4K]",
    (
        CameraMode("MJPG", (640, 480), (15.0, 30.0)),
        CameraMode("MJPG", (1920, 1080), (30.0,)),
        CameraMode("YUYV", (640, 480), ()),
    ),
)


def text_of(found, *, is_network_asked=False):
    console = Console(width=120, record=True, file=None)
    with console.capture() as captured:
        console.print(cameras_view(found, is_network_asked=is_network_asked))
    return captured.get()


def test_each_coding_is_a_line_the_largest_picture_first():
    lines = text_of([USB]).splitlines()
    assert any("/dev/video0" in line and "Webcam [4K]" in line for line in lines)
    assert any("MJPG: 1920 x 1080 at 30 Hz, 640 x 480 at 30 Hz" in line for line in lines)
    assert any(re.search(r"YUYV: 640 x 480\s*$", line) for line in lines)
    assert lines[-1] == "Look through one: spotcal spot /dev/video0"


def test_a_camera_that_cannot_be_used_says_why():
    locked = FoundCamera(CameraKind.V4L2, "/dev/video2", "Webcam", problem="no permission to open it. Join the group")
    text = text_of([locked])
    assert "cannot be used, see below" in text
    assert "/dev/video2: no permission to open it. Join the group" in text
    assert "Look through one" not in text


def test_a_network_camera_says_how_to_reach_it():
    text = text_of([FoundCamera(CameraKind.ONVIF, "192.0.2.7", "Door")], is_network_asked=True)
    assert "rtsp://USER:PASSWORD@192.0.2.7/PATH" in text


def test_without_cameras_it_says_what_to_do():
    assert "spotcal cameras --network" in " ".join(text_of([]).split())
    assert "ONVIF" in text_of([], is_network_asked=True)


def test_the_command_lists_what_is_found(spotcal, monkeypatch):
    waits = []

    def found(*, network_wait_s):
        waits.append(network_wait_s)
        return [USB]

    monkeypatch.setattr("nodes.camera.cameras_list.find_cameras", found)
    assert "Webcam" in spotcal("cameras")[1]
    assert spotcal("cameras", "--network")[0] == 0
    assert waits == [None, 3.0]
