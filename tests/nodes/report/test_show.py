import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from network_calib.evaluate import evaluate
from network_calib.formats.calibration_json import load
from network_calib.formats.source import read_source
from network_calib.result import Doubt
from nodes.report.show import calibration_view, evaluation_view
from nodes.report.tables import length, plus_minus


def text_of(renderable, width=100):
    file = io.StringIO()
    Console(file=file, width=width, no_color=True).print(renderable)
    return file.getvalue()


@pytest.mark.parametrize(
    ("value", "sigma", "expected"),
    [
        (451.2345, 0.4213, "451.23±0.42"),
        (451.2345, 12.3, "451±12"),
        (-0.28, 0.0012, "-0.2800±0.0012"),
        (1.0, 0.0, "1 fixed"),
        (0.5, np.nan, "0.5"),
        (1e-3, 1e-15, "0.001000000±0.000000000"),
    ],
)
def test_value_carries_two_digits_of_its_sigma(value, sigma, expected):
    assert plus_minus(value, sigma) == expected


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (12.3456, "m", "12.35 m"), (0.0123, "m", "12.3 mm"), (2e-5, "m", "20 µm"), (0.02, "unit", "0.02 units"),
        (np.nan, "m", "–"),
    ],
)  # fmt: skip
def test_length_takes_a_unit_that_suits(value, unit, expected):
    assert length(value, unit) == expected


@pytest.mark.parametrize("width", [80, 100, 120])
def test_tables_fit_the_terminal_and_cut_no_number(calibration, width):
    text = text_of(calibration_view(calibration), width)
    assert max(len(line) for line in text.splitlines()) <= width
    assert "…" not in text
    for number in ("451.20±0.42", "1203.5 fixed", "-0.280±0.004", "0.358", "95.3 %", "38 %"):
        assert number in text


def test_camera_name_is_text_and_not_markup(calibration):
    cameras = (replace(calibration.cameras[0], name="[red]a"), *calibration.cameras[1:])
    assert "[red]a" in text_of(calibration_view(replace(calibration, cameras=cameras)))


def test_warnings_stand_last_with_their_advice(calibration):
    warnings = (Doubt("flat", "the spots lie in a plane", "Wave up and down [too]."),)
    text = text_of(calibration_view(replace(calibration, warnings=warnings)))
    tail = text[text.index("Warning: flat") :]
    assert "the spots lie in a plane" in tail
    assert "What to do: Wave up and down [too]." in tail
    assert "Reprojection error" not in tail
    assert "No warnings." in text_of(calibration_view(replace(calibration, warnings=())))


def test_share_says_100_only_when_all_are_there(calibration):
    quality = replace(calibration.quality, n_observations=100_000, n_inliers=99_999)
    text = text_of(calibration_view(replace(calibration, quality=quality)))
    assert "99.9 % inliers of 100000 observations" in text


def test_evaluation_names_every_camera(smart_room):
    truth = load(smart_room / "truth.json")
    evaluation = evaluate(truth, read_source(smart_room).observations)
    text = text_of(evaluation_view(evaluation, names=[camera.name for camera in truth.cameras]))
    assert all(name in text for name in ("C0", "C1", "C2", "C3", "C4", "all"))
    assert f"{evaluation.n_frames} frames" in text
