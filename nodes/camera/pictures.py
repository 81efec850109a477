"""Pictures of a calibration: residuals over each image, errors as bars; the network is in `network_picture.py`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from network_calib.observations import BoolArray, FloatArray
from network_calib.result import CalibratedCamera, Calibration
from network_calib.spots import SpotViews, reprojection_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_IMAGES = 24
GRID = (8, 6)  # the cells in which coverage is counted
SPOT_COLOUR, _BAD, _HOLDOUT = "#7a8ba6", "#b91c1c", "#0f766e"


def draw_residuals(
    calibration: Calibration, views: SpotViews, points: FloatArray, is_inlier: BoolArray, path: Path
) -> None:
    """Residual arrows over each image, and the cells of the image that no spot has visited.

    Args:
        calibration: the result.
        views: K observations.
        points: (F, 3) located spots.
        is_inlier: (K,) which observations agree with their spot.
        path: of the PNG.
    """
    residual = reprojection_error(calibration.as_cameras(), views, points)
    size = np.linalg.norm(residual[is_inlier], axis=1)
    top_px = float(np.percentile(size, 95)) if len(size) else 1.0
    shown = _worst_first(calibration)
    n_columns = min(len(shown), max(2, math.ceil(math.sqrt(len(shown))))) or 1
    n_rows = math.ceil(len(shown) / n_columns)
    shape = np.array([calibration.cameras[index].size_px for index in shown], dtype=np.float64)
    tallest = float((shape[:, 1] / shape[:, 0]).max())
    figure = new_figure(4.4 * n_columns + 1.2, (4.1 * tallest + 0.35) * n_rows + 0.9)
    grid = figure.subplots(n_rows, n_columns, squeeze=False)
    arrows = None
    for axes, index in zip(grid.flat, shown, strict=False):
        rows = views.camera == index
        arrows = _draw_image(
            axes, calibration.cameras[index], views.px[rows], residual[rows], is_inlier[rows], top_px=top_px
        )
    for axes in list(grid.flat)[len(shown) :]:
        axes.set_axis_off()
    if arrows is not None:
        bar = figure.colorbar(arrows, ax=grid, shrink=0.8, aspect=30, extend="max")
        bar.set_label("reprojection error (px)")
    figure.supxlabel("x in the image (px)", fontsize=9)
    figure.supylabel("y in the image (px)", fontsize=9)
    left = len(calibration.cameras) - len(shown)
    rest = f" {left} cameras with less error are left out." if left else ""
    figure.suptitle(
        f"{calibration.provenance.input_name}: reprojection residuals (direction; length not to scale).\n"
        f"Grey cells hold no spot, red crosses are outliers.{rest}",
        fontsize=10,
        parse_math=False,
    )
    save_figure(figure, path)


def draw_errors(calibration: Calibration, path: Path) -> None:
    """Fitted and hold-out error of each camera, side by side: bars that differ mean a calibration that overfits."""
    cameras = calibration.cameras
    place = np.arange(len(cameras))
    figure = new_figure(max(6.0, 1.3 * len(cameras) + 2.5), 4.6)
    axes = figure.subplots()
    for offset, label, colour, summaries in (
        (-0.2, "fitted", SPOT_COLOUR, [camera.quality.fitted for camera in cameras]),
        (0.2, "hold-out: triangulated, never fitted", _HOLDOUT, [camera.quality.holdout for camera in cameras]),
    ):
        median = [summary.median_px for summary in summaries]
        axes.bar(place + offset, median, 0.36, color=colour, label=f"{label} (median)")
        axes.plot(place + offset, [s.p95_px for s in summaries], "_", color=colour, markersize=16, markeredgewidth=2)
    axes.plot([], [], "_", color="#374151", markersize=12, markeredgewidth=2, label="95 % of the observations below")
    names = short_names([camera.name for camera in cameras])
    axes.set_xticks(place, names, rotation=30 if len(cameras) > 6 else 0, ha="center", parse_math=False)
    axes.set_ylabel("reprojection error (px)")
    axes.set_ylim(bottom=0)
    axes.margins(y=0.12)
    axes.grid(visible=True, axis="y", color="#e5e7eb", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(f"{calibration.provenance.input_name}: error per camera", loc="left", fontsize=11, parse_math=False)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    save_figure(figure, path)


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure of this size in inches."""
    # Without pyplot: no window system is asked for, and no figure stays in a global list.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; the folder is made when missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def short_names(names: list[str]) -> list[str]:
    """Names without a long beginning that all share, for labels that stand close together."""
    first, last = min(names), max(names)
    differs = [k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b]
    shared = differs[0] if differs else 0
    return [f"…{name[shared - 2 :]}" for name in names] if len(names) > 1 and shared > 6 else names


def _worst_first(calibration: Calibration) -> list[int]:
    """The cameras to show, in their order: all, or the MAX_IMAGES with the largest error."""
    error = np.nan_to_num(np.array([camera.quality.fitted.mean_px for camera in calibration.cameras]), nan=np.inf)
    return sorted(np.argsort(-error, kind="stable")[:MAX_IMAGES].tolist())


def _draw_image(  # noqa: ANN202 - Quiver, which is imported only by matplotlib
    axes: Axes, camera: CalibratedCamera, px: FloatArray, residual: FloatArray, is_inlier: BoolArray, *, top_px: float
):
    width, height = camera.size_px
    cell = np.array([width / GRID[0], height / GRID[1]])
    index = np.clip(((px[is_inlier] + 0.5) / cell).astype(int), 0, np.array(GRID) - 1)
    count = np.zeros((GRID[1], GRID[0]), dtype=int)
    np.add.at(count, (index[:, 1], index[:, 0]), 1)
    edges = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(np.where(count > 0, 1.0, 0.86), cmap="gray", vmin=0, vmax=1, extent=edges, interpolation="nearest")
    error = np.linalg.norm(residual[is_inlier], axis=1)
    direction = residual[is_inlier] / np.maximum(error, 1e-12)[:, None]
    # Lengths grow with the square root, between nothing and a 25th of the width, so that small ones can be seen too.
    arrow = direction * (width / 25 * np.sqrt(np.minimum(error / top_px, 1.5)))[:, None]
    arrows = axes.quiver(
        *px[is_inlier].T, *arrow.T, error, cmap="viridis_r", clim=(0, top_px), angles="xy", scale_units="xy", scale=1,
        width=0.003, headwidth=3.5, headlength=4, headaxislength=3.5,
    )  # fmt: skip
    outliers = px[~is_inlier]
    axes.plot(*outliers.T, "x", color=_BAD, markersize=3.5, markeredgewidth=0.8)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_title(
        f"{camera.name}: {camera.quality.fitted.mean_px:.3f} px mean, {len(error)} spots, {len(outliers)} outliers",
        loc="left",
        fontsize=9,
        parse_math=False,
    )
    axes.tick_params(labelsize=7)
    return arrows
