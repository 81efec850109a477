import re
import sys
from pathlib import Path

import numpy as np
import pytest

from network_calib.formats.calibration_json import load
from network_calib.synthetic import observe, room
from nodes import cli
from nodes.simulation.spots_simulation import write_simulation

GOLDEN = Path(__file__).parents[1] / "network_calib" / "formats" / "three_cameras.json"


@pytest.fixture
def golden():
    return GOLDEN


@pytest.fixture
def calibration():
    return load(GOLDEN)


@pytest.fixture(scope="session")
def smart_room(tmp_path_factory):
    """A short recording of the smart room on disk, with its truth: 0.2 px noise, 30 % missing, 10 % false."""
    rng = np.random.default_rng(11)
    built = room("smart_room", rng=rng, n_frames=500)
    sighting = observe(built, rng=rng, sigma_px=0.2, missing=0.3, false_detections=0.1)
    folder = tmp_path_factory.mktemp("smart_room")
    write_simulation(built, sighting, folder, noise_px=0.2, seed=11)
    return folder


@pytest.fixture
def spotcal(monkeypatch, capsys):
    """Run the command line; gives exit status, standard output and standard error without colours."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["spotcal", *map(str, arguments)])
        monkeypatch.setenv("COLUMNS", "100")
        status = 0
        try:
            cli.main()
        except SystemExit as exit_:
            status = exit_.code
        out, err = capsys.readouterr()
        return status, out, re.sub(r"\x1b\[[0-9;]*m", "", err)

    return run
