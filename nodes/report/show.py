"""Tables that a person can read: a calibration, an evaluation on new data, and a comparison with the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from network_calib.cameras import LensModel
from network_calib.result import PARAMETER_NAMES, CalibratedCamera, Calibration, Doubt, ErrorSummary
from nodes.report.show_lrf import lrf_tables
from nodes.report.tables import coordinate, length, plain_table, plus_minus, share

if TYPE_CHECKING:
    from network_calib.evaluate import Evaluation

INDEX = {name: k for k, name in enumerate(PARAMETER_NAMES)}


def calibration_view(calibration: Calibration) -> RenderableType:
    """The whole result: world, lenses, poses, errors, and warnings last, where the eye ends."""
    return Group(
        _summary(calibration),
        "",
        _lens_table(calibration.cameras),
        _distortion_table(calibration.cameras),
        _pose_table(calibration),
        _error_table(calibration),
        *lrf_tables(calibration.lrfs),
        *warning_panels(calibration.warnings),
    )


def warning_panels(warnings: Sequence[Doubt]) -> list[RenderableType]:
    """One panel for each warning, or a line that there is none."""
    if not warnings:
        return [Text("No warnings.", style="green")]
    return [
        Panel(
            Text.assemble(warning.message, ("\nWhat to do: ", "bold") if warning.advice else "", warning.advice),
            title=Text(f"Warning: {warning.code}"),
            title_align="left",
            border_style="yellow",
        )
        for warning in warnings
    ]


def evaluation_view(evaluation: Evaluation, *, names: Sequence[str]) -> RenderableType:
    """Reprojection of new data, nothing refitted.

    Args:
        evaluation: the figures.
        names: C camera names of the calibration.
    """
    table = plain_table("Reprojection of new data, px (nothing refitted)", "camera", "obs.", "inliers", *_ERROR_HEADS)
    for index, (name, summary) in enumerate(zip(names, evaluation.cameras, strict=True)):
        rows = evaluation.camera == index
        n_rows, n_inliers = int(rows.sum()), int(evaluation.is_inlier[rows].sum())
        table.add_row(Text(name), str(n_rows), share(n_inliers, n_rows), *_errors(summary))
    table.add_section()
    n_inliers = int(evaluation.is_inlier.sum())
    table.add_row(
        "all", str(len(evaluation.camera)), share(n_inliers, len(evaluation.camera)), *_errors(evaluation.overall)
    )
    return Group(table, Text(f"{evaluation.n_frames} frames with two views or more."))


_ERROR_HEADS = ("mean", "RMS", "median", "95 %")


def _summary(calibration: Calibration) -> Table:
    quality, world, origin = calibration.quality, calibration.world, calibration.provenance
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="bold", no_wrap=True)
    grid.add_column(overflow="fold")
    scale = f" (± {100 * world.scale_sigma:.2g} %)" if world.scale_sigma > 0 else ""
    rows = [
        ("input", f"{origin.input_name}  (seed {origin.seed}, start by {origin.start_method})"),
        ("world", f"frame {world.name}; scale from {world.scale_source}{scale}"),
        ("spots", f"{quality.n_points} fitted; {share(quality.n_inliers, quality.n_observations)} inliers of "
                  f"{quality.n_observations} observations"),
        ("error", f"fitted {quality.fitted.mean_px:.3f} px mean, {quality.fitted.median_px:.3f} median; hold-out "
                  f"{_px(quality.holdout.mean_px)} px mean, {_px(quality.holdout.median_px)} median"),
        ("χ² / dof", f"{quality.chi2_per_dof:.3f}"),
        ("3D σ of a spot", f"{length(quality.spot_sigma_median, world.unit)} median, "
                           f"{length(quality.spot_sigma_p95, world.unit)} for the worst 5 %"),
        ("other seeds", _spread(calibration)),
        ("made by", f"spotcal {origin.program_version}, {origin.created_utc}"),
    ]  # fmt: skip
    for head, text in rows:
        grid.add_row(head, Text(text))
    return grid


def _spread(calibration: Calibration) -> str:
    quality = calibration.quality
    if not math.isfinite(quality.repeat_centre_spread):
        return "not repeated"
    centres = length(quality.repeat_centre_spread, calibration.world.unit)
    return f"centres within {centres}, focal lengths within {_px(quality.repeat_focal_spread_px)} px"


def _lens_table(cameras: Sequence[CalibratedCamera]) -> Table:
    kinds = {camera.lens.value for camera in cameras}
    heads = ("focal length", "aspect", "centre x", "centre y")
    is_one = len(kinds) == 1
    title = f"Lenses, all of model {kinds.pop()}, px" if is_one else "Lenses, px"
    table = plain_table(title, "camera", *(() if is_one else ("lens",)), *heads)
    for camera in cameras:
        focal_x, focal_y, centre_x, centre_y = camera.intrinsics[:4]
        values = {
            "focal_px": focal_x, "aspect": focal_y / focal_x, "centre_x_px": centre_x, "centre_y_px": centre_y,
        }  # fmt: skip
        table.add_row(
            Text(camera.name),
            *(() if is_one else (camera.lens.value,)),
            *(
                plus_minus(value, float(camera.sigma[INDEX[name]]), n_digits=1 if name == "aspect" else 2)
                for name, value in values.items()
            ),
        )
    return table


def _distortion_table(cameras: Sequence[CalibratedCamera]) -> RenderableType:
    distorted = [camera for camera in cameras if camera.lens is not LensModel.NONE]
    if not distorted:
        return Text("No lens distortion is modelled.")
    # A fisheye's third and fourth terms are k3, k4; the others have p1, p2 in these places.
    kinds = sorted({("k3", "k4") if camera.lens.is_fisheye else ("p1", "p2") for camera in distorted})
    heads = (" | ".join(names) for names in zip(*kinds, strict=True))
    table = plain_table("Distortion", "camera", "k1", "k2", *heads)
    for camera in distorted:
        n_terms = camera.lens.n_distortion
        terms = zip(camera.intrinsics[4:], camera.sigma[INDEX["d0"] :], strict=True)
        cells = [plus_minus(float(value), float(sigma), n_digits=1) for value, sigma in terms]
        table.add_row(Text(camera.name), *cells[:n_terms], *["–"] * (4 - n_terms))
    return table


def _pose_table(calibration: Calibration) -> Table:
    unit = calibration.world.unit
    heads = ("x", "y", "z", "rot. σ, °")
    table = plain_table(f"Camera centres in the world frame, {'m' if unit == 'm' else 'units'}", "camera", *heads)
    for camera in calibration.cameras:
        sigma = camera.sigma
        rotation_sigma_deg = math.degrees(float(np.linalg.norm(sigma[:3])))
        table.add_row(
            Text(camera.name),
            *(coordinate(float(v), float(s)) for v, s in zip(camera.centre_in_world, sigma[3:6], strict=True)),
            f"{rotation_sigma_deg:.2g}" if rotation_sigma_deg else "–",
        )
    return table


def _error_table(calibration: Calibration) -> Table:
    heads = ("obs.", "inliers", *_ERROR_HEADS, "hold-out", "noise σ", "image")
    table = plain_table("Reprojection error, px", "camera", *heads)
    for camera in calibration.cameras:
        quality = camera.quality
        table.add_row(
            Text(camera.name),
            str(quality.n_observations),
            share(quality.fitted.n, quality.n_observations),
            *_errors(quality.fitted),
            _px(quality.holdout.mean_px),
            _px(quality.noise_sigma_px),
            f"{100 * quality.coverage:.0f} %",
        )
    table.add_section()
    whole = calibration.quality
    part = share(whole.n_inliers, whole.n_observations)
    row = (str(whole.n_observations), part, *_errors(whole.fitted), _px(whole.holdout.mean_px), "", "")
    table.add_row("all", *row)
    return table


def _errors(summary: ErrorSummary) -> tuple[str, str, str, str]:
    return _px(summary.mean_px), _px(summary.rms_px), _px(summary.median_px), _px(summary.p95_px)


def _px(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "–"
