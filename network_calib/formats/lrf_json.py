"""LRFs in calibration.json: the optional list `lrfs`. Lengths are in metres: with LRFs `world.unit` is "m"."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import RigidTransform

from network_calib.formats.shared_json import (
    DIGITS,
    check_sigma,
    covariance_document,
    pose_document,
    read_covariance,
    read_pose,
)
from network_calib.formats.strict_json import Node
from network_calib.observations import FloatArray
from network_calib.result import LRF_PARAMETER_NAMES, CalibratedLrf

INSTRUMENT_NAMES = ("tilt_gain", "range_bias_m", "range_scale", "bearing_zero_rad", "clock_offset_s")
# The last parameter may be missing everywhere: it then is zero and held.
CLOCK = "clock_offset_s"
PAPER_NAMES = ("dx_m", "dz_m", "mount_roll_rad", "mount_yaw_rad")
# Beside parameters, what else may have been held.
OTHERS_HELD = ("tilt_angles", "cameras")


def lrf_document(lrf: CalibratedLrf, *, world: str) -> dict[str, object]:
    """One LRF as nested dictionaries of JSON values; `world` is the name of the world frame."""
    paper = (lrf.dx_m, lrf.dz_m, lrf.mount_roll_rad, lrf.mount_yaw_rad)
    return {
        "name": lrf.name,
        "world_from_lrf": pose_document(lrf.world_from_lrf, target=f"world {world}", source=lrf.name),
        "reference_tilt_rad": float(lrf.reference_tilt_rad),
        "axis": {
            "direction_in_world": np.asarray(lrf.axis_direction_in_world).tolist(),
            "point_in_world": np.asarray(lrf.axis_point_in_world).tolist(),
        },
        "instrument": dict(zip(INSTRUMENT_NAMES, np.asarray(lrf.instrument).tolist(), strict=True)),
        "paper": {name: float(value) for name, value in zip(PAPER_NAMES, paper, strict=True)},
        "paper_sigma": dict(zip(PAPER_NAMES, np.asarray(lrf.paper_sigma).tolist(), strict=True)),
        "tilts": {
            "angle_rad": np.asarray(lrf.tilt_rad).tolist(),
            "sigma_rad": np.asarray(lrf.tilt_sigma_rad).tolist(),
        },
        "sigma": dict(zip(LRF_PARAMETER_NAMES, lrf.sigma.tolist(), strict=True)),
        "covariance": covariance_document(lrf.covariance, LRF_PARAMETER_NAMES),
        "sightings": {
            "n_sightings": int(lrf.n_sightings),
            "n_inliers": int(lrf.n_inliers),
            "range_rms_m": float(lrf.range_rms_m),
            "bearing_rms_rad": float(lrf.bearing_rms_rad),
            "out_of_plane_rms_m": float(lrf.out_of_plane_rms_m),
        },
        "held": list(lrf.held),
    }


def read_lrf(node: Node, *, world: str) -> CalibratedLrf:
    """One LRF; faults stay in the node."""
    fields = node.fields(
        *("name", "world_from_lrf", "reference_tilt_rad", "axis", "instrument", "paper", "paper_sigma", "tilts"),
        *("sigma", "covariance", "sightings", "held"),
    )
    name = fields["name"].text()
    pose = read_pose(fields["world_from_lrf"], target=f"world {world}", source=name)
    n_left_out = int(not _has_clock(fields["instrument"]))
    names = LRF_PARAMETER_NAMES[: len(LRF_PARAMETER_NAMES) - n_left_out]
    covariance = read_covariance(fields["covariance"], names)
    if covariance is not None:
        check_sigma(fields["sigma"], covariance, names)
    direction, point = _axis(fields["axis"])
    instrument = _numbers(fields["instrument"], INSTRUMENT_NAMES[: len(INSTRUMENT_NAMES) - n_left_out])
    for k in (0, 2):
        if not instrument[k] > 0:
            fields["instrument"].faults.append(
                f"{fields['instrument'].path}.{INSTRUMENT_NAMES[k]}: {instrument[k]:g}, expected a number > 0"
            )
    dx_m, dz_m, roll, yaw = _numbers(fields["paper"], PAPER_NAMES).tolist()
    tilt_rad, tilt_sigma_rad = _tilts(fields["tilts"])
    counts = fields["sightings"].fields(
        "n_sightings", "n_inliers", "range_rms_m", "bearing_rms_rad", "out_of_plane_rms_m"
    )
    return CalibratedLrf(
        name=name,
        world_from_lrf=RigidTransform.identity() if pose is None else pose,
        reference_tilt_rad=fields["reference_tilt_rad"].number(),
        axis_direction_in_world=direction,
        axis_point_in_world=point,
        instrument=np.pad(instrument, (0, n_left_out)),
        covariance=np.pad(np.zeros((len(names),) * 2) if covariance is None else covariance, (0, n_left_out)),
        dx_m=dx_m,
        dz_m=dz_m,
        mount_roll_rad=roll,
        mount_yaw_rad=yaw,
        paper_sigma=_numbers(fields["paper_sigma"], PAPER_NAMES, minimum=0.0),
        tilt_rad=tilt_rad,
        tilt_sigma_rad=tilt_sigma_rad,
        n_sightings=counts["n_sightings"].whole(),
        n_inliers=counts["n_inliers"].whole(),
        range_rms_m=counts["range_rms_m"].number_or_nan(0.0),
        bearing_rms_rad=counts["bearing_rms_rad"].number_or_nan(0.0),
        out_of_plane_rms_m=counts["out_of_plane_rms_m"].number_or_nan(0.0),
        held=(*(CLOCK,) * n_left_out, *(item.text(*names, *OTHERS_HELD) for item in fields["held"].items())),
    )


def _has_clock(instrument: Node) -> bool:
    return not isinstance(instrument.value, dict) or CLOCK in instrument.value


def _numbers(node: Node, names: tuple[str, ...], *, minimum: float = -math.inf) -> FloatArray:
    fields = node.fields(*names)
    return np.array([fields[name].number(minimum) for name in names])


def _axis(node: Node) -> tuple[FloatArray, FloatArray]:
    """Direction and foot point, which must stand at right angles."""
    n_faults = len(node.faults)
    fields = node.fields("direction_in_world", "point_in_world")
    direction = np.array(fields["direction_in_world"].numbers(3))
    point = np.array(fields["point_in_world"].numbers(3))
    if len(node.faults) == n_faults:
        if abs(float(np.linalg.norm(direction)) - 1) > DIGITS:
            fields["direction_in_world"].fail("a unit vector")
        elif abs(float(direction @ point)) > DIGITS * (1 + float(np.linalg.norm(point))):
            fields["point_in_world"].fail("the point of the axis that is nearest to the origin")
    return direction, point


def _tilts(node: Node) -> tuple[FloatArray, FloatArray]:
    fields = node.fields("angle_rad", "sigma_rad")
    angles = [item.number() for item in fields["angle_rad"].items()]
    sigmas = [item.number(0.0) for item in fields["sigma_rad"].items(len(angles))]
    return np.array(angles), np.array(sigmas)
