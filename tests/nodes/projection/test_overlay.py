import csv

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from network_calib.errors import InputError
from network_calib.formats.calibration_json import save
from nodes.cli import app
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.overlay import draw_overlay, drawn_points, ellipses
from nodes.projection.points import Beams, WorldPoints
from nodes.projection.points_file import read_points
from nodes.simulation.lrf_simulation import LRF_NAME
from tests.nodes.projection import scanned_site as site


@pytest.fixture(scope="module")
def truth():
    return site.scene()


@pytest.fixture(scope="module")
def calibration(truth):
    return site.calibration_of(truth)


@pytest.fixture(scope="module")
def beams(truth):
    readings_mm = site.ranges_mm(truth)
    is_range = site.STEPS.is_range(readings_mm)
    n = int(is_range.sum())
    return Beams(
        LRF_NAME,
        readings_mm[is_range].astype(np.float64) / 1e3,
        site.STEPS.bearings_rad[is_range],
        np.full(n, site.TILT_RAD),
    )


@pytest.fixture
def table(tmp_path):
    def write(*rows):
        path = tmp_path / "points.csv"
        with path.open("w", newline="") as file:
            csv.writer(file).writerows(rows)
        return path

    return write


def test_measurements_and_points_in_world_are_read(table):
    header = ["lrf", "range_m", "bearing_rad", "tilt_deg"]
    path = table(header, ["L0", 1.5, 0.1, 10], ["L1", 2, -0.2, 20], [], ["L0", 3, 0.3, 30])
    first, second = read_points(path)
    assert isinstance(first, Beams)
    assert isinstance(second, Beams)
    assert (first.lrf, second.lrf) == ("L0", "L1")
    assert first.range_m.tolist() == [1.5, 3.0]
    assert np.allclose(np.asarray(first.tilt_rad), np.radians([10, 30]))
    assert second.bearing_rad.tolist() == [-0.2]
    (world,) = read_points(table(["z", "x", "y"], [3, 1, 2]))
    assert isinstance(world, WorldPoints)
    assert world.xyz_m.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ((), "empty file"),
        ((["x", "y"],), "x, y"),
        ((["x", "y", "z"],), "no points"),
        ((["x", "y", "z"], [1, 2, 3], [1, 2]), "point 2"),
        ((["x", "y", "z"], [1, "two", 3]), "1,two,3"),
    ],
)
def test_tables_of_something_else_are_refused(table, rows, told):
    with pytest.raises(InputError, match=told):
        read_points(table(*rows))


def test_drawn_are_the_points_in_the_image_where_the_calibration_puts_them(calibration, beams, truth):
    drawn = drawn_points(calibration, (beams,), "C2")
    expected = calibration.project(beams, ["C2"])
    assert np.array_equal(drawn.px, expected.px[0, expected.is_valid[0]])
    assert np.array_equal(drawn.range_m, beams.range_m[expected.is_valid[0]])
    assert drawn.n_given == len(beams) > len(drawn.px) > 0
    # The same points given in world: their range is their distance from the camera.
    ends = truth.scanner.points_in_world(beams.range_m, beams.bearing_rad, beams.tilt_rad)
    world = drawn_points(calibration, (WorldPoints(ends),), "C2")
    assert np.allclose(world.px, drawn.px, atol=1e-9)
    centre = calibration.result.cameras[2].centre_in_world
    assert np.allclose(world.range_m, np.linalg.norm(ends[expected.is_valid[0]] - centre, axis=1))


def test_an_ellipse_holds_95_percent():
    rng = np.random.default_rng(0)
    covariance = np.array([[[4.0, 1.5], [1.5, 1.0]]])
    diameter, angle = ellipses(covariance)
    n = 20_000
    drawn = rng.multivariate_normal([0, 0], covariance[0], n)
    turn = np.radians(angle[0])
    along = drawn @ [np.cos(turn), np.sin(turn)]
    across = drawn @ [-np.sin(turn), np.cos(turn)]
    share = np.mean((2 * along / diameter[0, 0]) ** 2 + (2 * across / diameter[0, 1]) ** 2 <= 1)
    # Four standard deviations of a share of n draws.
    assert share == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / n))
    # Long along x + y, since x and y grow together: y counts down in the picture, as in the image.
    assert 0 < (angle[0] % 180) < 45


def test_the_picture_shows_the_image_and_the_points_over_it(calibration, truth, tmp_path):
    width, height = calibration.result.cameras[0].size_px
    image, out = tmp_path / "frame.png", tmp_path / "overlay.png"
    cv2.imwrite(str(image), np.full((height, width), 255, np.uint8))
    # One point on the optical axis of C0, 2 m away.
    centre = truth.cameras.cam_from_world[0].inv().apply([0.0, 0.0, 2.0])
    draw_overlay(calibration, (WorldPoints(np.array([centre])),), "C0", out, image=image)
    read = cv2.imread(str(out))
    assert read is not None
    picture = read.astype(int)
    # All of one channel in a white picture, and far from grey: the point, its ellipse, and the legend at the right.
    is_coloured = np.ptp(picture, axis=2) > 80
    rows, _ = np.nonzero(is_coloured[:, : int(0.85 * picture.shape[1])])
    assert 5 < len(rows) < 0.01 * picture[:, :, 0].size
    middle = calibration.project(WorldPoints(np.array([centre])), ["C0"]).px[0, 0] / [width, height]
    assert abs(rows.mean() / picture.shape[0] - middle[1]) < 0.08
    assert is_coloured[:, int(0.85 * picture.shape[1]) :].any()


def test_points_that_nobody_sees_make_a_picture_without_points(calibration, tmp_path):
    out = tmp_path / "sub" / "overlay.png"
    drawn = draw_overlay(calibration, (WorldPoints(np.array([[0.0, 0.0, -5.0]])),), "C0", out)
    assert len(drawn.px) == 0
    assert out.stat().st_size > 0


def test_what_cannot_be_drawn_is_refused(calibration, beams, tmp_path):
    out = tmp_path / "overlay.png"
    with pytest.raises(ProjectionError) as caught:
        draw_overlay(calibration, (beams,), "C77", out)
    assert caught.value.code is ErrorCode.UNKNOWN_CAMERA
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((10, 20), np.uint8))
    with pytest.raises(InputError, match="20 x 10"):
        draw_overlay(calibration, (beams,), "C0", out, image=small)
    assert not out.exists()


def test_the_command_writes_the_picture(calibration, table, tmp_path):
    save(calibration.result, tmp_path / "calibration.json")
    points = table(
        ["lrf", "range_m", "bearing_rad", "tilt_deg"], [LRF_NAME, 2.0, 0.0, 23.2], [LRF_NAME, 2.1, 0.01, 23.2]
    )
    out = tmp_path / "out.png"
    arguments = ["--calibration", str(tmp_path / "calibration.json"), "--camera", "C0", "--out", str(out)]
    ran = CliRunner().invoke(app, ["project", str(points), *arguments])
    assert ran.exit_code == 0, ran.output
    assert "2 of 2 points" in ran.output
    assert cv2.imread(str(out)) is not None
