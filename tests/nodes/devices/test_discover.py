import errno

import pytest

from nodes.devices.cameras.onvif_probe import OnvifCamera
from nodes.devices.discover import CameraKind, CameraMode, FoundCamera, find_cameras, find_v4l2
from tests.nodes.devices.fake_v4l2 import FakeKernel

WEBCAM = {b"YUYV": {(640, 480): [(1, 30), (1, 15)]}, b"MJPG": {(1920, 1080): [(1, 30)], (640, 480): [(2, 25)]}}


@pytest.fixture
def machine(tmp_path):
    """Folders like /sys/class/video4linux and /dev; `add` connects a device."""
    sysfs, devices = tmp_path / "video4linux", tmp_path / "dev"
    sysfs.mkdir()
    devices.mkdir()

    def add(number, name):
        (sysfs / f"video{number}").mkdir()
        (sysfs / f"video{number}" / "name").write_text(f"{name}\n")
        (devices / f"video{number}").touch()
        return devices / f"video{number}"

    return sysfs, devices, add


def test_a_machine_without_video_devices_has_no_cameras(tmp_path):
    assert find_v4l2(sysfs=tmp_path / "none", devices=tmp_path) == []


def test_a_camera_is_listed_with_all_it_can_do(machine):
    sysfs, devices, add = machine
    device = add(0, "HD Webcam: HD")
    modes = (
        CameraMode("YUYV", (640, 480), (30.0, 15.0)),
        CameraMode("MJPG", (1920, 1080), (30.0,)),
        CameraMode("MJPG", (640, 480), (12.5,)),
    )
    found = find_v4l2(sysfs=sysfs, devices=devices, ioctl=FakeKernel(modes=WEBCAM))
    assert found == [FoundCamera(CameraKind.V4L2, str(device), "HD Webcam", modes)]


def test_of_a_continuous_choice_the_ends_are_listed(machine):
    sysfs, devices, add = machine
    add(0, "sensor")
    kernel = FakeKernel(ranges={b"RGGB": ((32, 16), (4056, 3040))})
    (camera,) = find_v4l2(sysfs=sysfs, devices=devices, ioctl=kernel)
    assert [(mode.coding, mode.size_px, mode.rates_hz) for mode in camera.modes] == [
        ("RGGB", (32, 16), (60.0, 5.0)),
        ("RGGB", (4056, 3040), (60.0, 5.0)),
    ]


def test_nodes_that_do_not_capture_are_left_out_and_numbers_sort_as_numbers(machine):
    sysfs, devices, add = machine
    for number in (10, 2, 0):
        add(number, "x")
    assert [camera.address[-3:] for camera in find_v4l2(sysfs=sysfs, devices=devices, ioctl=FakeKernel())] == [
        "eo0",
        "eo2",
        "o10",
    ]
    metadata_node = FakeKernel(capabilities=(0x84A00001, 0x04A00000))
    assert find_v4l2(sysfs=sysfs, devices=devices, ioctl=metadata_node) == []


def test_a_device_that_may_not_be_asked_is_listed_with_the_reason(machine):
    sysfs, devices, add = machine
    add(0, "HD Webcam")

    def forbidden(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    (camera,) = find_v4l2(sysfs=sysfs, devices=devices, ioctl=forbidden)
    assert (camera.name, camera.modes) == ("HD Webcam", ())
    assert camera.problem.startswith("no permission to open it. ")
    (devices / "video0").unlink()
    (gone,) = find_v4l2(sysfs=sysfs, devices=devices, ioctl=FakeKernel())
    assert gone.problem == "No such file or directory"


def test_a_name_with_control_characters_is_shown_without_them(machine):
    sysfs, devices, add = machine
    add(0, "x")
    (camera,) = find_v4l2(sysfs=sysfs, devices=devices, ioctl=FakeKernel(card=b"\x1b[31mred"))
    assert camera.name == "?[31mred"


def test_a_driver_that_lists_without_end_is_cut_off(machine):
    sysfs, devices, add = machine
    add(0, "x")
    kernel = FakeKernel(modes={b"GREY": {(640, 480): [(1, 30)] * 100_000}})
    (camera,) = find_v4l2(sysfs=sysfs, devices=devices, ioctl=kernel)
    assert len(camera.modes[0].rates_hz) == 256


def test_the_network_is_asked_only_when_wanted(monkeypatch):
    asked = []

    def probe(*, wait_s):
        asked.append(wait_s)
        return [OnvifCamera("10.0.0.7", "http://10.0.0.7/onvif/device_service", "Door")]

    monkeypatch.setattr("nodes.devices.discover.probe_onvif", probe)
    find_cameras()
    assert asked == []
    assert FoundCamera(CameraKind.ONVIF, "10.0.0.7", "Door") in find_cameras(network_wait_s=0.5)
    assert asked == [0.5]
