"""Tables of laser range finders: pose, tilt axis, the paper's offsets, instrument, tilts, sightings, what was held."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from rich.console import RenderableType
from rich.text import Text

from network_calib.result import LRF_PARAMETER_NAMES, CalibratedLrf
from nodes.report.tables import length, plain_table, plus_minus, share

INDEX = {name: k for k, name in enumerate(LRF_PARAMETER_NAMES)}


def lrf_tables(lrfs: Sequence[CalibratedLrf]) -> list[RenderableType]:
    """The tables, none where there is no LRF."""
    if not lrfs:
        return []
    tables = [_pose_table(lrfs), _axis_table(lrfs), _paper_table(lrfs), _instrument_table(lrfs), _tilt_table(lrfs)]
    return [*tables, _sighting_table(lrfs), *(_held(lrf) for lrf in lrfs), *_notes(lrfs)]


def _pose_table(lrfs: Sequence[CalibratedLrf]) -> RenderableType:
    heads = ("at tilt, °", "x", "y", "z", "rot. σ, °")
    table = plain_table("Laser range finders: origins in the world frame, m", "LRF", *heads)
    for lrf in lrfs:
        table.add_row(
            Text(lrf.name),
            f"{math.degrees(lrf.reference_tilt_rad):.3f}",
            *(_metres(float(v), float(s)) for v, s in zip(lrf.world_from_lrf.translation, lrf.sigma[3:6], strict=True)),
            f"{math.degrees(float(np.linalg.norm(lrf.sigma[:3]))):.2g}",
        )
    return table


def _axis_table(lrfs: Sequence[CalibratedLrf]) -> RenderableType:
    heads = ("direction", "nearest point, m", "turn σ, °", "shift σ")
    table = plain_table("Tilt axes in the world frame", "LRF", *heads)
    for lrf in lrfs:
        turn, shift = lrf.sigma[INDEX["axis_turn_1_rad"] :][:2], lrf.sigma[INDEX["axis_shift_1"] :][:2]
        table.add_row(
            Text(lrf.name),
            " ".join(f"{value:+.4f}" for value in lrf.axis_direction_in_world),
            " ".join(f"{value:+.4f}" for value in lrf.axis_point_in_world),
            f"{math.degrees(float(np.linalg.norm(turn))):.2g}",
            length(float(np.linalg.norm(shift)), "m"),
        )
    return table


def _paper_table(lrfs: Sequence[CalibratedLrf]) -> RenderableType:
    table = plain_table("Mirror beside its tilt axis", "LRF", "dx, mm", "dz, mm", "mount roll, °", "mount yaw, °")
    for lrf in lrfs:
        values = (lrf.dx_m, lrf.dz_m, lrf.mount_roll_rad, lrf.mount_yaw_rad)
        units = (1e3, 1e3, math.degrees(1), math.degrees(1))
        cells = [
            plus_minus(unit * value, unit * float(sigma))
            for unit, value, sigma in zip(units, values, lrf.paper_sigma, strict=True)
        ]
        table.add_row(Text(lrf.name), *cells)
    return table


def _instrument_table(lrfs: Sequence[CalibratedLrf]) -> RenderableType:
    heads = ("tilt gain", "range bias, mm", "range scale", "bearing zero, °", "clock offset, ms")
    table = plain_table("Instruments", "LRF", *heads)
    for lrf in lrfs:
        units = (1.0, 1e3, 1.0, math.degrees(1), 1e3)
        cells = [
            plus_minus(unit * float(value), unit * float(sigma))
            for unit, value, sigma in zip(units, lrf.instrument, lrf.sigma[INDEX["tilt_gain"] :], strict=True)
        ]
        table.add_row(Text(lrf.name), *cells)
    return table


def _tilt_table(lrfs: Sequence[CalibratedLrf]) -> RenderableType:
    table = plain_table("Tilt settings, °", "LRF", "setting", "angle")
    for lrf in lrfs:
        for k, (angle, sigma) in enumerate(zip(lrf.tilt_rad, lrf.tilt_sigma_rad, strict=True)):
            name = Text(lrf.name) if k == 0 else Text("")
            table.add_row(name, str(k), plus_minus(math.degrees(angle), math.degrees(sigma)))
    return table


def _sighting_table(lrfs: Sequence[CalibratedLrf]) -> RenderableType:
    heads = ("spots", "inliers", "range RMS", "bearing RMS, °", "out of plane RMS")
    table = plain_table("Sightings of the spot in the scan plane", "LRF", *heads)
    for lrf in lrfs:
        table.add_row(
            Text(lrf.name),
            str(lrf.n_sightings),
            share(lrf.n_inliers, lrf.n_sightings),
            length(lrf.range_rms_m, "m"),
            f"{math.degrees(lrf.bearing_rms_rad):.3f}" if math.isfinite(lrf.bearing_rms_rad) else "–",
            length(lrf.out_of_plane_rms_m, "m"),
        )
    return table


def _held(lrf: CalibratedLrf) -> Text:
    names = [name.replace("_", " ") for name in lrf.held]
    held = ", ".join(name.removesuffix(" rad").removesuffix(" m").removesuffix(" s") for name in names)
    return Text.assemble((f"{lrf.name}: ", "bold"), f"held, not estimated: {held or 'nothing'}.")


def _notes(lrfs: Sequence[CalibratedLrf]) -> list[Text]:
    """What of the tables above is not of the joint solve, where there was one."""
    if all("cameras" in lrf.held for lrf in lrfs):
        return []
    return [Text("Hold-out and other seeds above: of the cameras alone, before the LRFs joined.")]


def _metres(value: float, sigma: float) -> str:
    return plus_minus(value, sigma, max_decimals=5)
