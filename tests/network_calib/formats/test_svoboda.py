from pathlib import Path

import numpy as np
import pytest

from network_calib.cameras import LensModel
from network_calib.errors import InputError
from network_calib.formats.source import read_source
from network_calib.formats.svoboda import read_svoboda
from network_calib.room_setup import Knowledge

DATA = Path(__file__).parents[4] / "shared" / "data"
RAD = """K11 = 422.2
K12 = 0.0
K13 = 330.1
K21 = 0.0
K22 = 424.1
K23 = 210.3
K31 = 0.0
K32 = 0.0
K33 = 1.0

kc1 = -0.28
kc2 = 0.07
kc3 = 0.0004
kc4 = -0.0001

"""


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def set_points(folder, change):
    """Rewrite points.dat after `change` (C, 3, F) has been at it; all is marked seen."""
    uvw = np.loadtxt(folder / "points.dat").reshape(3, 3, -1)
    uvw[:, :2] = np.where(np.isnan(uvw[:, :2]), 100.0, uvw[:, :2])
    uvw[:, 2] = 1
    change(uvw)
    np.savetxt(folder / "points.dat", uvw.reshape(9, -1))
    np.savetxt(folder / "IdMat.dat", np.ones((3, uvw.shape[2])), fmt="%d")


def test_recording_reads_back_exactly(svoboda_folder, observations):
    recording = read_source(svoboda_folder)
    read = recording.observations
    assert read.camera_names == observations.camera_names
    assert np.array_equal(read.camera, observations.camera)
    assert np.array_equal(read.frame, observations.frame)
    assert np.array_equal(read.px, observations.px)
    assert [setup.size_px for setup in recording.setups] == [(640, 480)] * 3
    assert recording.notes == ()
    assert recording.is_named


def test_points_are_divided_by_w_and_names_are_made_up_when_there_are_none(svoboda_folder, observations):
    uvw = np.loadtxt(svoboda_folder / "points.dat").reshape(3, 3, -1)
    np.savetxt(svoboda_folder / "points.dat", (uvw * 2.0).reshape(9, -1))
    (svoboda_folder / "camera_order.txt").unlink()
    recording = read_svoboda(svoboda_folder)
    # A product with 2 and the quotient are exact, and savetxt writes 19 digits.
    assert np.array_equal(recording.observations.px, observations.px)
    assert recording.observations.camera_names == ("cam1", "cam2", "cam3")
    assert not recording.is_named


def test_frame_that_no_camera_saw_stays_a_frame_number(svoboda_folder):
    ids = np.loadtxt(svoboda_folder / "IdMat.dat")
    ids[:, 5] = 0
    np.savetxt(svoboda_folder / "IdMat.dat", ids, fmt="%d")
    frames = read_svoboda(svoboda_folder).observations.frame
    assert 5 not in frames
    assert frames.max() == 39


def test_seen_but_nan_is_dropped_and_counted(svoboda_folder):
    def blind(uvw):
        uvw[1, :, 7:11] = np.nan

    set_points(svoboda_folder, blind)
    recording = read_svoboda(svoboda_folder)
    assert len(recording.observations) == 3 * 40 - 4
    assert recording.notes == ("camera 'C1': 4 of 40 spots are marked seen but have no finite coordinates; dropped",)


@pytest.mark.parametrize("mark", [0.0, -1.0])
def test_marks_of_missing_points_are_dropped_in_bulk_but_one_alone_is_a_spot(svoboda_folder, mark):
    def mark_missing(uvw):
        uvw[2, :2, :5] = mark
        uvw[0, :2, 9] = mark

    set_points(svoboda_folder, mark_missing)
    recording = read_svoboda(svoboda_folder)
    assert (recording.observations.camera == 2).sum() == 35
    assert (recording.observations.camera == 0).sum() == 40
    (note,) = recording.notes
    assert "'C2': 5 of 40 spots stand on exactly (0, 0) or (-1, -1)" in note


def test_one_spot_far_outside_is_dropped_but_many_are_refused(svoboda_folder):
    def one(uvw):
        uvw[0, 0, 3] = 1281.0

    def many(uvw):
        uvw[0, 0, :9] = 1281.0

    set_points(svoboda_folder, one)
    assert "1 of 40 spots lie more than one image size outside" in read_svoboda(svoboda_folder).notes[0]
    set_points(svoboda_folder, many)
    with pytest.raises(InputError, match=r"'C0': 9 of 40 spots lie more than one image size outside.*640 x 480"):
        read_svoboda(svoboda_folder)


def test_missing_res_is_an_error_and_never_640_by_480(svoboda_folder):
    (svoboda_folder / "Res.dat").unlink()
    with pytest.raises(InputError, match=r"Res\.dat is missing"):
        read_svoboda(svoboda_folder)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("points.dat", "", r"points\.dat holds no numbers"),
        ("points.dat", "1 2 3\n" * 8, r"points\.dat has 8 rows, expected 3 for each camera"),
        ("points.dat", "1 2 3\n" * 5 + "1 2\n" + "1 2 3\n" * 3, r"points\.dat, line 6: 2 numbers, expected 3"),
        ("points.dat", "1 2 x3\n" * 9, r"points\.dat, line 1, column 3: 'x3' is not a number"),
        ("points.dat", "1 2 1_0\n" * 9, r"points\.dat, line 1, column 3: '1_0' is not a number"),
        ("IdMat.dat", "1 0 1\n" * 3, r"IdMat\.dat is 3 x 3, expected 3 cameras x 40 frames"),
        ("IdMat.dat", ("2 " + "1 " * 39 + "\n") * 3, r"IdMat\.dat, row 1, column 1: 2, expected 0 or 1"),
        ("IdMat.dat", ("nan " + "1 " * 39 + "\n") * 3, r"IdMat\.dat, row 1, column 1: nan, expected 0 or 1"),
        ("Res.dat", "640 480\n", r"Res\.dat is 1 x 2, expected 3 rows"),
        ("Res.dat", "640 480\n640 0\n640 480\n", r"Res\.dat, row 2: image size 640 x 0"),
        ("Res.dat", "640 480\n640 1e300\n640 480\n", r"Res\.dat, row 2: image size 640 x 1e\+300"),
        ("Res.dat", "640 480\n640 nan\n640 480\n", r"Res\.dat, row 2: image size 640 x nan"),
        ("camera_order.txt", "a\nb\n", r"camera_order\.txt names 2 cameras, expected 3"),
        ("camera_order.txt", "a\nb\na\n", r"camera_order\.txt: camera name 'a' stands there twice"),
        ("original_cam_centers.dat", "1 2 3\n4 5 6\n", r"original_cam_centers\.dat is 2 x 3, expected 3 rows"),
        ("original_cam_centers.dat", "1 2 3\n4 5 6\n7 8 inf\n", r"all finite"),
        ("multicamselfcal.cfg", "[Calibration]\nNum-Cameras: 4\n", r"Num-Cameras is 4, but .* holds 3 cameras"),
        (
            "multicamselfcal.cfg",
            "[Calibration]\nNum-Cameras: many\n",
            r"'many', expected a whole number",
        ),
        ("multicamselfcal.cfg", "Num-Cameras: 4\n", r"no section headers"),
        ("basename1.rad", RAD, r"basenameN\.rad for N = 1; expected 1\.\.3"),
    ],
)
def test_faulty_file_is_refused_with_its_place(svoboda_folder, name, content, message):
    (svoboda_folder / name).write_text(content)
    with pytest.raises(InputError, match=message):
        read_svoboda(svoboda_folder)


@pytest.mark.parametrize("content", [b"\xff\xfe1 2 3", b"\x00" * 90, b"\x93NUMPY\x01\x00"])
def test_binary_points_are_refused(svoboda_folder, content):
    (svoboda_folder / "points.dat").write_bytes(content)
    with pytest.raises(InputError, match=r"points\.dat is not (UTF-8 )?text"):
        read_svoboda(svoboda_folder)


def test_truncated_points_are_refused(svoboda_folder):
    content = (svoboda_folder / "points.dat").read_text()
    (svoboda_folder / "points.dat").write_text(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"points\.dat"):
        read_svoboda(svoboda_folder)


def test_mistyped_configuration_key_is_told_by_name(svoboda_folder):
    (svoboda_folder / "multicamselfcal.cfg").write_text(
        "[Files]\nBasename: basename\n[Calibration]\nNum_Cameras: 3\nUndo-Radials: 1\n[Imags]\nSubpix: 0.5\n"
    )
    notes = read_svoboda(svoboda_folder).notes
    assert len(notes) == 2
    assert "[Calibration] Undo-Radials is unknown and has no effect; did you mean Undo-Radial?" in notes[0]
    assert "section [Imags] is unknown and has no effect; did you mean Images?" in notes[1]


def test_rad_files_become_priors_in_natural_order(svoboda_folder):
    for number in (1, 2, 3):
        (svoboda_folder / f"cam{number}.rad").write_text(RAD.replace("422.2", f"{400 + number}.0"))
    setups = read_svoboda(svoboda_folder).setups
    assert [setup.intrinsics[0] for setup in setups if setup.intrinsics is not None] == [401.0, 402.0, 403.0]
    assert all(setup.knowledge is Knowledge.INITIAL and setup.lens is LensModel.K1_K2_P1_P2 for setup in setups)
    assert np.array_equal(setups[0].nominal_intrinsics(), [401, 424.1, 330.1, 210.3, -0.28, 0.07, 0.0004, -0.0001])


def test_two_families_of_rad_files_need_a_basename(svoboda_folder):
    for number in (1, 2, 3):
        (svoboda_folder / f"cam{number}.rad").write_text(RAD)
        (svoboda_folder / f"old{number}.rad").write_text(RAD.replace("422.2", "500.0"))
    with pytest.raises(InputError, match=r"several families of \.rad files: cam\*\.rad, old\*\.rad"):
        read_svoboda(svoboda_folder)
    (svoboda_folder / "multicamselfcal.cfg").write_text("[Files]\nBasename: old\n")
    assert read_svoboda(svoboda_folder).setups[0].nominal_intrinsics()[0] == 500


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("K11 = 422.2", "K11 = -1", "expected focal lengths > 0"),
        ("K11 = 422.2", "K11 = inf", "line 1: K11 = inf is not finite"),
        ("K11 = 422.2", "K11 = x", "line 1: K11 = 'x' is not a number"),
        ("K11 = 422.2", "L11 = 1", "line 1: 'L11 = 1', expected K11"),
        ("K12 = 0.0", "K11 = 1", "line 2: K11 is given twice"),
        ("kc4 = -0.0001", "", "kc4 missing"),
        ("K31 = 0.0", "K31 = 1", "K is no camera matrix"),
    ],
)
def test_faulty_rad_file_is_refused(svoboda_folder, old, new, message):
    for number in (1, 2, 3):
        (svoboda_folder / f"cam{number}.rad").write_text(RAD)
    edit(svoboda_folder / "cam2.rad", old, new)
    with pytest.raises(InputError, match=rf"cam2\.rad.*{message}"):
        read_svoboda(svoboda_folder)


def test_skew_and_third_radial_term_are_left_out_and_told(svoboda_folder):
    for number in (1, 2, 3):
        (svoboda_folder / f"cam{number}.rad").write_text(RAD)
    edit(svoboda_folder / "cam1.rad", "K12 = 0.0", "K12 = 1.5")
    edit(svoboda_folder / "cam3.rad", "kc4 = -0.0001", "kc4 = -0.0001\nkc5 = 0.2")
    notes = read_svoboda(svoboda_folder).notes
    assert [note.split(":")[0] for note in notes] == ["cam1.rad", "cam3.rad"]


def test_source_that_is_no_recording_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds no points\.dat"):
        read_source(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        read_source(tmp_path / "nothing")
    (tmp_path / "video.mp4").write_bytes(b"")
    with pytest.raises(InputError, match="neither a MultiCamSelfCal folder nor"):
        read_source(tmp_path / "video.mp4")


@pytest.mark.parametrize(
    ("name", "n_cameras", "size_px", "n_rad", "n_centres"),
    [
        ("DATA20090709_111010", 3, (752, 480), 0, 0),
        ("DATA20100906_134124", 4, (752, 480), 0, 0),
        ("caldata20130726_122220", 4, (659, 494), 4, 4),
    ],
)
def test_real_recordings_read_as_numpy_reads_them(name, n_cameras, size_px, n_rad, n_centres):
    if not DATA.is_dir():
        pytest.skip("the real recordings in ../shared/data are absent")
    recording = read_source(DATA / name)
    seen = np.loadtxt(DATA / name / "IdMat.dat") > 0
    uvw = np.loadtxt(DATA / name / "points.dat").reshape(n_cameras, 3, -1)
    usable = seen & np.isfinite(uvw).all(axis=1)
    observations = recording.observations
    assert len(observations) == usable.sum()
    expected = uvw[observations.camera, :2, observations.frame] / uvw[observations.camera, 2:, observations.frame]
    assert np.array_equal(observations.px, expected)
    assert [setup.size_px for setup in recording.setups] == [size_px] * n_cameras
    assert sum(setup.intrinsics is not None for setup in recording.setups) == n_rad
    assert (0 if recording.known_centres is None else len(recording.known_centres.names)) == n_centres
    assert recording.notes == ()
