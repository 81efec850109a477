"""The metre of the ranges against that of the cameras: for a network without an anchor, and for the registration.

Registration takes the scale as it is; only the joint solve weighs ranges and anchor. So the LRFs are registered to the
network in the scale of the ranges, and then brought into the scale that the joint solve shall begin with.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.scanner import TiltingScanner
from network_calib.errors import DegenerateError
from network_calib.gauge import Similarity
from network_calib.observations import FloatArray
from network_calib.spots import located

# Ranges to spots that stand closer together than this say little of the scale.
MIN_DISTANCE_M = 0.3
MIN_DISTANCES = 10
# An anchor that is further from the ranges is in another unit, or of other cameras, and the registration says so.
MAX_START_DIFFERENCE = 0.1
# Within this many of its own sigma the anchor gives way, and the ranges' scale is the better one to begin with.
MAX_SCALE_SIGMA = 5.0


def scale_by_ranges(network_points: FloatArray, data: LrfData) -> float:
    """Metres for each unit of the cameras' world, from distances between spots of one tilt setting.

    A distance does not depend on where the scanner stands. Wrong pairs are outvoted: of all ratios, the middle of the
    shortest interval that holds half of them counts.

    Args:
        network_points: (F, 3) spots by the cameras, NaN where not located.
        data: LRF sightings.

    Raises:
        DegenerateError: fewer than ten distances of 0.3 m or more.
    """
    spots = data.spots
    flat = np.stack([spots.range_m * np.cos(spots.bearing_rad), spots.range_m * np.sin(spots.bearing_rad)], axis=1)
    is_usable = (data.point >= 0) & located(network_points)[np.maximum(data.point, 0)]
    log_ratios = [np.empty(0)]
    for setting in range(len(data.settings.angle_rad)):
        rows = np.flatnonzero(is_usable & (spots.setting == setting))
        a, b = (rows[side] for side in np.triu_indices(len(rows), 1))
        by_lrf = np.linalg.norm(flat[a] - flat[b], axis=1)
        by_cameras = np.linalg.norm(network_points[data.point[a]] - network_points[data.point[b]], axis=1)
        is_far = (by_lrf >= MIN_DISTANCE_M) & (by_cameras > 0)
        log_ratios.append(np.log(by_lrf[is_far] / by_cameras[is_far]))
    ratios = np.sort(np.concatenate(log_ratios))
    if len(ratios) < MIN_DISTANCES:
        raise DegenerateError(
            f"no metric scale: {len(ratios)} distances between spots in a scan plane, {MIN_DISTANCES} are needed",
            advice="Cross the scan planes more often in view of two cameras, or give the distance of two cameras.",
        )
    half = len(ratios) // 2
    first = int(np.argmin(ratios[half:] - ratios[: len(ratios) - half]))
    return float(np.exp((ratios[first] + ratios[first + half]) / 2))


def in_scale_of_ranges(network: NetworkData, data: LrfData) -> tuple[NetworkData, Similarity]:
    """The network that LRFs are registered to, and the way back from it; held cameras stay as they are."""
    same = Similarity(1.0, np.eye(3), np.zeros(3))
    if network.is_held:
        return network, same
    try:
        factor = scale_by_ranges(network.points, data)
    except DegenerateError:
        # An anchor tells metres all the same.
        return network, same
    if abs(factor - 1) > MAX_START_DIFFERENCE:
        return network, same
    first = network.cameras.centres_in_world[0]
    motion = Similarity(factor, np.eye(3), (1 - factor) * first)
    moved = replace(network, cameras=motion.apply_to_cameras(network.cameras), points=motion.apply(network.points))
    return moved, Similarity(1 / factor, np.eye(3), (1 - 1 / factor) * first)


def start_of_joint_solve(
    network: NetworkData, registered: NetworkData, scanners: tuple[TiltingScanner, ...], back: Similarity
) -> tuple[NetworkData, tuple[TiltingScanner, ...]]:
    """Network and scanners in the scale of the ranges, or of the anchor where this is too certain to give way.

    Args:
        network: in the scale of the anchor.
        registered: in the scale of the ranges.
        scanners: registered to it.
        back: from the latter scale to the former.
    """
    known = network.baseline
    if known is None or abs(back.scale - 1) <= MAX_SCALE_SIGMA * known.sigma_m / known.distance_m:
        return registered, scanners
    return network, tuple(replace(scanner.moved_by(back), range_scale=scanner.range_scale) for scanner in scanners)
