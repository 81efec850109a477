import json
import subprocess
import sys

import numpy as np
import pytest

from network_calib.formats.aniposelib import read_aniposelib
from network_calib.formats.calibration_json import load
from network_calib.formats.source import read_source
from network_calib.formats.table import write_csv
from nodes import cli

COMMANDS = (
    "detect", "calibrate", "show", "evaluate", "export", "spot", "cameras", "simulate", "demo", "paper",
)  # fmt: skip
HEAVY = ("av", "cv2", "pycolmap", "scipy.optimize", "matplotlib", "zenoh", "numpy")


@pytest.mark.parametrize("command", [(), *((name,) for name in COMMANDS)])
def test_help_imports_nothing_heavy(command):
    code = (
        "import sys\nfrom nodes import cli\n"
        f"sys.argv = ['spotcal', *{command!r}, '--help']\n"
        "try:\n    cli.main()\nexcept SystemExit as e:\n    assert not e.code\n"
        f"print('HEAVY', [name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Usage" in done.stdout
    assert done.stdout.splitlines()[-1] == "HEAVY []"


@pytest.fixture(scope="session")
def calibrated(smart_room, tmp_path_factory):
    """The smart room, calibrated through the command line in a process of its own."""
    path = tmp_path_factory.mktemp("out") / "calibration.json"
    arguments = ["calibrate", smart_room, "--config", smart_room / "room.toml", "--out", path, "--seed", "5"]
    code = f"import sys\nfrom nodes import cli\nsys.argv = ['spotcal', *{[str(a) for a in arguments]!r}]\ncli.main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return path, done


def test_calibrate_writes_the_result_and_prints_it(calibrated):
    path, done = calibrated
    calibration = load(path)
    assert [camera.name for camera in calibration.cameras] == ["C0", "C1", "C2", "C3", "C4"]
    assert calibration.provenance.seed == 5
    assert calibration.world.unit == "m"
    baseline = np.linalg.norm(calibration.cameras[1].centre_in_world - calibration.cameras[0].centre_in_world)
    # The baseline is the scale: held to rounding.
    assert f"{baseline:.6g}" in calibration.world.scale_source
    assert "Reprojection error, px" in done.stdout
    assert "Written to" in done.stderr


def test_same_seed_gives_the_same_file_but_for_the_time(calibrated, smart_room, spotcal, tmp_path):
    path, _ = calibrated
    again = tmp_path / "again.json"
    status, out, err = spotcal(
        "calibrate", smart_room, "--config", smart_room / "room.toml", "--out", again, "--seed", 5, "--quiet"
    )
    assert (status, out, err) == (0, "", "")
    documents = [json.loads(p.read_text()) for p in (path, again)]
    for document in documents:
        del document["provenance"]["created_utc"]
    assert documents[0] == documents[1]


def test_show_prints_every_camera(calibrated, spotcal):
    status, out, _ = spotcal("show", calibrated[0])
    assert status == 0
    for name in ("C0", "C4", "baseline C0-C1", "hold-out"):
        assert name in out


def test_evaluate_gives_the_noise_of_the_recording(calibrated, smart_room, spotcal):
    status, out, _ = spotcal("evaluate", calibrated[0], smart_room)
    assert status == 0
    row = next(line for line in out.splitlines() if line.strip().startswith("all"))
    median_px = float(row.split()[-2])
    # 0.2 px per axis: a Rayleigh median of 0.235, less what triangulation absorbs (3 of about 6 numbers for a spot
    # seen by three cameras): between half of it and all of it.
    assert 0.12 < median_px < 0.25


def test_truth_evaluates_too(smart_room, spotcal):
    status, out, _ = spotcal("evaluate", smart_room / "truth.json", smart_room / "table.npz")
    assert status == 0
    assert "Reprojection of new data" in out


def test_table_source_calibrates_with_sizes_from_the_configuration(smart_room, spotcal, tmp_path):
    write_csv(read_source(smart_room).observations, tmp_path / "spots.csv")
    status, _, err = spotcal("calibrate", tmp_path / "spots.csv", "--out", tmp_path / "c.json")
    assert status == 2
    assert "the image size of 5 cameras is not known" in err
    status, _, err = spotcal(
        "calibrate", tmp_path / "spots.csv", "--config", smart_room / "room.toml", "--out", tmp_path / "c.json"
    )
    assert status == 0, err
    assert load(tmp_path / "c.json").provenance.input_name == "spots.csv"


def test_table_source_calibrates_with_the_configuration_beside_it(smart_room, spotcal, tmp_path):
    write_csv(read_source(smart_room).observations, tmp_path / "spots.csv")
    (tmp_path / "spots.toml").write_text((smart_room / "room.toml").read_text())
    status, _, err = spotcal("calibrate", tmp_path / "spots.csv", "--out", tmp_path / "c.json")
    assert status == 0, err
    assert f"note: cameras as described in {tmp_path / 'spots.toml'}" in err
    assert load(tmp_path / "c.json").world.unit == "m"
    # One that is named goes before it.
    (tmp_path / "other.toml").write_text('[[cameras]]\nname = "C9"\n')
    status, _, err = spotcal("calibrate", tmp_path / "spots.csv", "--config", tmp_path / "other.toml")
    assert (status, "C9" in err) == (2, True)


@pytest.mark.parametrize(
    ("format_name", "out", "expected"),
    [
        ("svoboda", "folder", ["basename1.rad", "camera5.Pmat.cal", "camera_order.txt"]),
        ("aniposelib", "c.toml", []),
        ("opencv", "c.yml", []),
    ],
)
def test_export_writes_the_layout(smart_room, spotcal, tmp_path, format_name, out, expected):
    status, _, err = spotcal("export", smart_room / "truth.json", "--format", format_name, "--out", tmp_path / out)
    assert (status, err) == (0, f"Written to {tmp_path / out}\n")
    assert all((tmp_path / out / name).is_file() for name in expected)
    if format_name == "aniposelib":
        truth = load(smart_room / "truth.json").as_cameras()
        np.testing.assert_allclose(read_aniposelib(tmp_path / out).centres_in_world, truth.centres_in_world, atol=1e-12)


def test_simulate_is_reproducible_and_obeys_its_options(spotcal, tmp_path):
    for name in ("a", "b"):
        status, _, err = spotcal(
            "simulate", "ring_room", "--out", tmp_path / name, "--frames", 60, "--seed", 3, "--missing", 0, "--false", 0
        )
        assert status == 0, err
    for name in ("points.dat", "IdMat.dat", "room.toml", "truth.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert read_source(tmp_path / "a").observations.frame.max() < 60
    # The table holds the stamps as well, and so has the digest of all that was simulated.
    assert (
        read_source(tmp_path / "a" / "table.npz").sha256 == load(tmp_path / "a" / "truth.json").provenance.input_sha256
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("calibrate", "nowhere"), "error: nowhere: no such file or folder"),
        (("calibrate", "nowhere", "--out", "."), "is a folder, expected a file name"),
        (("calibrate", "nowhere", "--out", "/dev/null/c.json"), "cannot be written"),
        (("calibrate", "nowhere", "--config", "no.toml"), "error: no.toml: no such file"),
        (("detect", "a.mp4", "--out", "t.csv"), "one source is one camera (a), a network needs two or more"),
        (("detect", "a.mp4", "b.mp4", "--out", "t.csv"), "error: a.mp4 does not exist"),
        (("detect", "a.mp4", "rtsp://me:secret@host/2", "--out", "t.csv"), "@host/2 is no recording"),
        (("detect", "a.mp4", "b.mp4", "--out", "t.txt"), "--out t.txt: expected a name that ends in .csv or .npz"),
        (("detect", "a.mp4", "b.mp4", "--out", "t.csv", "--channel", "purple"), "--channel purple: expected one of"),
        (("detect", "a.mp4", "b.mp4", "--out", "t.csv", "--background", "no"), "--background no: expected whole, or"),
        (("detect", "A=a.mp4", "A=b.mp4", "--out", "t.csv"), "two sources would be camera 'A'"),
        (("spot", "nothing.mp4"), "nothing.mp4"),
        (("spot", "/dev/video99"), "/dev/video99"),
        (("spot", "/dev/video0", "--background", "whole"), "/dev/video0 is no recording"),
        (("show", "nothing.json"), "error: nothing.json: no such file"),
        (("show", "."), "is not a file"),
        (("simulate", "ballroom"), "no room 'ballroom', expected one of"),
        (("export", "GOLDEN", "--format", "matlab", "--out", "x"), "--format matlab: expected one of svoboda"),
        (("export", "GOLDEN", "--format", "svoboda", "--out", "x"), "no fisheye lens"),
        (("evaluate", "GOLDEN", "SMART_ROOM"), "C3"),
        (("calibrate", "SMART_ROOM", "--fix-intrinsics"), "neither the recording nor room.toml gives intrinsics"),
        (("calibrate", "SMART_ROOM", "--start", "middle"), "--start middle: expected one of auto"),
    ],
)
def test_user_error_is_one_message_and_status_2(spotcal, golden, smart_room, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    places = {"GOLDEN": golden, "SMART_ROOM": smart_room}
    status, out, err = spotcal(*(places.get(argument, argument) for argument in arguments))
    assert status == 2
    assert message in err
    assert "Traceback" not in err + out
    assert list(tmp_path.iterdir()) == []


def test_system_error_is_one_message_and_status_2(spotcal, golden, tmp_path):
    (tmp_path / "file").write_text("")
    status, _, err = spotcal("export", golden, "--format", "aniposelib", "--out", tmp_path / "file" / "c.toml")
    assert status == 2
    assert err.startswith("error: ")
    assert "file" in err


def test_message_with_brackets_is_printed_as_it_is(spotcal, tmp_path):
    status, _, err = spotcal("show", tmp_path / "[bold]x.json")
    assert status == 2
    assert "[bold]x.json" in err


def test_interrupt_writes_nothing_and_exits_130(spotcal, smart_room, tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("nodes.solve.calibrate", interrupt)
    status, _, _ = spotcal("calibrate", smart_room, "--out", tmp_path / "c.json")
    assert status == cli.EXIT_INTERRUPTED
    assert list(tmp_path.iterdir()) == []
