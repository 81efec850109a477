"""Table I and figures 7 and 8 of the paper from a simulation, for all methods side by side."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from lrf_stereo.study import (
    PAPER_AE_PX,
    PAPER_N_SPOTS,
    PAPER_SD_PX,
    Method,
    MethodErrors,
    Study,
    StudySetup,
    run_study,
)
from network_calib.errors import InputError
from nodes.report.paper_figures import SETUP, draw_convergence, draw_scans
from nodes.report.show import plain_table

ROOM_CAMERAS = 3
HEADING = ("method", "px", *(f"N = {n}" for n in PAPER_N_SPOTS))


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row of Table I: AE or SD of one method, (6,) in pixels."""

    name: str
    figure: str
    px: tuple[float, ...]


def chosen_methods(name: str) -> tuple[Method, ...]:
    """The methods that `--method` names.

    Raises:
        InputError: no such method.
    """
    if name == "all":
        return tuple(Method)
    if name not in tuple(Method):
        raise InputError(f"--method {name}: expected {', '.join(Method)} or all")
    return (Method(name),)


def run_report(
    methods: Sequence[Method], out: Path, *, n_runs: int, seed: int, console: Console, progress_console: Console
) -> None:
    """Simulate, calibrate, print Table I, write it as CSV and markdown, draw figures 7 and 8."""
    out.mkdir(parents=True, exist_ok=True)
    stereo = _study(methods, StudySetup(), n_runs=n_runs, seed=seed, console=progress_console)
    rows = [*_rows("paper, as printed", PAPER_AE_PX, PAPER_SD_PX), *_study_rows(stereo, methods, "")]
    refused = _refusals(stereo)
    if Method.JOINT in methods:
        setup = StudySetup(n_room_cameras=ROOM_CAMERAS)
        room = _study((Method.JOINT,), setup, n_runs=n_runs, seed=seed, console=progress_console)
        rows += _study_rows(room, (Method.JOINT,), ", five cameras")
        refused += _refusals(room)
    caption = _caption(n_runs, seed, refused)
    _write_csv(rows, out / "table1.csv")
    (out / "table1.md").write_text(_markdown(rows, caption), encoding="utf-8")
    draw_convergence(stereo, methods, out / "figure7.png")
    draw_scans(methods, out / "figure8.png", seed=seed)
    console.print(_rich_table(rows))
    console.print(caption, f"Written to {out}", sep="\n", soft_wrap=True, highlight=False, markup=False)


def _study(methods: Sequence[Method], setup: StudySetup, *, n_runs: int, seed: int, console: Console) -> Study:
    name = "five cameras" if setup.n_room_cameras else "stereo pair"
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task(f"{name}: sessions", total=None)

        def advance(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        return run_study(methods, n_runs=n_runs, seed=seed, setup=setup, progress=advance)


def _study_rows(study: Study, methods: Sequence[Method], suffix: str) -> list[TableRow]:
    rows: list[TableRow] = []
    for method in methods:
        cells = [study.of(method, n) for n in PAPER_N_SPOTS]
        average, spread = (tuple(_or_nan(one, name) for one in cells) for name in ("AE", "SD"))
        rows += _rows(f"{method}, simulated{suffix}", average, spread)
    return rows


def _rows(name: str, average: tuple[float, ...], spread: tuple[float, ...]) -> list[TableRow]:
    return [TableRow(name, "AE", average), TableRow(name, "SD", spread)]


def _or_nan(errors: MethodErrors, figure: str) -> float:
    if not len(errors.px):
        return float("nan")
    return errors.average_px if figure == "AE" else errors.spread_px


def _refusals(study: Study) -> list[str]:
    return [f"{one.method} N = {one.n_spots}: {one.n_refused}" for one in study.errors if one.n_refused]


def _caption(n_runs: int, seed: int, refused: Sequence[str]) -> str:
    left_out = f" Refused sessions, left out: {'; '.join(refused)}." if refused else ""
    return (
        f"{SETUP}\nReprojection error of LRF points in the left image over tilts 2° to 50°, exact readings: AE mean, "
        f"SD standard deviation over a session's points, of the median of {n_runs} sessions; seed {seed}. The paper's "
        f"own row is from its real set-up, whose lens, noise and points are not stated.{left_out}"
    )


def _rich_table(rows: Sequence[TableRow]) -> Table:
    table = plain_table("Table I: average error and standard deviation", *HEADING)
    for row in rows:
        is_first = row.figure == "AE"
        table.add_row(Text(row.name if is_first else ""), row.figure, *(f"{value:.2f}" for value in row.px))
    return table


def _write_csv(rows: Sequence[TableRow], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "figure", *(f"n{n}_px" for n in PAPER_N_SPOTS)])
        writer.writerows([row.name, row.figure, *(f"{value:.4f}" for value in row.px)] for row in rows)


def _markdown(rows: Sequence[TableRow], caption: str) -> str:
    lines = [f"| {' | '.join(HEADING)} |", "|---" * len(HEADING) + "|"]
    lines += [f"| {row.name} | {row.figure} | {' | '.join(f'{value:.2f}' for value in row.px)} |" for row in rows]
    return "\n".join(["# Table I", "", *lines, "", caption, ""])
