"""Cameras and LRFs of a session together: the network first, then all in one joint solve, into one result.

Step 1 calibrates the cameras as `network_calib.calibrate` does. Step 2 makes them metric: by the anchor, or, where it
says nothing of metres, by the LRFs' ranges. Step 3 solves cameras, LRFs and tilt angles together, so that the ranges
improve the cameras too. `add_lrfs` takes cameras that were calibrated before, and holds them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lrf_stereo.calibrate import LrfCalibration, calibrate_lrfs
from lrf_stereo.joint_problem import LrfData, NetworkData
from lrf_stereo.lrf_result import calibrated_lrfs
from lrf_stereo.session import LrfSession
from network_calib.assess import Assessed, Optimum, assess
from network_calib.calibrate import InputId, calibration_of, find_optimum, now_utc, program_version, provenance_of
from network_calib.errors import DegenerateError, InputError
from network_calib.evaluate import with_cameras
from network_calib.gauge import Similarity
from network_calib.observations import FloatArray, Observations
from network_calib.optimum import Progress
from network_calib.refine import MIN_SIGMA_PX
from network_calib.result import Calibration, Doubt, Provenance, WorldFrame
from network_calib.room_setup import Anchor, CameraSetup, Knowledge, KnownDistance, Options, UnitScale
from network_calib.spots import SpotViews, locate, located

# Ranges to spots that stand closer together than this say little of the scale.
MIN_DISTANCE_M = 0.3
MIN_DISTANCES = 10
# A baseline that is wrong by more than this many of its own sigma is wrong, and the registration says so.
MAX_SCALE_SIGMA = 5.0


def calibrate_with_lrfs(
    observations: Observations,
    setups: Sequence[CameraSetup],
    lrfs: LrfSession,
    *,
    anchor: Anchor | None = None,
    options: Options | None = None,
    seed: int = 0,
    source: InputId | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the cameras and LRFs of a session.

    Args:
        observations: of all cameras, in the order of the setups.
        setups: what is known of each camera.
        lrfs: what the LRFs saw.
        anchor: metric scale and world frame; by default the LRFs' ranges and the first camera's frame.
        options: how to solve.
        seed: of all random draws.
        source: stands in the result.
        progress: called with the name of each step and the fraction done.

    Raises:
        InputError: input that does not fit together.
        DegenerateError: data that do not determine cameras or LRFs; says why and where to wave or tilt.
        ConvergenceError: no optimum worth reporting.
    """
    anchor, options, source = anchor or UnitScale(), options or Options(), source or InputId()
    report = progress or (lambda _step, _part: None)
    found = find_optimum(observations, setups, anchor=anchor, options=options, seed=seed, progress=report)
    metric = _metric_by_ranges(found, lrfs) if isinstance(anchor, UnitScale) else anchor
    assessed = assess(found, anchor=metric, options=options, seed=seed, progress=report)
    baseline = None if isinstance(anchor, UnitScale) else _baseline(assessed, anchor)
    report("cameras and LRFs together", 0.97)
    network = _started(_network(assessed, baseline), assessed.world.scale_sigma, lrfs)
    solved = calibrate_lrfs(
        network, lrfs.spots, lrfs.settings,
        rng=np.random.default_rng(seed), instrument=lrfs.instrument, rejection=options.rejection,
    )  # fmt: skip
    report("done", 1.0)
    moved = _moved(assessed, solved, _world(assessed.world, anchor, lrfs, solved))
    calibration = calibration_of(moved, provenance_of(found, source, anchor=anchor, options=options, seed=seed))
    return replace(
        calibration,
        lrfs=calibrated_lrfs(lrfs, network, solved),
        warnings=(*calibration.warnings, *_named(solved.doubts, lrfs)),
    )


def add_lrfs(
    calibration: Calibration,
    observations: Observations,
    lrfs: LrfSession,
    *,
    rejection: float = 4.0,
    seed: int = 0,
    source: InputId | None = None,
) -> Calibration:
    """Calibrate LRFs to cameras that were calibrated before and stay as they are.

    The LRFs' covariances are those given the cameras: what the cameras themselves may be wrong by comes on top, and
    `held` says so. LRFs of the calibration with other names stay.

    Args:
        calibration: of the cameras, metric.
        observations: of these cameras, or some of them, while the LRFs saw the spot.
        lrfs: what the LRFs saw.
        rejection: sigma beyond which a sighting is an outlier.
        seed: of all random draws.
        source: what the observations and sightings were read from; put beside the cameras' own in the result.

    Raises:
        InputError: cameras without metric scale, or observations of an unknown camera.
        DegenerateError: sightings that do not determine an LRF; says why and where to wave or tilt.
        ConvergenceError: no rigid motion agrees with the sightings of a tilt.
    """
    if calibration.world.unit != "m":
        raise InputError(
            "the calibration of the cameras has no metric scale, so LRFs cannot be added to it",
            advice="Calibrate cameras and LRFs together: the ranges give the scale.",
        )
    network = _held_network(calibration, observations, rejection)
    solved = calibrate_lrfs(
        network, lrfs.spots, lrfs.settings,
        rng=np.random.default_rng(seed), instrument=lrfs.instrument, rejection=rejection,
    )  # fmt: skip
    others = tuple(lrf for lrf in calibration.lrfs if lrf.name not in lrfs.names)
    return replace(
        calibration,
        lrfs=(*others, *calibrated_lrfs(lrfs, network, solved)),
        warnings=(*calibration.warnings, *_named(solved.doubts, lrfs)),
        provenance=_extended(calibration.provenance, source or InputId()),
    )


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


def _metric_by_ranges(found: Optimum, lrfs: LrfSession) -> KnownDistance:
    """The distance of the first two cameras in metres, which names the scale until the joint solve."""
    data = LrfData.of(lrfs.spots, lrfs.settings, found.views, lrfs.instrument)
    cameras = found.refined.cameras
    distance = float(np.linalg.norm(cameras.centres_in_world[1] - cameras.centres_in_world[0]))
    distance_m = scale_by_ranges(found.refined.points, data) * distance
    return KnownDistance(cameras.names[0], cameras.names[1], distance_m)


def _baseline(assessed: Assessed, anchor: Anchor) -> KnownDistance:
    """What the anchor says of metres, as a distance between two cameras: its own, or that of the furthest two."""
    if isinstance(anchor, KnownDistance):
        return anchor
    cameras = assessed.refined.cameras
    centres = cameras.centres_in_world
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    a, b = np.unravel_index(int(distances.argmax()), distances.shape)
    distance_m = float(distances[a, b])
    return KnownDistance(cameras.names[a], cameras.names[b], distance_m, assessed.world.scale_sigma * distance_m)


def _network(assessed: Assessed, baseline: KnownDistance | None) -> NetworkData:
    refined = assessed.refined
    return NetworkData(
        setups=assessed.setups,
        cameras=refined.cameras,
        views=assessed.views,
        points=refined.points,
        is_inlier=refined.is_inlier,
        noise=refined.noise,
        is_held=False,
        baseline=baseline,
    )


def _started(network: NetworkData, scale_sigma: float, lrfs: LrfSession) -> NetworkData:
    """The network in the scale of the ranges, where the anchor's is vague enough to allow for it.

    Registration takes the scale as it is; only the joint solve weighs ranges and baseline.
    """
    if scale_sigma <= 0:
        return network
    data = LrfData.of(lrfs.spots, lrfs.settings, network.views, lrfs.instrument)
    factor = scale_by_ranges(network.points, data)
    if abs(factor - 1) > MAX_SCALE_SIGMA * scale_sigma:
        return network
    first = network.cameras.centres_in_world[0]
    motion = Similarity(factor, np.eye(3), (1 - factor) * first)
    return replace(network, cameras=motion.apply_to_cameras(network.cameras), points=motion.apply(network.points))


def _held_network(calibration: Calibration, observations: Observations, rejection: float) -> NetworkData:
    cameras = calibration.as_cameras()
    views = SpotViews.of(with_cameras(observations, cameras.names))
    if not views.n_points:
        raise InputError("no frame was seen by two calibrated cameras: no spot is located for the LRFs")
    # The result states the noise in px; the solve takes it over the detector's own sigma.
    noise_px = np.array([camera.quality.noise_sigma_px for camera in calibration.cameras])
    of_camera = [views.sigma_px[views.camera == c] for c in range(len(cameras))]
    typical_px = np.array([np.median(sigma_px) if len(sigma_px) else 1.0 for sigma_px in of_camera])
    noise = np.maximum(np.nan_to_num(noise_px, nan=1.0), MIN_SIGMA_PX) / typical_px
    points, is_inlier = locate(cameras, views, rejection * noise[views.camera] * views.sigma_px)
    setups = [
        CameraSetup(camera.name, camera.size_px, camera.lens, Knowledge.FIXED, camera.intrinsics)
        for camera in calibration.cameras
    ]
    return NetworkData(setups, cameras, views, points, is_inlier, noise, is_held=True, baseline=None)


def _moved(assessed: Assessed, solved: LrfCalibration, world: WorldFrame) -> Assessed:
    """The assessed network with the cameras and spots of the joint solve, and their covariance."""
    refined = replace(assessed.refined, cameras=solved.refined.cameras, points=solved.refined.points)
    spread = replace(assessed.spread, cameras=solved.covariance.cameras)
    return replace(assessed, world=world, refined=refined, spread=spread)


def _world(frame: WorldFrame, anchor: Anchor, lrfs: LrfSession, solved: LrfCalibration) -> WorldFrame:
    """The frame with the words of its scale, whose sigma is in the covariances now: ranges and baseline share it."""
    centres = solved.refined.cameras.centres_in_world
    away = centres[1:] - centres[0]
    spread = solved.covariance.cameras[1:, 3:6, 3:6]
    variance = np.einsum("ci,cij,cj->c", away, spread, away)
    # The best known distance from the first camera: others add their own sigma to that of the scale.
    relative = float(np.sqrt(variance / (away**2).sum(axis=1) ** 2).min())
    ranges = f"the ranges of {', '.join(lrfs.names)}"
    words = ranges if isinstance(anchor, UnitScale) else f"{frame.scale_source}, and {ranges}"
    return replace(frame, scale_source=f"{words}; σ of {100 * relative:.2g} % within the covariances", scale_sigma=0.0)


def _extended(provenance: Provenance, source: InputId) -> Provenance:
    return replace(
        provenance,
        program_version=program_version(),
        created_utc=now_utc(),
        input_name=f"{provenance.input_name}; LRFs: {source.name}",
        input_sha256=source.sha256,
    )


def _named(doubts: Sequence[Doubt], lrfs: LrfSession) -> tuple[Doubt, ...]:
    """Doubts count the LRFs; a person calls them by name."""
    return tuple(
        replace(doubt, message=re.sub(r"^LRF (\d+):", lambda found: f"LRF {lrfs.names[int(found[1])]}:", doubt.message))
        for doubt in doubts
    )
