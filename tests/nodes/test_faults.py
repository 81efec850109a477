"""Programs of a session are killed in random order and repeatedly: nothing journalled is lost or doubled."""

import subprocess
from collections import Counter

import pytest

from tests.nodes.fault_runs import Kills, run_disturbed, run_undisturbed
from tests.nodes.fault_site import COORDINATOR, ROUTER, SPOTCAL, Size, journalled, numbers_of, recorded

SIZE = Size(n_cameras=3, rate_hz=10.0, wave_s=8.0)
KILLS = Kills(n_waving=5, n_solving=1, pause_s=1.2)


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory):
    return run_disturbed(tmp_path_factory.mktemp("disturbed"), SIZE, KILLS, seed=1)


def test_what_nodes_journalled_stands_in_the_recording_once(disturbed):
    site, killer = disturbed
    assert {name for _, name in killer.done} == {COORDINATOR, ROUTER, *site.cameras}
    written, found = journalled(site), recorded(site)
    # At most two frames a row, and all of the wave.
    assert len(written) >= SIZE.n_cameras * SIZE.rate_hz * SIZE.wave_s / 2
    assert written - found == found - written == Counter()
    assert max(found.values()) == 1


def test_the_calibration_is_that_of_the_undisturbed_session(disturbed, tmp_path):
    site, _ = disturbed
    undisturbed = run_undisturbed(tmp_path, site)
    assert numbers_of(site.session.calibration) == numbers_of(undisturbed.session.calibration)


def test_the_recording_calibrates_to_the_same_file_elsewhere(disturbed, tmp_path):
    site, _ = disturbed
    out = tmp_path / "again.json"
    command = [*SPOTCAL, "calibrate", str(site.session.path / "session.mcap"), "--out", str(out), "--quiet"]
    subprocess.run(command, check=True, timeout=100)
    assert numbers_of(out) == numbers_of(site.session.calibration)
