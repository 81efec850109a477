"""The network from above and from the side: cameras, viewing pyramids, spots, uncertainty of the camera centres."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from network_calib.cameras import cam_from_img
from network_calib.observations import FloatArray
from network_calib.result import CalibratedCamera, Calibration
from nodes.camera.pictures import SPOT_COLOUR, new_figure, save_figure, short_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CAMERA = "#c2410c"


def draw_network(calibration: Calibration, spots_in_world: FloatArray, path: Path) -> None:
    """Top and side view: cameras with their viewing pyramids, the spots, 95 % ellipses of the camera centres.

    Args:
        calibration: the result.
        spots_in_world: (F, 3), NaN where a spot has no position.
        path: of the PNG.
    """
    axes_in_world, labels = view_axes(calibration)
    unit = "m" if calibration.world.unit == "m" else "units"
    spots = spots_in_world[np.isfinite(spots_in_world).all(axis=1)] @ axes_in_world.T
    centres = np.array([camera.centre_in_world for camera in calibration.cameras]) @ axes_in_world.T
    everything = np.concatenate([spots, centres])
    extent = float(np.ptp(everything, axis=0)[:2].max()) if len(everything) > 1 else 1.0
    factor = _exaggeration(calibration, extent=extent)
    margin = 0.2 * extent
    low, high = everything.min(axis=0) - margin, everything.max(axis=0) + margin
    spans = high - low
    figure, grid = _two_views(spans)
    names = short_names([camera.name for camera in calibration.cameras])
    for axes, (across, up), title in zip(grid, ((0, 1), (0, 2)), ("Top view", "Side view"), strict=True):
        axes.plot(spots[:, across], spots[:, up], ".", color=SPOT_COLOUR, markersize=1.6, alpha=0.55, zorder=1)
        for name, camera in zip(names, calibration.cameras, strict=True):
            _draw_camera(axes, camera, axes_in_world[[across, up]], name=name, extent=extent, factor=factor)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[up], high[up])
        axes.set_aspect("equal", adjustable="box")
        axes.set_title(title, loc="left", fontsize=11, fontweight="bold")
        axes.set_xlabel(f"{labels[0]} ({unit})", parse_math=False)
        axes.set_ylabel(f"{labels[up]} ({unit})", parse_math=False)
        axes.grid(visible=True, color="#e5e7eb", linewidth=0.7)
        axes.set_axisbelow(True)
    ellipse = f"ellipses: 95 % of the camera centre, drawn {factor:g} times larger" if factor else "no ellipses"
    figure.suptitle(
        f"{calibration.provenance.input_name}: {len(centres)} cameras, {len(spots)} spots\n{ellipse}",
        fontsize=10,
        parse_math=False,
    )
    save_figure(figure, path)


def _two_views(spans: FloatArray) -> tuple[Figure, list[Axes]]:
    """A figure for two views whose extents are (along, across) and (along, up): side by side where they are tall."""
    if spans[0] < 0.8 * spans[1]:
        scale = min(6.0 / spans[0], 9.0 / max(spans[1], spans[2]))  # inches per unit, so that both fit a page
        figure = new_figure(max(2 * scale * spans[0], 6.0) + 1.8, scale * max(spans[1], spans[2]) + 1.6)
        return figure, list(figure.subplots(1, 2))
    scale = min(9.0 / spans[0], 13.0 / (spans[1] + spans[2]))
    figure = new_figure(max(scale * spans[0], 5.0) + 1.0, scale * (spans[1] + spans[2]) + 2.2)
    return figure, list(figure.subplots(2, 1, height_ratios=[spans[1], spans[2]]))


def view_axes(calibration: Calibration) -> tuple[FloatArray, tuple[str, str, str]]:
    """(3, 3) rows along, across and up, in world, and their labels.

    A frame that a camera lends has no vertical. There up is the mean of the cameras' own up directions, which people
    mount upright, and along is what that camera calls right, made level.
    """
    names = [camera.name for camera in calibration.cameras]
    if calibration.world.name not in names:
        return np.eye(3), ("x", "y", "z")
    rotations = calibration.as_cameras().rotations
    up = -rotations[:, 1].mean(axis=0)
    right = rotations[names.index(calibration.world.name), 0]
    ahead = np.cross(up, right)
    if np.linalg.norm(up) < 1e-3 or np.linalg.norm(ahead) < 1e-3:
        return np.eye(3), ("x", "y", "z")
    up, ahead = up / np.linalg.norm(up), ahead / np.linalg.norm(ahead)
    axes_in_world = np.array([np.cross(ahead, up), ahead, up], dtype=np.float64)
    name = calibration.world.name
    return axes_in_world, (f"right of {name}", f"ahead of {name}", "up, mean of the cameras")


def _exaggeration(calibration: Calibration, *, extent: float) -> float:
    """A round factor that draws the median 95 % ellipse at about 3 % of the extent; 0 where there is no uncertainty."""
    semi_axes = [math.sqrt(5.991 * np.linalg.eigvalsh(c.covariance[3:6, 3:6])[-1]) for c in calibration.cameras]
    known = [axis for axis in semi_axes if axis > 0]
    if not known:
        return 0.0
    ratio = 0.03 * extent / float(np.median(known))
    decade = 10.0 ** math.floor(math.log10(ratio))
    return max(decade * max(step for step in (1, 2, 5) if step * decade <= ratio), 1.0)


def _draw_camera(
    axes: Axes, camera: CalibratedCamera, plane_in_world: FloatArray, *, name: str, extent: float, factor: float
) -> None:
    """One camera in the plane whose two directions are the rows (2, 3)."""
    from matplotlib.patches import Ellipse, Polygon
    from scipy.spatial import ConvexHull

    centre = plane_in_world @ camera.centre_in_world
    corners = np.vstack([centre, _pyramid(camera, length=0.13 * extent) @ plane_in_world.T])
    hull = corners[ConvexHull(corners, qhull_options="QJ").vertices]
    axes.add_patch(Polygon(hull, facecolor=_CAMERA, edgecolor=_CAMERA, alpha=0.16, linewidth=0.8, zorder=2))
    axes.plot(*centre, "s", color=_CAMERA, markersize=5, zorder=4)
    axes.annotate(
        name,
        (centre[0], centre[1]),
        (5, 5),
        textcoords="offset points",
        fontsize=9,
        fontweight="bold",
        parse_math=False,
        zorder=5,
    )
    variance, directions = np.linalg.eigh(plane_in_world @ camera.covariance[3:6, 3:6] @ plane_in_world.T)
    if factor and variance[1] > 0:
        minor, major = 2 * factor * np.sqrt(5.991 * np.maximum(variance, 0))
        angle_deg = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
        axes.add_patch(Ellipse((centre[0], centre[1]), major, minor, angle=angle_deg, fill=False, zorder=3))


def _pyramid(camera: CalibratedCamera, *, length: float) -> FloatArray:
    """(n, 3) far corners of the viewing pyramid in world; corners beyond the lens model are left out."""
    width, height = camera.size_px
    corners_px = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    centre_px = camera.intrinsics[2:4]
    # Corners of a wide lens may lie beyond its model: from there inwards to the first pixel that has a ray.
    inwards = np.linspace(0, 0.95, 20)[:, None, None]
    ray_xy, is_valid = cam_from_img(
        camera.intrinsics, np.asarray(camera.lens.is_fisheye), corners_px + inwards * (centre_px - corners_px)
    )
    outermost = ray_xy[is_valid.argmax(axis=0), np.arange(4)]
    rays = np.column_stack([outermost, np.ones(4)])[is_valid.any(axis=0)]
    if camera.lens.is_fisheye:  # corners near 90 degrees have no end in the plane z = 1
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays *= length
    return camera.cam_from_world.inv().apply(np.vstack([rays, [0.0, 0.0, length]]))
