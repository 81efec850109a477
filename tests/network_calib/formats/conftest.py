from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.formats.calibration_json import load
from network_calib.formats.svoboda import write_svoboda_recording
from network_calib.observations import Observations
from network_calib.result import CalibratedLrf

GOLDEN = Path(__file__).parent / "three_cameras.json"


@pytest.fixture
def golden():
    """A file of schema 1 as it must stay readable: a plain, a fisheye and a fixed camera with an awkward name."""
    return GOLDEN


@pytest.fixture
def calibration():
    return load(GOLDEN)


@pytest.fixture
def lrf_calibration(calibration):
    """The same cameras with an LRF of arbitrary numbers."""
    rng = np.random.default_rng(6)
    root = rng.normal(size=(15, 15)) * 1e-3
    direction = np.array([0.0, 0.6, 0.8])
    lrf = CalibratedLrf(
        name="L0",
        world_from_lrf=RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng)),
        reference_tilt_rad=0.5,
        axis_direction_in_world=direction,
        axis_point_in_world=np.array([0.3, 0.8, -0.6]),
        instrument=np.array([1.001, 0.004, 0.999, 0.0, -0.012]),
        covariance=root @ root.T,
        dx_m=0.04,
        dz_m=0.06,
        mount_roll_rad=0.01,
        mount_yaw_rad=-0.02,
        paper_sigma=rng.uniform(1e-4, 1e-3, 4),
        tilt_rad=np.array([0.2, 0.4, 0.9]),
        tilt_sigma_rad=np.array([0.0, 3e-4, 3e-4]),
        n_sightings=66,
        n_inliers=60,
        range_rms_m=0.004,
        bearing_rms_rad=0.0017,
        out_of_plane_rms_m=np.nan,
        held=("bearing_zero_rad", "tilt_angles"),
    )
    return replace(calibration, world=replace(calibration.world, unit="m"), lrfs=(lrf,))


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
