"""All faults of a file at once, paths from its folder, and never a password."""

from __future__ import annotations

from pathlib import Path

import pytest

from network_calib.errors import InputError
from nodes.site.bus_options import bus_options
from nodes.site.load import load_camera_node, load_lrf_node, load_site

CAMERA = 'node = "n"\nsite = "s"\njournal = "j.db"\n[[cameras]]\nname = "C0"\nsource = "{}"\n'


def _written(folder: Path, text: str) -> Path:
    path = folder / "file.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_site_is_a_room_and_more(tmp_path: Path) -> None:
    text = 'name = "lab"\n[[cameras]]\nname = "C0"\nsize = [640, 480]\n[[nodes]]\nname = "door"\n'
    site = load_site(_written(tmp_path, text))
    assert (site.name, site.cameras[0].name, site.nodes[0].role) == ("lab", "C0", "camera")
    assert site.router == ["tcp/127.0.0.1:7447"]
    assert site.session.tilts_deg == [2.0, 12.0, 23.0]
    assert site.data == str(tmp_path / "sessions")


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    text = """
name = "lab 1"
router = ["127.0.0.1"]
[[nodes]]
name = "a/b"
role = "cammera"
[session]
target_sigma_mn = 2
crossings = 0
tilts_deg = [2, 95]
"""
    with pytest.raises(InputError) as caught:
        load_site(_written(tmp_path, text))
    message = caught.value.message
    places = ("name:", "router[0]:", "nodes[0].name:", "nodes[0].role:", "session.crossings:", "session.tilts_deg[1]:")
    for place in places:
        assert f"\n  {place}" in message
    assert "session.target_sigma_mn: unknown key (did you mean 'target_sigma_mm'?)" in message
    assert "holds 7 faults" in message


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("[session]\nmin_waving_s = 700\n", "min_waving_s = 700 is above max_waving_s = 600"),
        ('[[nodes]]\nname = "a"\n[[nodes]]\nname = "a"\n', "names of nodes given twice: a"),
    ],
)
def test_what_does_not_fit_together_is_refused(tmp_path: Path, change: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        load_site(_written(tmp_path, 'name = "lab"\n' + change))


def test_an_lrf_needs_something_that_tells_its_tilt(tmp_path: Path) -> None:
    text = 'node = "n"\nsite = "s"\njournal = "j"\n[lrf]\nname = "L0"\nscanner = "/dev/ttyACM0"\n'
    with pytest.raises(InputError, match="neither tilt_unit nor imu"):
        load_lrf_node(_written(tmp_path, text))
    assert load_lrf_node(_written(tmp_path, text + 'imu = "/dev/ttyUSB1"\n')).lrf.tilt_unit is None


def test_paths_are_meant_from_the_folder_of_the_file(tmp_path: Path) -> None:
    for given, meant in (
        ("walk/door.mp4", str(tmp_path / "walk/door.mp4")),
        ("/walk/door.mp4", "/walk/door.mp4"),
        ("file:door.mp4", str(tmp_path / "door.mp4")),
        ("simulated:room#C0", f"simulated:{tmp_path / 'room#C0'}"),
        ("simulated:/room#C0", "simulated:/room#C0"),
        ("rtsp://host/path", "rtsp://host/path"),
        ("usb:0", "usb:0"),
        ("/dev/video0", "/dev/video0"),
    ):
        config = load_camera_node(_written(tmp_path, CAMERA.format(given)))
        assert config.cameras[0].source == meant
        assert config.journal == str(tmp_path / "j.db")


def test_a_password_is_refused_and_not_shown(tmp_path: Path) -> None:
    for source in (
        "rtsp://viewer:hunter2@host/path",
        "rtsp://viewer:hunt/er2@host/path",
        "rtsp://:hunter2@host/path",
        "rtsp://viewer:${DOOR}hunter2@host/path",
        "rtsp://host/user=admin&password=hunter2&channel=1",
    ):
        with pytest.raises(InputError) as caught:
            load_camera_node(_written(tmp_path, CAMERA.format(source)))
        assert "cameras[0].source: a password stands in it" in caught.value.message
        assert "${" in caught.value.message
        assert "hunt" not in caught.value.message


def test_a_password_in_the_wrong_place_is_not_shown_either(tmp_path: Path) -> None:
    text = 'node = "n"\nsite = "s"\njournal = "j"\ncameras = ["rtsp://viewer:hunter2@host/path"]\n'
    with pytest.raises(InputError) as caught:
        load_camera_node(_written(tmp_path, text))
    assert "hunter2" not in caught.value.message


def test_addresses_without_a_password_are_taken(tmp_path: Path) -> None:
    for source in (
        "rtsp://viewer@host/path",
        "rtsp://host:554/profile@1",
        "rtsp://viewer:${DOOR}@host:554/path",
        "rtsp://viewer:${file:/etc/spotcal/door}@host/path",
        "rtsp://host/user=admin&password=${DOOR}&channel=1",
    ):
        assert load_camera_node(_written(tmp_path, CAMERA.format(source))).cameras[0].source == source


def test_the_bus_is_reached_as_the_file_says(tmp_path: Path) -> None:
    text = CAMERA.format("/dev/video0").replace("[[cameras]]", 'router = ["tls/a:1", "tls/b:1"]\n[[cameras]]')
    text += '[tls]\nca = "ca.pem"\ncertificate = "/c.pem"\nkey = "c.key"\n'
    options = bus_options(load_camera_node(_written(tmp_path, text)))
    assert options.site == "s"
    assert options.endpoints == ("tls/a:1", "tls/b:1")
    assert options.tls is not None
    assert (options.tls.ca, options.tls.certificate) == (tmp_path / "ca.pem", Path("/c.pem"))
