"""The figures of a session's report, as Plotly figures in plain JSON; points are thinned so that a page stays small."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from network_calib.cameras import cam_from_img
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.result import CalibratedCamera, CalibratedLrf, Calibration
from network_calib.spots import SpotViews, reprojection_error
from nodes.report.view_axes import view_axes

Figure = Mapping[str, Any]
MAX_POINTS = 1500
# Length of a drawn viewing pyramid, as a part of the extent of everything.
PYRAMID = 0.08
CAMERA_COLOUR, SPOT_COLOUR, LRF_COLOUR = "#c2410c", "#2563eb", "#047857"
INSIDE, OUTSIDE = "#2563eb", "#dc2626"


def rig_figure(calibration: Calibration, points: FloatArray) -> Figure:
    """Cameras with their viewing pyramids, LRFs with their tilt axes, and the spots (F, 3), in the world frame."""
    spots = _thinned(points[np.isfinite(points).all(axis=1)])
    centres = np.array([camera.centre_in_world for camera in calibration.cameras])
    everything = np.concatenate([spots, centres]) if len(spots) else centres
    reach = PYRAMID * float(np.ptp(everything, axis=0).max() or 1.0)
    traces = [
        _markers(spots, "spots", SPOT_COLOUR, size=1.5),
        _lines([_pyramid(camera, reach) for camera in calibration.cameras], "cameras", CAMERA_COLOUR),
        {
            **_markers(centres, "camera centres", CAMERA_COLOUR, size=4),
            "mode": "markers+text",
            "text": [camera.name for camera in calibration.cameras],
            "textposition": "top center",
        },
    ]
    if calibration.lrfs:
        traces.append(_lines([_lrf_lines(lrf, 2 * reach) for lrf in calibration.lrfs], "LRFs", LRF_COLOUR))
    unit = calibration.world.unit
    axes = {f"{axis}axis": {"title": {"text": f"{axis}, {unit}"}} for axis in "xyz"}
    scene = {**axes, "aspectmode": "data", "camera": _eye(calibration)}
    layout = {"scene": scene, "height": 560, "margin": {"l": 0, "r": 0, "t": 8, "b": 0}, "legend": {"y": 0.9}}
    return _figure(traces, layout)


def plan_figure(calibration: Calibration, points: FloatArray) -> Figure:
    """The same from above, for browsers and paper without a third dimension."""
    axes_in_world, labels = view_axes(calibration)
    plane = axes_in_world[:2]
    spots = _thinned(points[np.isfinite(points).all(axis=1)]) @ plane.T
    centres = np.array([camera.centre_in_world for camera in calibration.cameras]) @ plane.T
    everything = np.concatenate([spots, centres])
    reach = PYRAMID * float(np.ptp(everything, axis=0).max() or 1.0)
    outlines = [_pyramid(camera, reach) @ plane.T for camera in calibration.cameras]
    names = {"mode": "markers+text", "textposition": "top center"}
    traces = [
        _scatter(spots, SPOT_COLOUR, "spots"),
        {**_scatter(_with_gaps(outlines), CAMERA_COLOUR, "cameras"), "mode": "lines"},
        {
            **_scatter(centres, CAMERA_COLOUR, "camera centres"),
            **names,
            "text": [camera.name for camera in calibration.cameras],
        },
    ]
    for lrf in calibration.lrfs:
        fan = _lrf_lines(lrf, 2 * reach) @ plane.T
        traces.append({**_scatter(fan[:3], LRF_COLOUR, f"{lrf.name}: forward, left"), "mode": "lines"})
    unit = calibration.world.unit
    x = {"title": {"text": f"{labels[0]}, {unit}"}, "constrain": "domain"}
    y = {"title": {"text": f"{labels[1]}, {unit}"}, "scaleanchor": "x"}
    return _figure(traces, {"xaxis": x, "yaxis": y, "height": 520, "margin": MARGIN})


def residual_figure(camera: int, views: SpotViews, error_px: FloatArray, is_inlier: BoolArray) -> Figure:
    """One camera's residuals (K, 2) as a scatter, inliers only, with its circle of one RMS."""
    mine = is_inlier & (views.camera == camera)
    error = _thinned(error_px[mine])
    rms = float(np.sqrt((error**2).sum(axis=1).mean())) if len(error) else 1.0
    turn = np.linspace(0, 2 * np.pi, 61)
    traces = [
        _scatter(error, INSIDE, "residual"),
        {
            **_scatter(rms * np.column_stack([np.cos(turn), np.sin(turn)]), "#9ca3af", f"RMS {rms:.2f} px"),
            "mode": "lines",
        },
    ]
    reach = 4 * rms
    x = {"range": [-reach, reach], "title": {"text": "Δx, px"}, "scaleanchor": "y"}
    return _figure(traces, {"xaxis": x, "yaxis": {"range": [reach, -reach], "title": {"text": "Δy, px"}}, **SMALL})


def coverage_figure(camera: int, size_px: tuple[int, int], views: SpotViews, is_inlier: BoolArray) -> Figure:
    """Where in one camera's picture the spot was seen; observations that disagree with the others in red."""
    mine = views.camera == camera
    good, bad = views.px[mine & is_inlier], views.px[mine & ~is_inlier]
    traces = [
        _scatter(_thinned(good), INSIDE, f"{len(good)} used"),
        _scatter(_thinned(bad), OUTSIDE, f"{len(bad)} not"),
    ]
    x = {"range": [-0.5, size_px[0] - 0.5], "constrain": "domain"}
    y = {"range": [size_px[1] - 0.5, -0.5], "scaleanchor": "x", "constrain": "domain"}
    return _figure(traces, {"xaxis": x, "yaxis": y, **SMALL})


def overlap_figure(names: Sequence[str], shared: IntArray) -> Figure:
    """(C, C) how many instants each pair of cameras shares."""
    heat = {
        "type": "heatmap",
        "z": shared.tolist(),
        "zmin": 0,
        "zmax": int(shared.max(initial=1)),
        "x": list(names),
        "y": list(names),
        "colorscale": [[0, "#fecaca"], [0.02, "#dbeafe"], [1, "#1d4ed8"]],
        "hovertemplate": "%{y} with %{x}: %{z} instants<extra></extra>",
    }
    if len(names) <= 12:
        heat |= {"text": shared.tolist(), "texttemplate": "%{text}"}
    side = min(120 + 44 * len(names), 720)
    y = {"autorange": "reversed", "scaleanchor": "x", "constrain": "domain"}
    layout = {"height": side, "width": side + 120, "xaxis": {"constrain": "domain"}, "yaxis": y, "margin": MARGIN}
    return _figure([heat], layout)


def shared_instants(views: SpotViews) -> IntArray:
    """(C, C) instants that both of two cameras saw; on the diagonal, of one."""
    seen = np.zeros((views.n_cameras, views.n_points), dtype=np.float32)
    seen[views.camera, views.point] = 1
    return np.rint(seen @ seen.T).astype(np.int64)


def residuals(calibration: Calibration, views: SpotViews, points: FloatArray) -> FloatArray:
    """(K, 2) detected minus predicted pixel."""
    return -reprojection_error(calibration.as_cameras(), views, points)


MARGIN = {"l": 48, "r": 8, "t": 8, "b": 40}
SMALL = {"height": 320, "margin": MARGIN, "showlegend": True, "legend": {"orientation": "h", "y": 1.12}}


def _figure(traces: Sequence[Mapping[str, object]], layout: Mapping[str, object]) -> Figure:
    plain = {"paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)", "hovermode": "closest"}
    return {"data": list(traces), "layout": {**plain, **layout}}


def _thinned(rows: FloatArray) -> FloatArray:
    """At most MAX_POINTS of them, evenly."""
    return rows[:: max(1, -(-len(rows) // MAX_POINTS))]


def _scatter(xy: FloatArray, colour: str, name: str) -> dict[str, object]:
    rounded = np.round(xy, 4)
    look = {"marker": {"size": 3, "color": colour, "opacity": 0.55}, "line": {"color": colour}}
    columns = {"x": _numbers(rounded[:, 0]), "y": _numbers(rounded[:, 1])}
    return {
        "type": "scatter",
        "mode": "markers",
        **columns,
        "name": name,
        **look,
    }


def _with_gaps(parts: Sequence[FloatArray]) -> FloatArray:
    """Polylines one after the other, a row of NaN behind each."""
    gap = np.full((1, parts[0].shape[1]), np.nan)
    return np.concatenate([row for part in parts for row in (part, gap)])


def _markers(xyz: FloatArray, name: str, colour: str, *, size: float) -> dict[str, object]:
    columns = dict(zip("xyz", np.round(xyz, 4).T.tolist(), strict=True))
    return {"type": "scatter3d", "mode": "markers", **columns, "name": name, "marker": {"size": size, "color": colour}}


def _lines(parts: Sequence[FloatArray], name: str, colour: str) -> dict[str, object]:
    """Several polylines (n, 3) as one trace, with gaps."""
    columns = dict(zip("xyz", map(_numbers, np.round(_with_gaps(parts), 4).T), strict=True))
    return {"type": "scatter3d", "mode": "lines", **columns, "name": name, "line": {"color": colour, "width": 3}}


def _numbers(column: FloatArray) -> list[float | None]:
    """JSON knows no NaN: a gap is null."""
    return [None if np.isnan(value) else value for value in column.tolist()]


def _pyramid(camera: CalibratedCamera, depth: float) -> FloatArray:
    """(n, 3) a line along all edges of the viewing pyramid."""
    width, height = camera.size_px
    corners_px = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    xy, _ = cam_from_img(np.tile(camera.intrinsics, (4, 1)), np.full(4, camera.lens.is_fisheye), corners_px)
    in_cam = depth * np.column_stack([xy, np.ones(4)])
    corners = camera.cam_from_world.inv().apply(in_cam)
    tip = camera.centre_in_world
    a, b, c, d = corners
    return np.array([tip, a, b, tip, c, b, c, d, tip, d, a])


def _lrf_lines(lrf: CalibratedLrf, reach: float) -> FloatArray:
    """(n, 3) forward and left of the scan plane, then the tilt axis."""
    origin = lrf.world_from_lrf.translation
    forward, left = lrf.world_from_lrf.apply(reach * np.eye(3)[:2])
    axis = lrf.axis_direction_in_world * reach / 2
    foot = lrf.axis_point_in_world + lrf.axis_direction_in_world * float(
        (origin - lrf.axis_point_in_world) @ lrf.axis_direction_in_world
    )
    return np.array([forward, origin, left, origin, foot, foot - axis, foot + axis])


def _eye(calibration: Calibration) -> Mapping[str, object]:
    """Up is the mean of the cameras' own up directions: people mount them upright."""
    up = -np.mean([camera.cam_from_world.rotation.as_matrix()[1] for camera in calibration.cameras], axis=0)
    up /= np.linalg.norm(up) or 1.0
    beside = np.cross(up, [0.31, 0.87, 0.38])
    beside /= np.linalg.norm(beside) or 1.0
    eye = 1.1 * up + 1.4 * beside
    return {name: dict(zip("xyz", vector.tolist(), strict=True)) for name, vector in (("up", up), ("eye", eye))}
