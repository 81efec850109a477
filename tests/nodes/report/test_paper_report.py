"""`spotcal paper`: the table as printed, as CSV and as markdown, the pictures, and what is refused."""

import csv

import numpy as np
import pytest
from rich.console import Console

from lrf_stereo.study import PAPER_AE_PX, Method
from network_calib.errors import InputError
from nodes.report.paper_report import chosen_methods, run_report


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The report of one session for each N, methods screw and joint."""
    out = tmp_path_factory.mktemp("paper")
    console = Console(record=True, width=120, file=None, quiet=False)
    run_report(
        (Method.SCREW, Method.JOINT), out, n_runs=1, seed=1, console=console, progress_console=Console(quiet=True)
    )
    return out, console.export_text()


def rows_of(out):
    with (out / "table1.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_csv_holds_the_papers_own_row_and_ours(report):
    rows = rows_of(report[0])
    assert [row["method"] for row in rows[::2]] == [
        "paper, as printed",
        "screw, simulated",
        "joint, simulated",
        "joint, simulated, five cameras",
    ]
    assert [row["figure"] for row in rows] == ["AE", "SD"] * 4
    assert [float(rows[0][f"n{n}_px"]) for n in (6, 9, 12, 15, 18, 22)] == list(PAPER_AE_PX)
    # One session at N = 22: five times the median error of the study's own test.
    assert 0 < float(rows[4]["n22_px"]) < 1.5


def test_console_and_markdown_say_the_same_as_the_csv(report):
    out, printed = report
    markdown = (out / "table1.md").read_text(encoding="utf-8")
    for row in rows_of(out):
        value = f"{float(row['n22_px']):.2f}"
        assert value in printed
        assert any(value in line for line in markdown.splitlines() if line.startswith(f"| {row['method']} |"))
    for words in ("f = 260 px", "baseline 90 mm", "dx = 40 mm", "median of 1 sessions; seed 1"):
        assert words in printed
        assert words in markdown


@pytest.mark.parametrize("name", ["figure7.png", "figure8.png"])
def test_pictures_are_drawn(report, name):
    from matplotlib.image import imread

    picture = np.asarray(imread(report[0] / name))[..., :3]
    assert min(picture.shape[:2]) > 400
    assert picture.std() > 0.05


def test_figure_eight_carries_the_colours_of_its_scans(report):
    from matplotlib.image import imread

    picture = np.asarray(imread(report[0] / "figure8.png"))[..., :3]
    for colour in (np.array([0x22, 0xC5, 0x5E]), np.array([0xEF, 0x44, 0x44]), np.array([0xFA, 0xCC, 0x15])):
        near = np.abs(255 * picture - colour).max(axis=2) < 12
        # Four pictures with tens of dots of some ten pixels each.
        assert near.sum() > 400


def test_methods_are_chosen_by_name():
    assert chosen_methods("all") == tuple(Method)
    assert chosen_methods("screw") == (Method.SCREW,)
    with pytest.raises(InputError, match="--method arun: expected paper, screw, joint or all"):
        chosen_methods("arun")
