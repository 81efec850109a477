"""The detector alone on one source, as a person watches it."""

import re

import cv2
import numpy as np
import pytest

from nodes.frames import SourceCounts
from nodes.simulated.rendering.rendered_files import write_images
from nodes.simulated.rendering.rendered_source import RenderedSource
from tests.nodes.small_videos import small_camera, small_room

N_EMPTY, N_FRAMES = 20, 60


@pytest.fixture(scope="module")
def camera():
    """Looks at an empty room for 20 frames, then at the spot for 40."""
    built = small_room("smart_room", n_frames=N_FRAMES - N_EMPTY)
    return small_camera(built, 2, n_empty=N_EMPTY)


@pytest.fixture(scope="module")
def images(camera, tmp_path_factory):
    folder = tmp_path_factory.mktemp("images") / "C2"
    write_images(camera, folder)
    return folder


def row(out, name):
    return next(line.split(name, 1)[1].strip() for line in out.splitlines() if line.strip().startswith(name))


def test_a_recording_is_looked_through_and_summed_up(images, camera, spotcal):
    status, out, err = spotcal("spot", images)
    assert status == 0, err
    assert row(out, "size") == "320 x 240 px"
    assert row(out, "frames").startswith(f"{N_FRAMES}, ")
    n_visible = sum(camera.truth(k).is_visible for k in range(N_FRAMES))
    n_seen, n_watched = map(int, re.findall(r"\d+", row(out, "with a spot"))[:2])
    assert n_watched == N_FRAMES
    # One frame on the border of the picture may be seen though its centre is outside, or the other way round.
    assert abs(n_seen - n_visible) <= 1
    assert "score" in row(out, "now")


def test_empty_frames_at_the_beginning_teach_the_background(images, spotcal):
    status, out, _ = spotcal("spot", images, "--background", f"first:{N_EMPTY}", "--frames", 30)
    assert status == 0
    assert row(out, "frames").startswith("30, ")
    assert f"of {30 - N_EMPTY} watched" in row(out, "with a spot")


def test_saved_pictures_show_the_spot(images, camera, spotcal, tmp_path):
    status, _, _ = spotcal("spot", images, "--frames", 30, "--save", tmp_path / "seen")
    assert status == 0
    assert sorted(path.name for path in (tmp_path / "seen").iterdir()) == [f"{k:06d}.jpg" for k in range(30)]
    picture = cv2.imread(str(tmp_path / "seen" / "000025.jpg"))
    assert picture is not None
    x, y = np.rint(camera.truth(25).px).astype(int)
    ring = picture[max(y - 20, 0) : y + 21, max(x - 20, 0) : x + 21].astype(int)
    # Green around the spot, where the picture itself is grey.
    assert (ring[..., 1] - ring[..., 2]).max() > 80


class Live(RenderedSource):
    """A live camera that never ends, until the person does."""

    @property
    def counts(self):
        return SourceCounts(dropped=7)

    def __iter__(self):
        yield from super().__iter__()
        raise KeyboardInterrupt


def test_a_live_camera_is_watched_until_the_person_ends_it(camera, spotcal, monkeypatch):
    monkeypatch.setattr("nodes.camera.spot.open_source", lambda _text: Live(camera))
    status, out, err = spotcal("spot", "/dev/video0", "--background", f"first:{N_EMPTY}")
    assert status == 0, err
    assert row(out, "frames").startswith(f"{N_FRAMES}, ")
    assert row(out, "frames").endswith("7 lost")


def test_a_password_is_not_told(spotcal):
    status, out, err = spotcal("spot", "rtsp://me:secret@127.0.0.1:9/live", "--background", "whole")
    assert status == 2
    assert "secret" not in out + err
