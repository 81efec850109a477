from dataclasses import replace

import numpy as np
import pytest

from network_calib.formats.calibration_json import load
from network_calib.synthetic import observe, room
from nodes.demo import compare_with_truth
from nodes.simulation.spots_simulation import truth_calibration


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """The demonstration, once."""
    import io

    from rich.console import Console

    from nodes.demo import run_demo

    out, file = tmp_path_factory.mktemp("demo"), io.StringIO()
    quiet = Console(file=io.StringIO(), quiet=True)
    is_as_predicted = run_demo(out, seed=0, console=Console(file=file, width=100), progress_console=quiet)
    return out, file.getvalue(), is_as_predicted


def test_demo_is_as_predicted_and_leaves_its_files(ran):
    out, text, is_as_predicted = ran
    assert is_as_predicted
    assert "Errors against the truth" in text
    names = {path.name for path in out.iterdir()}
    assert names == {"recording", "calibration.json", "aniposelib.toml", "network.png", "residuals.png", "errors.png"}


def test_demo_reaches_what_noise_allows(ran):
    calibration = load(ran[0] / "calibration.json")
    # 0.2 px per axis is drawn; some 700 observations per camera fix the estimate to 4 %, five times that is 20 %.
    for camera in calibration.cameras:
        assert camera.quality.noise_sigma_px == pytest.approx(0.2, rel=0.2)
    assert calibration.quality.fitted.mean_px < 0.25


def in_first_frame(built, sighting):
    truth = truth_calibration(built, sighting, noise_px=0.2, seed=0)
    to_world = truth.cameras[0].cam_from_world.inv()
    cameras = tuple(replace(c, cam_from_world=c.cam_from_world * to_world) for c in truth.cameras)
    return replace(truth, cameras=cameras)


def test_comparison_finds_no_error_in_the_truth_and_flags_a_wrong_focal_length():
    rng = np.random.default_rng(2)
    built = room("smart_room", rng=rng, n_frames=100)
    sighting = observe(built, rng=rng, sigma_px=0.2, missing=0.2, false_detections=0.1)
    truth = in_first_frame(built, sighting)
    comparison = compare_with_truth(truth, built, sighting)
    # Five metres in double precision, through a few products.
    assert comparison.errors.centre_m.max() < 1e-12
    assert comparison.is_as_predicted
    camera = truth.cameras[2]
    covariance = np.diag([0.0] * 6 + [0.3**2] + [0.0] * 7)
    wrong = replace(camera, intrinsics=camera.intrinsics + np.eye(8)[0] * 4.0, covariance=covariance)
    cameras = (*truth.cameras[:2], wrong, *truth.cameras[3:])
    comparison = compare_with_truth(replace(truth, cameras=cameras), built, sighting)
    # Half of 4 px (the mean of x and y) over 0.3 px.
    assert comparison.focal_in_sigma[2] == pytest.approx(2 / 0.3, rel=1e-9)
    assert not comparison.is_as_predicted
