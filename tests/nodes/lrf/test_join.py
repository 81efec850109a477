"""Crossings of acquisitions joined to a session of cameras, by the command and on to the calibration."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from network_calib.formats.calibration_json import load
from network_calib.formats.table import read_npz, write_npz
from nodes.lrf.session import read_lrf_session
from nodes.simulation.lrf_simulation import simulate_lrf_room

PERIOD_NS = 40_000_000
BEGIN_NS = 1_700_000_000 * 10**9
HEADER = ("lrf", "stamp_ns", "setting", "range_m", "bearing_rad", "sigma_range_m", "sigma_bearing_rad")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A simulated session whose lrf.csv is the answer."""
    folder = tmp_path_factory.mktemp("simulated")
    simulate_lrf_room("lrf_room_given", folder, seed=5, n_frames=200, noise_px=0.2, missing=0.0, false=0.0)
    return folder


@pytest.fixture
def session(simulated, tmp_path):
    """Cameras alone, with stamps."""
    return cameras(simulated, tmp_path / "session")


def cameras(simulated, folder, *, late_ns=0):
    folder.mkdir()
    seen = read_npz(simulated / "table.npz").observations
    write_npz(replace(seen, stamp_ns=BEGIN_NS + late_ns + PERIOD_NS * seen.frame), folder / "table.npz")
    (folder / "room.toml").write_bytes((simulated / "room.toml").read_bytes())
    return folder


def acquisition(simulated, folder, *, name="L0", rows=slice(None), delay_ns=7_000_000):
    """The crossings of the simulated session as an LRF node would write them, a little after their frames."""
    folder.mkdir()
    spots = read_lrf_session(simulated).spots
    columns = [getattr(spots, column) for column in (*HEADER[3:], "sigma_out_of_plane_m")]
    with (folder / "crossings.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow((*HEADER, "sigma_out_of_plane_m"))
        stamp_ns = BEGIN_NS + delay_ns + PERIOD_NS * spots.frame
        table = list(zip(stamp_ns.tolist(), spots.setting.tolist(), *(c.tolist() for c in columns), strict=True))
        writer.writerows([(name, *row) for row in table[rows]])
    text = (simulated / "tilts.csv").read_text(encoding="utf-8")
    (folder / "tilts.csv").write_text(text.replace("L0", name), encoding="utf-8")
    return folder


def test_joined_session_is_the_simulated_one(simulated, session, tmp_path, spotcal):
    status, _, said = spotcal("lrf", "join", acquisition(simulated, tmp_path / "lrf"), "--session", session)
    assert status == 0, said
    assert said.count("22 of 22 crossings") == 3
    expected, found = read_lrf_session(simulated), read_lrf_session(session)
    np.testing.assert_array_equal(found.spots.frame, expected.spots.frame)
    np.testing.assert_array_equal(found.spots.setting, expected.spots.setting)
    np.testing.assert_array_equal(found.spots.range_m, expected.spots.range_m)
    # A float of today's seconds holds 0.2 us.
    np.testing.assert_allclose(found.spots.delay_s, 7e-3, atol=1e-6)
    np.testing.assert_allclose(found.settings.angle_rad, expected.settings.angle_rad)
    np.testing.assert_allclose(found.settings.covariance_rad2, expected.settings.covariance_rad2)


def test_joined_session_calibrates_to_the_truth(simulated, session, tmp_path, spotcal):
    # Every spot is drawn anew here, so that nothing tells how it moved: no delay.
    folder = acquisition(simulated, tmp_path / "lrf", delay_ns=0)
    assert spotcal("lrf", "join", folder, "--session", session)[0] == 0
    out = tmp_path / "out.json"
    status, _, said = spotcal("calibrate", session, "--config", session / "room.toml", "--out", out, "--quiet")
    assert status == 0, said
    (lrf,), (true,) = load(out).lrfs, load(simulated / "truth.json").lrfs
    names = ("dx_m", "dz_m", "mount_roll_rad", "mount_yaw_rad")
    error = np.array([getattr(lrf, name) - getattr(true, name) for name in names])
    # Five sigma in each of four numbers: chance once in 10^6.
    assert (np.abs(error) < 5 * lrf.paper_sigma).all()
    assert lrf.n_inliers > 60


def test_two_lrfs_are_joined_together(simulated, session, tmp_path, spotcal):
    folders = [acquisition(simulated, tmp_path / name, name=name) for name in ("L1", "L2")]
    status, _, said = spotcal("lrf", "join", *folders, "--session", session)
    assert status == 0, said
    found = read_lrf_session(session)
    assert found.names == ("L1", "L2")
    assert np.bincount(found.spots.setting).tolist() == [22] * 6
    assert found.settings.scanner.tolist() == [0, 0, 0, 1, 1, 1]


def refused(spotcal, session, *folders):
    status, _, said = spotcal("lrf", "join", *folders, "--session", session)
    assert status == 2
    return " ".join(said.split())


def test_what_is_there_is_not_overwritten(simulated, session, tmp_path, spotcal):
    folder = acquisition(simulated, tmp_path / "lrf")
    assert spotcal("lrf", "join", folder, "--session", session)[0] == 0
    before = (session / "lrf.csv").read_bytes()
    assert "holds lrf.csv already" in refused(spotcal, session, folder)
    assert (session / "lrf.csv").read_bytes() == before


def test_no_common_time_is_said_with_both_times_and_files(simulated, tmp_path, spotcal):
    session = cameras(simulated, tmp_path / "session", late_ns=3600 * 10**9)
    folder = acquisition(simulated, tmp_path / "lrf")
    said = refused(spotcal, session, folder)
    assert f"no common time: the crossings of {folder} are from 2023-11-14 22:13:" in said
    assert f"of {session} see the spot from 2023-11-14 23:13:20" in said
    assert not (session / "lrf.csv").exists()


def test_too_few_matches_are_said_by_tilt(simulated, session, tmp_path, spotcal):
    # 22 crossings at each tilt, one tilt after the other: five are left at the last.
    said = refused(spotcal, session, acquisition(simulated, tmp_path / "lrf", rows=slice(49)))
    assert "L0 at 50.0 deg 5 of 5; 6 or more are needed at each tilt" in said


def test_a_table_without_stamps_is_refused(simulated, tmp_path, spotcal):
    session = tmp_path / "session"
    session.mkdir()
    write_npz(replace(read_npz(simulated / "table.npz").observations, stamp_ns=None), session / "table.npz")
    said = refused(spotcal, session, acquisition(simulated, tmp_path / "lrf"))
    assert "no column stamp_ns" in said


def test_an_acquisition_that_was_cut_off_is_named(session, tmp_path, spotcal):
    folder = tmp_path / "cut"
    folder.mkdir()
    said = refused(spotcal, session, folder)
    assert f"{folder} holds no crossings.csv" in said


def test_a_wrong_value_is_named_by_file_and_line(simulated, session, tmp_path, spotcal):
    folder = acquisition(simulated, tmp_path / "lrf")
    lines = (folder / "crossings.csv").read_text(encoding="utf-8").splitlines()
    lines[3] = lines[3].replace("L0", "L9")
    (folder / "crossings.csv").write_text("\n".join(lines), encoding="utf-8")
    assert "crossings.csv, line 4, column lrf: 'L9'" in refused(spotcal, session, folder)


def test_one_name_for_two_lrfs_is_refused(simulated, session, tmp_path, spotcal):
    folders = [acquisition(simulated, tmp_path / name) for name in ("a", "b")]
    assert "each once" in refused(spotcal, session, *folders)
