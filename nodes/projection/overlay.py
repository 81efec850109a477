"""Laser points over a camera's image, coloured by range, each with the ellipse that holds it with 95 %: figure 8.

Only the geometry is drawn: a point behind a wall of the image is drawn as well, because nothing here knows the wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from network_calib.errors import InputError
from network_calib.observations import FloatArray
from nodes.projection.calibration import Calibration
from nodes.projection.points import Beams, CovarianceOf, WorldPoints

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Of a Gaussian in two dimensions, 95 % lie within so many standard deviations: the root of -2 ln 0.05.
N_SIGMA_95 = float(np.sqrt(-2 * np.log(0.05)))
# Near is red, far is blue, as in the stream for viewers; without the dark ends, which are lost in a dark picture.
COLOURS, BRIGHT = "turbo_r", (0.08, 0.88)
FIGURE_IN = 10.0
ELLIPSE_WIDTH, POINT_AREA = 0.7, 5.0
EMPTY_GREY = 0.25


@dataclass(frozen=True, slots=True)
class Drawn:
    """Points in one camera.

    Attributes:
        n_given: points.
        px: (n, 2) of those in the image.
        range_m: (n,) as measured; from the camera for points in world.
        covariance_px2: (n, 2, 2).
    """

    n_given: int
    px: FloatArray
    range_m: FloatArray
    covariance_px2: FloatArray


def drawn_points(calibration: Calibration, points: Sequence[Beams | WorldPoints], camera: str) -> Drawn:
    """The points that fall into a camera's image.

    Raises:
        ProjectionError: UNKNOWN_CAMERA, UNKNOWN_LRF, NO_TILT.
    """
    px, ranges, covariances = [np.empty((0, 2))], [np.empty(0)], [np.empty((0, 2, 2))]
    for some in points:
        found = calibration.project(some, [camera], covariance=CovarianceOf())
        assert found.covariance_px2 is not None
        is_valid = found.is_valid[0]
        px.append(found.px[0, is_valid])
        covariances.append(found.covariance_px2[0, is_valid])
        ranges.append(
            some.range_m[is_valid] if isinstance(some, Beams) else _distances(calibration, some, camera)[is_valid]
        )
    n_given = sum(len(some) for some in points)
    return Drawn(n_given, np.concatenate(px), np.concatenate(ranges), np.concatenate(covariances))


def draw_overlay(
    calibration: Calibration,
    points: Sequence[Beams | WorldPoints],
    camera: str,
    out: Path,
    *,
    image: Path | None = None,
) -> Drawn:
    """Write the picture.

    Args:
        calibration: of the camera and the LRFs.
        points: to draw.
        camera: name.
        out: the PNG.
        image: of the camera, in its calibrated size; None: an empty one.

    Raises:
        ProjectionError: UNKNOWN_CAMERA, UNKNOWN_LRF, NO_TILT.
        InputError: an image of another size.
        SourceError: the image cannot be read.
    """
    from nodes.report.png_figure import new_figure, save_figure

    drawn = drawn_points(calibration, points, camera)
    width, height = _size_px(calibration, camera)
    # Beside the image the legend, above it a line of text.
    figure = new_figure(FIGURE_IN, (FIGURE_IN - 1.4) * height / width + 0.75)
    axes = figure.subplots()
    edges = (-0.5, width - 0.5, height - 0.5, -0.5)
    picture = np.full((height, width, 3), EMPTY_GREY) if image is None else _rgb(image, (width, height))
    axes.imshow(picture, extent=edges, interpolation="nearest")
    if len(drawn.px):
        _draw(axes, drawn)
    axes.set_xlim(edges[:2])
    axes.set_ylim(edges[2:])
    axes.set_xlabel("x (px)", fontsize=8)
    axes.set_ylabel("y (px)", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.set_title(_title(calibration, drawn, camera), loc="left", fontsize=9, parse_math=False)
    save_figure(figure, out)
    return drawn


def _draw(axes: Axes, drawn: Drawn) -> None:
    from matplotlib import colormaps
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import ListedColormap

    colours = ListedColormap(colormaps[COLOURS](np.linspace(*BRIGHT, 256)))
    full_px, angle_deg = ellipses(drawn.covariance_px2)
    # The far ones first: where points meet, the near one hides the others.
    order = np.argsort(-drawn.range_m)
    limits = float(drawn.range_m.min()), float(max(drawn.range_m.max(), drawn.range_m.min() + 0.01))
    around = EllipseCollection(
        full_px[order, 0], full_px[order, 1], angle_deg[order], units="xy",
        offsets=drawn.px[order], offset_transform=axes.transData,
        facecolors="none", linewidths=ELLIPSE_WIDTH, cmap=colours, array=drawn.range_m[order], clim=limits,
    )  # fmt: skip
    axes.add_collection(around)
    dots = axes.scatter(
        *drawn.px[order].T, c=drawn.range_m[order], s=POINT_AREA, cmap=colours, vmin=limits[0], vmax=limits[1],
        linewidths=0,
    )  # fmt: skip
    bar = axes.figure.colorbar(dots, ax=axes, shrink=0.85, aspect=30, pad=0.015)
    bar.set_label("range (m)", fontsize=9)
    bar.ax.tick_params(labelsize=8)


def ellipses(covariance_px2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ellipses that hold 95 %: (n, 2) long and short diameter, px, and (n,) angle of the long one from x to y, deg."""
    variance, axes = np.linalg.eigh(covariance_px2)
    long_axis = axes[:, :, 1]
    diameter_px = 2 * N_SIGMA_95 * np.sqrt(np.maximum(variance[:, ::-1], 0.0))
    return diameter_px, np.degrees(np.arctan2(long_axis[:, 1], long_axis[:, 0]))


def _title(calibration: Calibration, drawn: Drawn, camera: str) -> str:
    seen = f"{camera}: {len(drawn.px)} of {drawn.n_given} laser points in the image"
    if not len(drawn.px):
        return f"{seen}; calibration {calibration.id}"
    sigma_px = np.sqrt(np.linalg.eigvalsh(drawn.covariance_px2)[:, 1])
    return f"{seen}; ellipses: 95 %, σ {np.median(sigma_px):.2f} px in the middle; calibration {calibration.id}"


def _distances(calibration: Calibration, points: WorldPoints, camera: str) -> FloatArray:
    """(N,) distances of points in world from a camera, m."""
    centre = next(one for one in calibration.result.cameras if one.name == camera).centre_in_world
    return np.linalg.norm(points.xyz_m - centre, axis=1)


def _size_px(calibration: Calibration, camera: str) -> tuple[int, int]:
    return next(one for one in calibration.result.cameras if one.name == camera).size_px


def _rgb(path: Path, size_px: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """(h, w, 3) 8 bits."""
    from nodes.devices.cameras.image_read import read_image
    from nodes.frames import PixelFormat

    samples, pixel_format = read_image(path)
    if samples.shape[1::-1] != size_px:
        (given_x, given_y), (x, y) = samples.shape[1::-1], size_px
        raise InputError(
            f"{path} has {given_x} x {given_y} pixels, the camera was calibrated with {x} x {y}",
            advice="Give a frame as the camera delivered it when it was calibrated.",
        )
    narrow = (samples if samples.dtype == np.uint8 else samples >> 8).astype(np.uint8)
    if pixel_format is PixelFormat.MONO:
        return np.repeat(narrow[:, :, None], 3, axis=2)
    return narrow[:, :, ::-1]
