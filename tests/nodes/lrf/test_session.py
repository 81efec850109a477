"""Tables of LRF sightings and tilts: read back, refused with their place, and calibrated from the command line."""

from dataclasses import replace

import numpy as np
import pytest

from lrf_stereo.lrf_priors import InstrumentSigma
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.session import LrfSession
from network_calib.errors import InputError
from network_calib.formats.calibration_json import load, save
from network_calib.formats.source import read_source
from network_calib.formats.table import write_csv
from network_calib.observations import Observations
from nodes.config import load_room
from nodes.lrf.session import instrument_of, joint_digest, read_lrf_session, read_lrfs_beside, write_lrf_session

SPOTS = """\
lrf,frame,setting,range_m,bearing_rad,sigma_range_m,sigma_bearing_rad,sigma_out_of_plane_m
L1,10,4,2.5,0.25,0.003,0.002,0.004
L0,11,0,1.5,-0.25,0.003,0.002,0.004
L1,12,9,3.5,0.0,0.003,0.002,0.004
"""
TILTS = """\
lrf,setting,angle_deg,sigma_deg
L1,4,12.0,0.015
L1,9,50,0
L0,0,20.0,0.015
"""
OPTIONAL = ("out_of_plane_m", "bias_bound_m", "delay_s")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "lrf.csv").write_text(SPOTS)
    (tmp_path / "tilts.csv").write_text(TILTS)
    return tmp_path


def test_settings_are_numbered_in_the_order_of_the_tilt_table(folder):
    session = read_lrf_session(folder)
    assert session.names == ("L1", "L0")
    assert session.settings.scanner.tolist() == [0, 0, 1]
    assert session.spots.setting.tolist() == [0, 2, 1]
    np.testing.assert_allclose(np.degrees(session.settings.angle_rad), [12, 50, 20], rtol=1e-15)
    np.testing.assert_allclose(
        session.settings.covariance_rad2, np.diag(np.radians([0.015, 0, 0.015]) ** 2), rtol=1e-15
    )
    for name in OPTIONAL:
        assert getattr(session.spots, name).tolist() == [0, 0, 0], name
    assert session.instrument == (InstrumentSigma(), InstrumentSigma())


def test_written_session_reads_back(tmp_path):
    rng = np.random.default_rng(2)
    settings = TiltSettings(np.array([0, 1, 0, 1]), rng.uniform(-1, 1, 4), np.diag(rng.uniform(1e-8, 1e-6, 4)))
    columns = rng.uniform(0.01, 0.9, (8, 20))
    spots = LrfSpots(np.arange(20), rng.integers(0, 4, 20), *columns)
    session = LrfSession(("a", "b"), spots, settings)
    write_lrf_session(session, tmp_path)
    again = read_lrf_session(tmp_path)
    for name in LrfSpots.__slots__:
        assert np.array_equal(getattr(again.spots, name), getattr(spots, name)), name
    # Degrees and back: two roundings.
    np.testing.assert_allclose(again.settings.angle_rad, settings.angle_rad, rtol=4e-16)
    np.testing.assert_allclose(again.settings.covariance_rad2, settings.covariance_rad2, rtol=2e-15)
    assert again.settings.scanner.tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("lrf.csv", "L0,11", "L7,11", r"lrf\.csv, line 3, column lrf: 'L7', expected an LRF of tilts\.csv: L1, L0"),
        ("lrf.csv", "11,0,", "11,1,", r"line 3, column setting: '1', expected a setting of this LRF in tilts\.csv"),
        ("lrf.csv", "L0,11", "L0,-1", r"line 3, column frame: '-1', expected 0 or more"),
        ("lrf.csv", "L0,11", "L0,1.5", r"line 3, column frame: '1\.5', expected a whole number"),
        ("lrf.csv", "1.5,", "near,", r"line 3, column range_m: 'near', expected a number"),
        ("lrf.csv", "1.5,", "0,", r"line 3, column range_m: '0', expected a number > 0"),
        ("lrf.csv", "1.5,", "1500,", r"line 3, column range_m: '1500', expected a number > 0, at most 1000"),
        ("lrf.csv", "1.5,", "nan,", r"line 3, column range_m: 'nan', expected a number > 0"),
        ("lrf.csv", "-0.25", "-25", r"line 3, column bearing_rad: '-25', expected a number of radians"),
        ("lrf.csv", "0.0,0.003", "0.0,0", r"line 4, column sigma_range_m: '0', expected a number > 0"),
        ("lrf.csv", "range_m,b", "range,b", r"line 1: columns range_m missing"),
        ("lrf.csv", "12,9", "10,4", r"'L1' has two sightings in frame 10"),
        ("tilts.csv", "L1,9", "L1,4", r"tilts\.csv, line 3, column setting: 4 of 'L1' stands in line 2 already"),
        ("tilts.csv", "50,0\n", "50,-1\n", r"line 3, column sigma_deg: '-1', expected a number from 0 to 90"),
        ("tilts.csv", "50,0\n", "500,0\n", r"line 3, column angle_deg: '500', expected a number within a turn"),
        ("tilts.csv", "L0,0", ",0", r"line 4, column lrf: empty, expected a name"),
        ("tilts.csv", "sigma_deg", "sigma", r"line 1: columns sigma_deg missing"),
    ],
)
def test_fault_is_refused_with_its_place(folder, file, old, new, message):
    text = (folder / file).read_text()
    assert text.count(old) >= 1
    (folder / file).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_lrf_session(folder)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("bias_bound_m", "-0.001", r"line 2, column bias_bound_m: '-0\.001', expected a number from 0 to 1"),
        ("bias_bound_m", "25", r"column bias_bound_m: '25', expected a number from 0 to 1"),
        ("bias_bound_m", "", r"column bias_bound_m: '', expected a number"),
        ("delay_s", "-1.5", r"column delay_s: '-1\.5', expected a number of seconds within \+-1"),
        ("delay_s", "inf", r"column delay_s: 'inf', expected a number of seconds within \+-1"),
        ("out_of_plane_m", "nan", r"column out_of_plane_m: 'nan', expected a number within"),
    ],
)
def test_fault_in_an_optional_column_is_refused_with_its_place(folder, column, value, message):
    head, *rows = SPOTS.splitlines()
    lines = [f"{head},{column}", *(f"{row},{value}" for row in rows)]
    (folder / "lrf.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=message):
        read_lrf_session(folder)


def test_optional_columns_at_their_limits_are_read(folder):
    head, *rows = SPOTS.splitlines()
    lines = [f"{head},delay_s,bias_bound_m", f"{rows[0]},-1,0", f"{rows[1]},1,1", f"{rows[2]},0.071,0.025"]
    (folder / "lrf.csv").write_text("\n".join(lines) + "\n")
    spots = read_lrf_session(folder).spots
    assert spots.delay_s.tolist() == [-1, 1, 0.071]
    assert spots.bias_bound_m.tolist() == [0, 1, 0.025]


def test_optional_columns_are_written_where_they_say_anything(folder, tmp_path):
    write_lrf_session(read_lrf_session(folder), tmp_path)
    assert not set(OPTIONAL) & set((tmp_path / "lrf.csv").read_text().splitlines()[0].split(","))


def test_missing_tilt_table_is_refused(folder):
    (folder / "tilts.csv").unlink()
    with pytest.raises(InputError, match=r"tilts\.csv: no such file"):
        read_lrf_session(folder)


def test_digest_tells_sessions_apart(folder):
    session = read_lrf_session(folder)
    moved = replace(session, spots=replace(session.spots, range_m=session.spots.range_m + 1e-12))
    digests = {joint_digest("a", session), joint_digest("b", session), joint_digest("a", moved)}
    assert len(digests) == 3
    assert joint_digest("a", session) == joint_digest("a", read_lrf_session(folder))


def config_of(tmp_path, text):
    (tmp_path / "room.toml").write_text(text)
    return load_room(tmp_path / "room.toml")


def test_configuration_frees_the_instrument(tmp_path):
    config = config_of(
        tmp_path,
        '[[lrfs]]\nname = "L1"\nsigma = { tilt_gain = 0.01, range_bias_m = 0.02, bearing_zero_deg = 1.0, '
        "clock_offset_ms = 50.0 }\n",
    )
    sigma = instrument_of(config, ("L0", "L1"))
    assert sigma == (InstrumentSigma(), InstrumentSigma(0.01, 0.02, 0.0, float(np.radians(1.0)), 0.05))


def test_configuration_of_another_lrf_is_refused(tmp_path):
    config = config_of(tmp_path, '[[lrfs]]\nname = "lft"\n')
    with pytest.raises(InputError, match=r"the session has no LRF 'lft' \(did you mean 'left'\?\); it has left, right"):
        instrument_of(config, ("left", "right"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[lrfs]]\nname = "L0"\n[[lrfs]]\nname = "L0"\n', "names of LRFs given twice: L0"),
        ('[[lrfs]]\nname = "L0"\nsigma = { tilt_gain = -1.0 }\n', r"lrfs\[0\]\.sigma\.tilt_gain: -1\.0"),
        ('[[lrfs]]\nname = "L0"\nsigma = { tiltgain = 1.0 }\n', r"unknown key \(did you mean 'tilt_gain'\?\)"),
        ('[[lrfs]]\nnames = "L0"\n', r"unknown key \(did you mean 'name'\?\)"),
    ],
)
def test_mistyped_configuration_is_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        config_of(tmp_path, text)


def test_stamps_without_frame_numbers_cannot_meet_the_lrf(folder):
    stamps = np.arange(4) * 10**8
    observations = Observations.from_columns(
        ("C0", "C1"), camera=[0, 1, 0, 1], frame=[0, 0, 1, 1], px=np.ones((4, 2)), stamp_ns=np.repeat(stamps[:2], 2)
    )
    write_csv(observations, folder / "table.csv")
    assert read_lrfs_beside(folder, read_source(folder), None) is not None
    text = (folder / "table.csv").read_text().splitlines()
    (folder / "table.csv").write_text("\n".join(",".join(np.delete(line.split(","), 1)) for line in text) + "\n")
    with pytest.raises(InputError, match="stamps and no frame numbers"):
        read_lrfs_beside(folder, read_source(folder), None)


@pytest.fixture(scope="module")
def lrf_room(tmp_path_factory):
    from nodes.simulation.simulate import simulate_named

    folder = tmp_path_factory.mktemp("lrf_room")
    simulate_named("lrf_room", folder, seed=3, n_frames=None, noise_px=0.2, missing=0.1, false=0.05)
    return folder


@pytest.fixture
def calibrated(lrf_room, tmp_path, spotcal):
    out = tmp_path / "calibration.json"
    status, _, err = spotcal("calibrate", lrf_room, "--config", lrf_room / "room.toml", "--out", out)
    assert status == 0, err
    return out


def test_session_calibrates_from_the_command_line_to_the_truth(calibrated, lrf_room, spotcal, tmp_path):
    (found,), (true,) = load(calibrated).lrfs, load(lrf_room / "truth.json").lrfs
    # Five sigma in each of four numbers: chance once in 10^6.
    error = np.array(
        [getattr(found, k) - getattr(true, k) for k in ("dx_m", "dz_m", "mount_roll_rad", "mount_yaw_rad")]
    )
    assert (np.abs(error) < 5 * found.paper_sigma).all()
    # Two turns of the axis, each with its sigma.
    turned = np.linalg.norm(found.axis_direction_in_world - true.axis_direction_in_world)
    assert turned < 5 * np.linalg.norm(found.sigma[6:8])
    status, out, _ = spotcal("show", calibrated)
    assert status == 0
    for words in (
        "Laser range finders",
        "Tilt axes",
        "Mirror beside its tilt axis",
        "Tilt settings",
        "Sightings",
        "L0:",
    ):
        assert words in out
    assert "1 fixed" in out
    save(load(calibrated), tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == calibrated.read_bytes()

    # With the cameras held, as calibrated with the LRF, the same sightings say the same within a sigma.
    held = tmp_path / "held.json"
    status, _, err = spotcal("calibrate", lrf_room, "--cameras", calibrated, "--out", held, "--quiet")
    assert (status, err) == (0, "")
    again = load(held)
    for before, after in zip(load(calibrated).cameras, again.cameras, strict=True):
        assert np.array_equal(before.covariance, after.covariance)
    assert again.lrfs[0].held[-1] == "cameras"
    assert abs(again.lrfs[0].dx_m - found.dx_m) < found.paper_sigma[0]
    assert again.provenance.input_name == f"{lrf_room.name}; LRFs: {lrf_room.name}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--cameras", "truth.json", "--start", "anchor"), "--start: of no use with --cameras"),
        (("--cameras", "none.json"), "none.json: no such file"),
    ],
)
def test_options_that_contradict_cameras_are_refused(lrf_room, spotcal, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "truth.json").write_bytes((lrf_room / "truth.json").read_bytes())
    status, _, err = spotcal("calibrate", lrf_room, *arguments)
    assert status == 2
    assert message in err


def test_cameras_without_lrf_data_are_refused(smart_room, spotcal, tmp_path):
    status, _, err = spotcal(
        "calibrate", smart_room, "--cameras", smart_room / "truth.json", "--out", tmp_path / "c.json"
    )
    assert status == 2
    assert "holds no lrf.csv" in err


@pytest.mark.parametrize("name", ["paper_setup", "lrf_room_given"])
def test_every_named_session_calibrates(name, spotcal, tmp_path):
    status, _, err = spotcal("simulate", name, "--out", tmp_path / name, "--missing", 0.1, "--false", 0)
    assert status == 0, err
    room, out = tmp_path / name / "room.toml", tmp_path / "c.json"
    status, _, err = spotcal("calibrate", tmp_path / name, "--config", room, "--out", out, "--quiet")
    assert (status, err) == (0, "")
    (found,), (true,) = load(out).lrfs, load(tmp_path / name / "truth.json").lrfs
    assert abs(found.dz_m - true.dz_m) < 5 * found.paper_sigma[1]
