from pathlib import Path

import numpy as np
import pytest

from network_calib.formats.calibration_json import load
from network_calib.formats.svoboda import write_svoboda_recording
from network_calib.observations import Observations

GOLDEN = Path(__file__).parent / "three_cameras.json"


@pytest.fixture
def golden():
    """A file of schema 1 as it must stay readable: a plain, a fisheye and a fixed camera with an awkward name."""
    return GOLDEN


@pytest.fixture
def calibration():
    return load(GOLDEN)


@pytest.fixture
def observations():
    """Three cameras, 40 frames with gaps, stamps and mixed sigma."""
    rng = np.random.default_rng(3)
    frame, camera = np.nonzero(rng.random((40, 3)) < 0.7)
    sigma = np.where(rng.random(len(frame)) < 0.5, rng.uniform(0.1, 0.3, len(frame)), np.nan)
    return Observations.from_columns(
        ("C0", "C1", "C2"),
        camera=camera,
        frame=frame,
        px=rng.uniform(0, 470, (len(frame), 2)),
        sigma_px=sigma,
        stamp_ns=10**18 + frame * 40_000_000 + rng.integers(-1_000_000, 1_000_000, len(frame)),
    )


@pytest.fixture
def svoboda_folder(tmp_path, observations):
    folder = tmp_path / "recording"
    write_svoboda_recording(observations, size_px=np.array([[640, 480]] * 3), folder=folder)
    return folder
