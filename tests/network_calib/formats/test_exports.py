import tomllib
from dataclasses import replace

import numpy as np
import pytest

from network_calib.cameras import LensModel
from network_calib.errors import InputError
from network_calib.formats.aniposelib import read_aniposelib, write_aniposelib
from network_calib.formats.opencv import write_opencv
from network_calib.formats.rad import read_rad_intrinsics
from network_calib.formats.svoboda_export import write_svoboda

POINTS_IN_CAM = np.array([[0.3, -0.2, 2.0], [-0.9, 0.6, 3.0], [0.0, 0.0, 1.0]])


def pinholes(calibration):
    return replace(calibration, cameras=tuple(c for c in calibration.cameras if not c.lens.is_fisheye))


def points_before(camera):
    """Points in world that lie before the camera, and the pixels where OpenCV sees them."""
    import cv2

    # cv2.fisheye reads a transposed array in the wrong order, and `apply` may return one.
    in_world = np.ascontiguousarray(camera.cam_from_world.inv().apply(POINTS_IN_CAM))
    row = np.asarray(camera.intrinsics)
    matrix = np.array([[row[0], 0, row[2]], [0, row[1], row[3]], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if camera.lens.is_fisheye else cv2.projectPoints
    px, _ = project(POINTS_IN_CAM.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, row[4:])
    return in_world, px.reshape(-1, 2)


def test_aniposelib_file_gives_the_same_pixels_back(calibration, tmp_path):
    write_aniposelib(calibration, tmp_path / "c.toml")
    cameras = read_aniposelib(tmp_path / "c.toml")
    assert cameras.names == tuple(camera.name for camera in calibration.cameras)
    assert cameras.lenses == (LensModel.K1_K2, LensModel.FISHEYE, LensModel.NONE)
    assert np.array_equal(cameras.intrinsics, calibration.as_cameras().intrinsics)
    assert np.array_equal(cameras.size_px, calibration.as_cameras().size_px)
    for index, camera in enumerate(calibration.cameras):
        in_world, expected = points_before(camera)
        px, is_valid = cameras.img_from_world(np.full(len(in_world), index), in_world)
        assert is_valid.all()
        # Matrix to vector and back costs some 1e-15; pixels reach 1e3.
        np.testing.assert_allclose(px, expected, rtol=0, atol=1e-9)


def test_aniposelib_layout_is_what_other_readers_expect(calibration, tmp_path):
    write_aniposelib(calibration, tmp_path / "c.toml")
    document = tomllib.loads((tmp_path / "c.toml").read_text())
    assert list(document) == ["cam_0", "cam_1", "cam_2", "metadata"]
    assert [len(document[f"cam_{k}"]["distortions"]) for k in range(3)] == [5, 4, 5]
    assert [document[f"cam_{k}"].get("fisheye", False) for k in range(3)] == [False, True, False]
    assert document["cam_2"]["name"] == "corridor [2]/ö"
    assert document["metadata"]["unit"] == "m"


def test_aniposelib_keys_sort_as_text_in_camera_order(calibration, tmp_path):
    many = replace(calibration, cameras=tuple(replace(calibration.cameras[0], name=f"C{k}") for k in range(12)))
    write_aniposelib(many, tmp_path / "c.toml")
    document = tomllib.loads((tmp_path / "c.toml").read_text())
    in_text_order = [document[key]["name"] for key in sorted(document) if key != "metadata"]
    assert in_text_order == [f"C{k}" for k in range(12)]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "holds no cameras"),
        ("x = ", "is not valid TOML"),
        ("[cam_0]\nname = 'a'\n", r"cam_0\.size: missing"),
        ("cam_0 = 3\n", "cam_0: 3, expected an object"),
    ],
)
def test_faulty_aniposelib_file_is_refused(tmp_path, content, message):
    (tmp_path / "c.toml").write_text(content)
    with pytest.raises(InputError, match=message):
        read_aniposelib(tmp_path / "c.toml")


def test_third_radial_term_is_refused(calibration, tmp_path):
    write_aniposelib(calibration, tmp_path / "c.toml")
    text = (tmp_path / "c.toml").read_text()
    (tmp_path / "c.toml").write_text(text.replace("[-0.28, 0.07, 0.0, 0.0, 0.0]", "[-0.28, 0.07, 0.0, 0.0, 0.1]"))
    with pytest.raises(InputError, match=r"cam_0\.distortions: .*third radial term is not modelled"):
        read_aniposelib(tmp_path / "c.toml")


def test_opencv_file_holds_what_opencv_projects_with(calibration, tmp_path):
    import cv2

    write_opencv(calibration, tmp_path / "c.yml")
    storage = cv2.FileStorage(str(tmp_path / "c.yml"), cv2.FILE_STORAGE_READ)
    sequence = storage.getNode("cameras")
    assert sequence.size() == 3
    for index, camera in enumerate(calibration.cameras):
        node = sequence.at(index)
        assert node.getNode("name").string() == camera.name
        assert (int(node.getNode("image_width").real()), int(node.getNode("image_height").real())) == camera.size_px
        is_fisheye = node.getNode("model").string() == "fisheye"
        in_world, expected = points_before(camera)
        project = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
        rotation, _ = cv2.Rodrigues(node.getNode("rotation").mat())
        px, _ = project(
            in_world.reshape(-1, 1, 3),
            rotation,
            node.getNode("translation").mat(),
            node.getNode("camera_matrix").mat(),
            node.getNode("distortion_coefficients").mat(),
        )
        # FileStorage writes 17 digits; the rest is rounding of pixels up to 1e3.
        np.testing.assert_allclose(px.reshape(-1, 2), expected, rtol=0, atol=1e-9)


def test_opencv_file_needs_a_known_suffix(calibration, tmp_path):
    with pytest.raises(InputError, match=r"end in \.yml, \.yaml, \.xml, \.json"):
        write_opencv(calibration, tmp_path / "c.txt")


def test_svoboda_folder_projects_to_the_undistorted_pixel(calibration, tmp_path):
    kept = pinholes(calibration)
    write_svoboda(kept, tmp_path / "out")
    for number, camera in enumerate(kept.cameras, 1):
        projection = np.loadtxt(tmp_path / "out" / f"camera{number}.Pmat.cal")
        in_world = camera.cam_from_world.inv().apply(POINTS_IN_CAM)
        homogeneous = np.column_stack([in_world, np.ones(len(in_world))]) @ projection.T
        row = camera.intrinsics
        expected = POINTS_IN_CAM[:, :2] / POINTS_IN_CAM[:, 2:] * row[:2] + row[2:4]
        np.testing.assert_allclose(homogeneous[:, :2] / homogeneous[:, 2:], expected, rtol=0, atol=1e-9)
        read, notes = read_rad_intrinsics(tmp_path / "out" / f"basename{number}.rad")
        assert np.array_equal(read, row)
        assert notes == []
    assert (tmp_path / "out" / "camera_order.txt").read_text() == "C0\ncorridor [2]/ö\n"
    assert (tmp_path / "out" / "Res.dat").read_text() == "640 480\n640 480\n"


def test_svoboda_rays_and_centre_belong_to_the_projection(calibration, tmp_path):
    kept = pinholes(calibration)
    write_svoboda(kept, tmp_path)
    lines = dict(line.split(" = ") for line in (tmp_path / "basename2.cal").read_text().splitlines() if line)
    projection = np.loadtxt(tmp_path / "camera2.Pmat.cal")
    centre = np.array([float(lines[f"C{k}"]) for k in (1, 2, 3)])
    rays = np.array([[float(lines[f"P{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)])
    # The centre is what the projection sends to zero; focal lengths of 1e3 scale the rounding.
    np.testing.assert_allclose(projection @ [*centre, 1], 0, atol=1e-10)
    np.testing.assert_allclose(rays @ projection[:, :3], np.eye(3), atol=1e-10)


def test_svoboda_layout_of_the_rad_file_suits_the_original_reader(calibration, tmp_path):
    write_svoboda(pinholes(calibration), tmp_path)
    lines = (tmp_path / "basename1.rad").read_text().splitlines()
    # The original takes nine lines from the seventh column on, skips one, takes four.
    assert float(lines[0][6:]) == 451.2
    assert float(lines[8][6:]) == 1.0
    assert lines[9] == ""
    assert float(lines[10][6:]) == -0.28


def test_svoboda_format_refuses_a_fisheye(calibration, tmp_path):
    with pytest.raises(InputError, match="no fisheye lens, but these cameras have one: C1"):
        write_svoboda(calibration, tmp_path / "out")
    assert not (tmp_path / "out").exists()
