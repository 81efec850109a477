import json
import re
from dataclasses import replace

import numpy as np
import pytest

from network_calib.result import Doubt
from network_calib.spots import SpotViews
from nodes.report.report_figures import overlap_figure, residual_figure, shared_instants
from nodes.report.session_report import session_report, verdict, write_session_report
from tests.network_calib.scenes import calibrated, waved


@pytest.fixture(scope="module")
def calibration_and_observations():
    _, calibration = calibrated("smart_room", n_frames=400)
    _, seen = waved("smart_room", n_frames=400, missing=0.3, false_detections=0.1)
    return calibration, seen.observations


def figures(html):
    text = html[html.rindex("const figures = ") + len("const figures = ") : html.rindex("const dark")]
    return json.loads(text.strip().removesuffix(";"))


def test_report_draws_every_camera_and_names_what_it_comes_from(calibration_and_observations):
    calibration, observations = calibration_and_observations
    html = session_report(calibration, observations, notes=["frames are matched by their stamps"])
    drawn = figures(html)
    n = len(calibration.cameras)
    assert {f"residual-{k}" for k in range(n)} | {f"coverage-{k}" for k in range(n)} <= set(drawn)
    for camera in calibration.cameras:
        assert f"<td>{camera.name}</td>" in html
    assert calibration.provenance.input_sha256 in html
    assert "frames are matched by their stamps" in html


def test_report_needs_nothing_from_outside_and_stays_small(calibration_and_observations):
    html = session_report(*calibration_and_observations)
    page = re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
    assert not re.search(r"(src|href)\s*=", page)
    assert "default-src 'none'" in page
    assert len(html.encode()) < 8e6


def test_warnings_stand_before_all_figures(calibration_and_observations):
    calibration, observations = calibration_and_observations
    doubted = replace(calibration, warnings=(Doubt("clock offset", "C1 lags by 12 ms", "Synchronise it."),))
    html = session_report(doubted, observations)
    assert html.index("C1 lags by 12 ms") < html.index('class="tiles"')
    assert not verdict(doubted).is_good
    assert "1 warning:" in verdict(doubted).text


def test_a_hostile_name_ends_no_element(calibration_and_observations):
    calibration, observations = calibration_and_observations
    name = "</script><script>alert(1)</script>"
    cameras = (replace(calibration.cameras[0], name=name), *calibration.cameras[1:])
    observations = replace(observations, camera_names=(name, *observations.camera_names[1:]))
    html = session_report(replace(calibration, cameras=cameras), observations)
    assert name not in html
    assert "alert(1)" in html  # escaped, yet told


def test_residual_figure_states_the_rms_of_the_inliers(calibration_and_observations):
    views = SpotViews.of(calibration_and_observations[1])
    error = np.full((len(views.point), 2), [0.3, 0.4])
    is_inlier = np.ones(len(error), dtype=bool)
    error[0], is_inlier[0] = 50.0, False
    figure = residual_figure(int(views.camera[0]), views, error, is_inlier)
    assert figure["data"][1]["name"] == "RMS 0.50 px"  # the length of (0.3, 0.4)


def test_shared_instants_count_pairs(calibration_and_observations):
    views = SpotViews.of(calibration_and_observations[1])
    shared = shared_instants(views)
    frames = [set(views.point[views.camera == c].tolist()) for c in range(views.n_cameras)]
    assert shared[0, 1] == len(frames[0] & frames[1])
    assert shared[1, 1] == len(frames[1])
    assert overlap_figure(["a"] * len(shared), shared)["data"][0]["z"] == shared.tolist()


def test_report_is_written_whole(calibration_and_observations, tmp_path):
    path = tmp_path / "report.html"
    write_session_report(path, *calibration_and_observations)
    assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")
    assert list(tmp_path.iterdir()) == [path]
