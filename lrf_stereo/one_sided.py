"""The bias that one-sided crossings leave: no residual shows it, so the covariance has to carry it.

A spot that is taken when it first touches the scan plane is off the plane to the same side every time. A scanner that
stands that much higher along its own z would report the same, at every tilt and wherever the cameras are: the bias
goes into the scanner's position as it is, and however many sightings there are, it does not average out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lrf_stereo.joint_data import LrfData
from lrf_stereo.lrf_block import SCANNERS
from lrf_stereo.refine import LrfCovariance, LrfRefined
from lrf_stereo.scanner_part import N_SCANNER, ScannerPart
from network_calib.camera_block import cameras_of
from network_calib.observations import BoolArray, FloatArray


def common_height_sigma_m(data: LrfData, is_inlier: BoolArray, scanner: int) -> float:
    """Standard deviation of the height that the used sightings (M,) of a scanner share.

    One-sided crossings are off by up to their bound, all by the same part of it, taken as uniform; two-sided ones
    pull the scanner back by their weight.
    """
    rows = is_inlier & (data.settings.scanner[data.spots.setting] == scanner)
    weight = data.spots.sigma_out_of_plane_m[rows] ** -2.0
    total = float(weight.sum())
    return float(weight @ data.spots.bias_bound_m[rows]) / total / np.sqrt(3) if total > 0 else 0.0


def with_common_height(spread: LrfCovariance, refined: LrfRefined, data: LrfData) -> LrfCovariance:
    """The covariance with what one-sided crossings may be wrong by: along each scanner's z, at its reference tilt."""
    part = refined.state.parts[SCANNERS]
    assert isinstance(part, ScannerPart)
    first = cameras_of(refined.state.parts).size
    own, joint = spread.scanners.copy(), spread.joint.copy()
    for scanner, pose in enumerate(refined.scanners):
        shift = _shift(pose.world_from_lrf.rotation.as_matrix()[:, 2])
        shift *= common_height_sigma_m(data, refined.is_inlier, scanner)
        own[scanner] += np.outer(shift, shift)
        columns = part.columns[scanner]
        is_free = columns >= 0
        rows = first + columns[is_free]
        joint[np.ix_(rows, rows)] += np.outer(shift[is_free], shift[is_free])
    return replace(spread, scanners=own, joint=joint)


def _shift(direction_in_world: FloatArray) -> FloatArray:
    """(15,) tangent of moving the scanner, and not its axis."""
    tangent = np.zeros(N_SCANNER)
    tangent[3:6] = direction_in_world
    return tangent
