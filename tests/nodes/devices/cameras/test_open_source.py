"""The one door: what is given decides what is opened."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from network_calib.errors import InputError
from nodes.devices.cameras import live_video
from nodes.devices.cameras.image_folder import ImageFolder, ImageOptions
from nodes.devices.cameras.live_options import LiveOptions
from nodes.devices.cameras.open_source import SourceOptions, open_source
from nodes.devices.cameras.source_info import describe
from nodes.devices.cameras.video_file import VideoFile
from nodes.devices.cameras.video_open import VideoOptions
from nodes.devices.errors import SourceError
from tests.nodes.devices.video_writer import pictures, write_video


@pytest.fixture
def asked_live(monkeypatch):
    """The addresses for which a live camera was asked, with the options; none is opened."""
    asked = []
    monkeypatch.setattr(live_video, "open_live", lambda address, options: asked.append((address, options)))
    return asked


@pytest.mark.parametrize(
    ("given", "address"),
    [
        ("rtsp://user:pw@10.0.0.5:554/live", "rtsp://user:pw@10.0.0.5:554/live"),
        ("RTSPS://camera/live", "RTSPS://camera/live"),
        (" /dev/video2 ", "/dev/video2"),
        ("usb:0", "/dev/video0"),
        ("usb:12", "/dev/video12"),
    ],
)
def test_live_cameras(asked_live, given, address):
    options = SourceOptions(live=LiveOptions(n_queued=9))
    open_source(given, options)
    assert asked_live == [(address, options.live)]


@pytest.mark.parametrize("given", ["ftp://user:secret@host/a.mp4", "nonsense://user:secret@host"])
def test_other_addresses_are_refused_without_their_password(given):
    with pytest.raises(InputError) as caught:
        open_source(given)
    assert "secret" not in f"{caught.value}"
    assert "rtsp://" in caught.value.advice


@pytest.fixture
def folder(tmp_path):
    write_video(tmp_path / "walk.mkv", pictures("gray", 3))
    write_video(tmp_path / "walk [1].mkv", pictures("gray", 3))
    for name in ("a1.png", "a2.png", "b1.png", "x[1].png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((4, 4), np.uint8))
    return tmp_path


@pytest.mark.parametrize("name", ["walk.mkv", "walk [1].mkv"])
def test_videos(folder, name):
    options = SourceOptions(video=VideoOptions(keep_damaged=True))
    for given in (folder / name, str(folder / name), f"file:{folder / name}", f"file://{folder / name}"):
        with open_source(given, options) as source:
            assert isinstance(source, VideoFile)
            assert len(list(source)) == 3
            assert describe(source).codec == "ffv1"


@pytest.mark.parametrize(("pattern", "n_images"), [("a*", 2), ("[ab]1.png", None), ("b?.png", 1), ("x[1].png", 1)])
def test_patterns_and_single_images(folder, pattern, n_images):
    given = f"{folder}/{pattern}"
    if n_images is None:
        with pytest.raises(SourceError, match="do not only differ in their numbers"):
            open_source(given)
        return
    with open_source(given, SourceOptions(images=ImageOptions(rate_hz=7))) as source:
        assert isinstance(source, ImageFolder)
        assert len(list(source)) == n_images
        assert source.rate_hz == 7


def test_folders(folder):
    for name in ("b1.png", "x[1].png"):
        (folder / name).unlink()
    with open_source(folder) as source:
        assert isinstance(source, ImageFolder)
        assert [frame.sequence for frame in source] == [1, 2]
        assert describe(source).n_frames == 2


def test_what_is_nothing_of_these_is_refused(folder):
    for given, words in (("0", "does not exist"), (f"{folder}/none.mp4", "does not exist"), (" ", "no source")):
        with pytest.raises(InputError, match=words) as caught:
            open_source(given)
        assert "usb:0" in caught.value.advice
    with pytest.raises(InputError, match="pattern stands in the folder's name"):
        open_source(f"{folder}/cam*/1.png")
    with pytest.raises(SourceError, match="fits the pattern"):
        open_source(f"{folder}/c*.png")


def test_a_folder_that_may_not_be_entered_is_refused(folder, as_nobody):
    inner = folder / "inner"
    inner.mkdir()
    inner.chmod(0)
    with as_nobody(), pytest.raises(SourceError, match="Permission denied"):
        open_source(inner / "walk.mkv")


def test_describing_any_source_needs_only_the_seam():
    class Plain:
        name, size_px, rate_hz = "camera", (640, 480), 30.0

    info = describe(Plain())  # pyright: ignore[reportArgumentType]
    assert (info.name, info.kind, info.size_px, info.rate_hz) == ("camera", "live", (640, 480), 30.0)


def test_the_door_itself_loads_nothing_heavy(root):
    cameras = "nodes.devices.cameras"
    code = f"import {cameras}.open_source, {cameras}.stereo_head, sys; print('\\n'.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True).stdout
    assert {"av", "cv2"} & set(loaded.split()) == set()
