"""Figures 7 and 8 of the paper, drawn from the simulated study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lrf_stereo.projection import project_lrf
from lrf_stereo.scanner import ScanSteps, TiltingScanner
from lrf_stereo.study import Method, Study, StudySetup, accuracy, calibrated, simulate
from lrf_stereo.study_data import StudyData
from lrf_stereo.synthetic_picture import render
from lrf_stereo.synthetic_scans import Capsule, ScannedRoom
from network_calib.errors import SpotcalError
from network_calib.observations import FloatArray
from nodes.report.png_figure import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# The tilts of the paper's figure 8, and its colours.
SCAN_TILTS_DEG, SCAN_COLOURS = (2.0, 12.0, 23.2), ("#22c55e", "#ef4444", "#facc15")
METHOD_COLOURS = {Method.PAPER: "#b91c1c", Method.SCREW: "#b45309", Method.JOINT: "#0f766e"}
N_SPOTS = 22
MAX_JUMP_M = 0.15
SETUP = (
    "Simulated: f = 260 px, 320 × 240, baseline 90 mm, detection 0.3 px; URG-04LX (range noise 2.25 mm + 0.73 mm "
    "per m,\nsteps of 0.35°), plane crossed with 4 mm; tilts 12.1°, 23.2°, 50°; dx = 40 mm, dz = 60 mm; cameras and "
    "tilts known."
)


@dataclass(frozen=True, slots=True)
class Furnishing:
    """A room to scan: its name, and the bodies in it, in the room's frame."""

    name: str
    bodies: tuple[tuple[tuple[float, float, float], tuple[float, float, float], float], ...]

    def in_world(self, data: StudyData) -> list[Capsule]:
        """The bodies in the scene's world."""
        move = data.scene.room.world_from_room.apply
        return [Capsule(move(np.array(begin)), move(np.array(end)), radius) for begin, end, radius in self.bodies]


def _person(x: float, y: float) -> tuple[tuple[tuple[float, float, float], tuple[float, float, float], float], ...]:
    """Legs, trunk, head and arms."""
    return (
        ((x, y - 0.1, 0.08), (x, y - 0.1, 0.8), 0.08),
        ((x, y + 0.1, 0.08), (x, y + 0.1, 0.8), 0.08),
        ((x, y, 0.95), (x, y, 1.35), 0.17),
        ((x, y, 1.65), (x, y, 1.68), 0.1),
        ((x, y - 0.22, 1.4), (x - 0.1, y - 0.4, 0.95), 0.05),
        ((x, y + 0.22, 1.4), (x - 0.3, y + 0.45, 1.5), 0.05),
    )


ROOMS = (
    Furnishing("a person and a pillar", (*_person(3.3, -0.45), ((4.6, 1.2, 0.0), (4.6, 1.2, 3.0), 0.2))),
    Furnishing(
        "two persons and pipes",
        (
            *_person(2.6, 0.6),
            *_person(4.2, -1.3),
            ((5.2, 0.2, 0.0), (5.2, 0.2, 3.0), 0.1),
            ((5.2, 0.5, 0.0), (5.2, 0.5, 3.0), 0.1),
        ),
    ),
)


def draw_convergence(study: Study, methods: Sequence[Method], path: Path) -> None:
    """Figure 7: errors of rotation and translation with the number of spots.

    Args:
        study: of the stereo pair.
        methods: to draw.
        path: of the PNG.
    """
    figure = new_figure(9.4, 4.8)
    left, right = figure.subplots(1, 2)
    for method in methods:
        # A run that was refused has no errors: a method that refuses every run at some N has no point there.
        cells = [one for one in study.errors if one.method is method and len(one.px)]
        n_spots = [one.n_spots for one in cells]
        _draw_band(left, method, n_spots, [np.degrees(one.rotation_rad).mean(axis=1) for one in cells])
        _draw_band(right, method, n_spots, [1e3 * one.translation_m.mean(axis=1) for one in cells])
    for axes, title, unit in ((left, "Rotation of LRF to camera", "error (°)"), (right, "Translation", "error (mm)")):
        axes.set_title(title, loc="left", fontsize=11)
        axes.set_xlabel("N, spots at each of three tilts")
        axes.set_ylabel(unit)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xticks(sorted({one.n_spots for one in study.errors}))
        axes.grid(visible=True, which="both", color="#e5e7eb", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    left.legend(frameon=False, fontsize=9)
    caption = f"Mean over tilts 2° to 50°; line: median of {study.n_runs} sessions, band: two thirds of them."
    figure.suptitle(f"Convergence with the number of spots (as figure 7). {caption}\n{SETUP}", fontsize=9)
    save_figure(figure, path)


def draw_scans(methods: Sequence[Method], path: Path, *, seed: int) -> None:
    """Figure 8: scans of three tilts over the left image, for two rooms, by each method; one session calibrates all.

    Args:
        methods: one row of pictures each.
        path: of the PNG.
        seed: of the session that calibrates and of the scans.
    """
    data = simulate(StudySetup(), n_spots=N_SPOTS, run=0, seed=seed)
    pictures = [render(data.scene, room.in_world(data)) for room in ROOMS]
    scans = [_scans(data, room, seed) for room in ROOMS]
    figure = new_figure(10.4, 3.95 * len(methods) + 0.9)
    grid = figure.subplots(len(methods), len(ROOMS), squeeze=False)
    for row, method in zip(grid, methods, strict=True):
        scanner, note = _calibrated(method, data, seed)
        for axes, room, picture, scan in zip(row, ROOMS, pictures, scans, strict=True):
            axes.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            if scanner is not None:
                _draw_scan(axes, data, scanner, scan)
            axes.set_title(f"{method}: {room.name}; {note}", loc="left", fontsize=9)
            axes.set_xticks([])
            axes.set_yticks([])
    handles = [
        *(
            grid[0, 0].plot([], [], ".", color=colour, label=f"scan at {tilt:g}°")[0]
            for tilt, colour in zip(SCAN_TILTS_DEG, SCAN_COLOURS, strict=True)
        ),
        grid[0, 0].plot([], [], "-", color="#1e3a8a", linewidth=1.2, label="the same readings by the true scanner")[0],
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    title = f"Scans over the left image (as figure 8), calibrated with N = {N_SPOTS}; beyond 5.6 m there is no range."
    figure.suptitle(f"{title}\n{SETUP}", fontsize=9)
    save_figure(figure, path)


def _draw_band(axes: Axes, method: Method, n_spots: Sequence[int], by_run: Sequence[FloatArray]) -> None:
    if not by_run:
        return
    low, middle, high = np.array([np.percentile(values, [16.7, 50, 83.3]) for values in by_run]).T
    colour = METHOD_COLOURS[method]
    axes.fill_between(n_spots, low, high, color=colour, alpha=0.15, linewidth=0)
    axes.plot(n_spots, middle, "o-", color=colour, markersize=4, linewidth=1.5, label=str(method))


def _calibrated(method: Method, data: StudyData, seed: int) -> tuple[TiltingScanner | None, str]:
    try:
        scanner = calibrated(method, data, rng=np.random.default_rng((seed, N_SPOTS, 0)))
    except SpotcalError as error:
        return None, f"refused: {error.message}"
    return scanner, f"{accuracy(scanner, data.scene, tilts_deg=SCAN_TILTS_DEG).px.mean():.2f} px mean error"


def _scans(data: StudyData, room: Furnishing, seed: int) -> list[tuple[FloatArray, FloatArray]]:
    """Ranges and bearings that are distances, at each tilt."""
    rng, steps = np.random.default_rng((seed, ROOMS.index(room))), ScanSteps()
    scanned = ScannedRoom.of(data.scene, rng=rng, steps=steps)
    out = []
    for tilt in np.radians(SCAN_TILTS_DEG).tolist():
        reading = scanned.readings_mm(tilt, room.in_world(data), rng=rng)
        is_range = steps.is_range(reading)
        out.append((1e-3 * reading[is_range], steps.bearings_rad[is_range]))
    return out


def _draw_scan(
    axes: Axes, data: StudyData, scanner: TiltingScanner, scans: Sequence[tuple[FloatArray, FloatArray]]
) -> None:
    """The scans where the scanner puts them, on top of where they truly belong."""
    for tilt, colour, (range_m, bearing_rad) in zip(np.radians(SCAN_TILTS_DEG), SCAN_COLOURS, scans, strict=True):
        true = project_lrf(data.scene.scanner, data.scene.cameras, range_m, bearing_rad, tilt)
        found = project_lrf(scanner, data.scene.cameras, range_m, bearing_rad, tilt)
        # No line joins beams that are not neighbours, or that end on different things.
        line = np.where(true.is_valid[0][:, None], true.px[0], np.nan)
        jump = (np.diff(bearing_rad) > 1.5 * ScanSteps().step_rad) | (np.abs(np.diff(range_m)) > MAX_JUMP_M)
        line = np.insert(line, np.flatnonzero(jump) + 1, np.nan, axis=0)
        axes.plot(*line.T, "-", color="#1e3a8a", linewidth=1.2)
        axes.plot(*found.px[0][found.is_valid[0]].T, ".", color=colour, markersize=2.6)
