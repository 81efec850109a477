"""Sources with names, and what the command line says about detection."""

import cv2
import numpy as np
import pytest

from network_calib.errors import InputError
from nodes.detection.spots import Channel
from nodes.detector_settings import NamedSource, named_sources, parse_background, parse_channel, read_mask, with_masks


def names_of(*texts):
    return [(source.name, source.text) for source in named_sources([str(text) for text in texts])]


def test_cameras_are_named_after_their_files_or_as_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("left.mp4", "right.mp4"):
        (tmp_path / name).touch()
    (tmp_path / "frames").mkdir()
    assert names_of("left.mp4", "frames", "door=right.mp4") == [
        ("left", "left.mp4"), ("frames", "frames"), ("door", "right.mp4"),
    ]  # fmt: skip
    assert names_of("walk/door_*.png", "walk/gate.avi") == [("door", "walk/door_*.png"), ("gate", "walk/gate.avi")]


def test_an_equals_sign_in_a_path_or_address_is_no_name(tmp_path):
    odd = tmp_path / "gain=3.mp4"
    odd.touch()
    assert names_of(odd) == [("gain=3", str(odd))]
    address = "rtsp://door.example/live?profile=2"
    assert names_of(address) == [("C0", address)]
    assert names_of(f"door={address}") == [("door", address)]


def test_files_of_one_name_are_named_after_their_folders(tmp_path):
    for folder in ("cam1", "cam2"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "video.mp4").touch()
    paths = [tmp_path / folder / "video.mp4" for folder in ("cam1", "cam2")]
    assert [name for name, _ in names_of(*paths)] == ["cam1", "cam2"]
    with pytest.raises(InputError, match="two sources would be camera 'video'"):
        named_sources([str(paths[0]), str(paths[0])])


def test_options_are_understood_or_refused():
    assert parse_channel("red") is Channel.RED
    assert (parse_background("whole"), parse_background("first:12")) == (None, 12)
    with pytest.raises(InputError, match="--channel purple: expected one of auto, red, green, blue, luma"):
        parse_channel("purple")
    for wrong in ("none", "first:0", "first:", "first:1.5", "last:3"):
        with pytest.raises(InputError, match=f"--background {wrong}: expected whole, or first:N"):
            parse_background(wrong)


def test_mask_is_where_the_image_is_not_black(tmp_path):
    path = tmp_path / "mask.png"
    image = np.zeros((4, 6), np.uint8)
    image[:, 2:] = 255
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    assert np.array_equal(read_mask(path, (6, 4)), image > 0)
    with pytest.raises(InputError, match=r"mask\.png has 6 x 4 pixels, the camera 8 x 4"):
        read_mask(path, (8, 4))


@pytest.mark.parametrize("content", [b"", b"no image"])
def test_a_mask_that_is_no_image_is_refused(tmp_path, content):
    (tmp_path / "mask.png").write_bytes(content)
    with pytest.raises(InputError, match=r"mask\.png is no image"):
        read_mask(tmp_path / "mask.png", (6, 4))


def test_masks_go_to_their_cameras(tmp_path):
    white = cv2.imencode(".png", np.full((4, 6), 255, np.uint8))[1].tobytes()
    for name in ("all.png", "door.png"):
        (tmp_path / name).write_bytes(white)
    sources = (NamedSource("C0", "a"), NamedSource("door", "b"))
    both = with_masks(sources, [str(tmp_path / "all.png"), f"door={tmp_path / 'door.png'}"])
    assert [source.mask for source in both] == [tmp_path / "all.png", tmp_path / "door.png"]
    assert with_masks(sources, []) == sources
    with pytest.raises(InputError, match="no camera 'gate', expected one of C0, door"):
        with_masks(sources, [f"gate={tmp_path / 'door.png'}"])
    with pytest.raises(InputError, match="have the mask"):
        with_masks(sources, [str(tmp_path / "all.png"), str(tmp_path / "door.png")])
    with pytest.raises(InputError, match=r"--mask .*absent\.png: no such file"):
        with_masks(sources, [str(tmp_path / "absent.png")])
