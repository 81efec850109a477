"""The report of a session: one HTML file that needs nothing else, for a site manager to read and file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from network_calib.observations import Observations
from network_calib.result import PARAMETER_NAMES, CalibratedCamera, CalibratedLrf, Calibration
from network_calib.spots import SpotViews, locate
from nodes.report.report_figures import (
    Figure,
    coverage_figure,
    overlap_figure,
    plan_figure,
    residual_figure,
    residuals,
    rig_figure,
    shared_instants,
)
from nodes.report.tables import coordinate, length, plus_minus, share
from nodes.room_file import write_whole

TEMPLATE = Path(__file__).with_name("session_report.html.j2")
# Beyond this many standard deviations a detection is none of its spot.
OUTLIER_SIGMA = 5.0
# Figures by camera of so many cameras at most, the worst first: a page of more is read by nobody.
MAX_CAMERA_FIGURES = 24
FOCAL, CENTRE = PARAMETER_NAMES.index("focal_px"), slice(3, 6)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the report says first.

    Attributes:
        is_good: no warnings.
        text: in a sentence.
    """

    is_good: bool
    text: str


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """One camera's pictures."""

    name: str
    residuals: Figure
    coverage: Figure


def write_session_report(
    path: Path, calibration: Calibration, observations: Observations, *, notes: Sequence[str] = ()
) -> None:
    """Write the report, whole or not at all.

    Args:
        path: of the HTML file.
        calibration: the result.
        observations: what the cameras saw, with the calibration's cameras in their order.
        notes: what was assumed or left out, one sentence each.

    Raises:
        OSError: it cannot be written.
    """
    text = session_report(calibration, observations, notes=notes)
    write_whole(path, lambda unfinished: unfinished.write_text(text, encoding="utf-8"))


def session_report(calibration: Calibration, observations: Observations, *, notes: Sequence[str] = ()) -> str:
    """The report's HTML; see `write_session_report`."""
    from jinja2 import Environment, FileSystemLoader
    from plotly.offline import get_plotlyjs

    views = SpotViews.of(observations)
    noise = np.array([camera.quality.noise_sigma_px for camera in calibration.cameras])
    points, is_inlier = locate(calibration.as_cameras(), views, OUTLIER_SIGMA * noise[views.camera])
    error_px = residuals(calibration, views, points)
    shown = _worst_first(calibration)[:MAX_CAMERA_FIGURES]
    by_camera = [
        CameraFigures(
            calibration.cameras[k].name,
            residual_figure(k, views, error_px, is_inlier),
            coverage_figure(k, calibration.cameras[k].size_px, views, is_inlier),
        )
        for k in sorted(shown)
    ]
    environment = Environment(loader=FileSystemLoader(TEMPLATE.parent), autoescape=True, trim_blocks=True)
    environment.filters["figure"] = _script_json
    return environment.get_template(TEMPLATE.name).render(
        calibration=calibration,
        verdict=verdict(calibration),
        tiles=_tiles(calibration),
        cameras=[_camera_row(camera, calibration.world.unit) for camera in calibration.cameras],
        lrfs=[_lrf_row(lrf) for lrf in calibration.lrfs],
        plan=plan_figure(calibration, points),
        rig=rig_figure(calibration, points),
        overlap=overlap_figure([camera.name for camera in calibration.cameras], shared_instants(views)),
        by_camera=by_camera,
        n_not_shown=len(calibration.cameras) - len(shown),
        notes=notes,
        options=json.dumps(json.loads(calibration.provenance.options_json), indent=1),
        plotly_js=get_plotlyjs(),
    )


def verdict(calibration: Calibration) -> Verdict:
    """Whether the result may be used, in a sentence."""
    n = len(calibration.warnings)
    if not n:
        return Verdict(is_good=True, text="No check found anything to doubt.")
    noun = "warning" if n == 1 else "warnings"
    return Verdict(is_good=False, text=f"{n} {noun}: read before you use this calibration.")


def _tiles(calibration: Calibration) -> list[tuple[str, str]]:
    """The figures that matter most, with their names."""
    quality, unit = calibration.quality, calibration.world.unit
    centre = max(float(np.linalg.norm(camera.sigma[CENTRE])) for camera in calibration.cameras)
    tiles = [
        ("hold-out error, RMS", _px(quality.holdout.rms_px)),
        ("fitted error, RMS", _px(quality.fitted.rms_px)),
        ("σ of the worst camera centre", length(centre, unit)),
        ("σ of a spot, median", length(quality.spot_sigma_median, unit)),
        ("spots", str(quality.n_points)),
        ("observations used", share(quality.n_inliers, quality.n_observations)),
    ]
    if calibration.lrfs:
        worst = max(float(np.linalg.norm(lrf.sigma[CENTRE])) for lrf in calibration.lrfs)
        tiles.append(("σ of the worst LRF's origin", length(worst, "m")))
    return tiles


def _camera_row(camera: CalibratedCamera, unit: str) -> tuple[str, ...]:
    centre = [coordinate(float(v), float(s)) for v, s in zip(camera.centre_in_world, camera.sigma[CENTRE], strict=True)]
    return (
        camera.name,
        f"{camera.size_px[0]} × {camera.size_px[1]}",
        plus_minus(float(camera.intrinsics[0]), float(camera.sigma[FOCAL])),
        *centre,
        length(float(np.linalg.norm(camera.sigma[CENTRE])), unit),
        f"{math.degrees(float(np.linalg.norm(camera.sigma[:3]))):.3f}",
        _px(camera.quality.fitted.rms_px),
        _px(camera.quality.holdout.rms_px),
        str(camera.quality.n_observations),
        f"{100 * camera.quality.coverage:.0f} %",
    )


def _lrf_row(lrf: CalibratedLrf) -> tuple[str, ...]:
    origin = zip(lrf.world_from_lrf.translation, lrf.sigma[CENTRE], strict=True)
    tilts = ", ".join(
        plus_minus(math.degrees(angle), math.degrees(sigma))
        for angle, sigma in zip(lrf.tilt_rad, lrf.tilt_sigma_rad, strict=True)
    )
    return (
        lrf.name,
        *(coordinate(float(v), float(s)) for v, s in origin),
        f"{math.degrees(float(np.linalg.norm(lrf.sigma[:3]))):.3f}",
        tilts,
        share(lrf.n_inliers, lrf.n_sightings),
        length(lrf.range_rms_m, "m"),
        f"{math.degrees(lrf.bearing_rms_rad):.3f}",
        length(lrf.out_of_plane_rms_m, "m"),
    )


def _worst_first(calibration: Calibration) -> list[int]:
    error = [camera.quality.holdout.rms_px for camera in calibration.cameras]
    return sorted(range(len(error)), key=lambda k: (-error[k] if math.isfinite(error[k]) else -math.inf, k))


def _script_json(figure: Figure) -> str:
    """JSON that may stand in a <script>: nothing in it can end the element."""
    from markupsafe import Markup

    text = json.dumps(figure, separators=(",", ":"), allow_nan=False)
    escaped = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return Markup(escaped)


def _px(value: float) -> str:
    return f"{value:.3f} px" if math.isfinite(value) else "–"
