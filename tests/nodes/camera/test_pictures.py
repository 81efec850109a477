from dataclasses import replace

import numpy as np
import pytest

from network_calib.cameras import LensModel
from network_calib.formats.calibration_json import load
from network_calib.formats.source import read_source
from network_calib.spots import SpotViews, locate
from nodes.camera.pictures import draw_errors, draw_residuals
from nodes.report.network_picture import draw_network


def shape_and_ink(path):
    """Pixels of a PNG, and the share of them that are not white."""
    from matplotlib.image import imread

    image = imread(path)[..., :3]
    return image.shape[:2], float((image.min(axis=-1) < 0.99).mean())


@pytest.fixture
def drawn(smart_room):
    truth = load(smart_room / "truth.json")
    views = SpotViews.of(read_source(smart_room).observations)
    points, is_inlier = locate(truth.as_cameras(), views, np.full(len(views.camera), 1.0))
    return truth, views, points, is_inlier


def test_pictures_are_written_and_hold_something(drawn, tmp_path):
    truth, views, points, is_inlier = drawn
    draw_network(truth, points, tmp_path / "network.png")
    draw_residuals(truth, views, points, is_inlier, tmp_path / "deeper" / "residuals.png")
    draw_errors(truth, tmp_path / "errors.png")
    for name in ("network.png", "deeper/residuals.png", "errors.png"):
        (height, width), ink = shape_and_ink(tmp_path / name)
        assert min(height, width) > 400
        assert ink > 0.005


def test_more_spots_leave_more_ink(drawn, tmp_path):
    truth, _, points, _ = drawn
    draw_network(truth, points, tmp_path / "all.png")
    few = np.where(np.arange(len(points))[:, None] % 10 == 0, points, np.nan)
    few[:2] = points[:2]
    draw_network(truth, few, tmp_path / "few.png")
    assert shape_and_ink(tmp_path / "all.png")[1] > shape_and_ink(tmp_path / "few.png")[1]


def test_fisheye_levelled_and_awkward_names_can_be_drawn(calibration, tmp_path):
    assert any(camera.lens is LensModel.FISHEYE for camera in calibration.cameras)
    spots = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (50, 3))
    draw_network(calibration, spots, tmp_path / "lent_frame.png")
    draw_network(replace(calibration, world=replace(calibration.world, name="floor")), spots, tmp_path / "floor.png")
    names = ("$x$_a", "C1", "ö^2")  # matplotlib's mathematics must not swallow a name
    cameras = tuple(replace(c, name=name) for c, name in zip(calibration.cameras, names, strict=True))
    draw_errors(replace(calibration, cameras=cameras), tmp_path / "errors.png")
    assert len(list(tmp_path.iterdir())) == 3


def test_no_spot_and_one_camera_can_be_drawn(calibration, tmp_path):
    alone = replace(calibration, cameras=calibration.cameras[:1])
    draw_network(alone, np.full((3, 3), np.nan), tmp_path / "network.png")
    draw_errors(alone, tmp_path / "errors.png")
    assert (tmp_path / "network.png").is_file()
