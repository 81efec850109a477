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
from lrf_stereo.held_cameras import BY_RANGES, CameraSpread
from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.joint_frame import JointFrame
from lrf_stereo.lrf_result import calibrated_lrfs
from lrf_stereo.range_scale import scale_by_ranges
from lrf_stereo.refine import scale_sigma
from lrf_stereo.session import LrfSession
from network_calib.assess import Assessed, Optimum, assess
from network_calib.calibrate import InputId, calibration_of, find_optimum, now_utc, program_version, provenance_of
from network_calib.errors import ConvergenceError, DegenerateError, InputError
from network_calib.evaluate import with_cameras
from network_calib.observations import Observations
from network_calib.optimum import Progress
from network_calib.refine import MIN_SIGMA_PX
from network_calib.result import Calibration, Doubt, Provenance, WorldFrame
from network_calib.room_setup import (
    Anchor,
    CameraSetup,
    Knowledge,
    KnownCentres,
    KnownDistance,
    KnownPoints,
    Options,
    UnitScale,
)
from network_calib.spots import SpotViews, locate, located

# Distances between spots of narrow pairs are long by a percent, from the noise of their depth alone.
MAX_SCALE_DIFFERENCE = 0.01


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
    network = _network(assessed, baseline)
    frame = JointFrame.of(anchor, options, network.views, network.cameras.names)
    solved = _calibrated(network, lrfs, options.rejection, seed, frame=frame)
    report("done", 1.0)
    moved = _moved(assessed, solved, _world(assessed.world, anchor, frame, lrfs, solved))
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

    The LRFs' covariances hold what the cameras may be wrong by (`held_cameras.py`). LRFs of the calibration with other
    names stay.

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
    solved = _calibrated(network, lrfs, rejection, seed, held=CameraSpread.of(calibration))
    others = tuple(lrf for lrf in calibration.lrfs if lrf.name not in lrfs.names)
    return replace(
        calibration,
        lrfs=(*others, *calibrated_lrfs(lrfs, network, solved)),
        warnings=(*calibration.warnings, *_named(solved.doubts, lrfs)),
        provenance=_extended(calibration.provenance, source or InputId()),
    )


def _calibrated(
    network: NetworkData,
    lrfs: LrfSession,
    rejection: float,
    seed: int,
    *,
    frame: JointFrame | None = None,
    held: CameraSpread | None = None,
) -> LrfCalibration:
    """`calibrate_lrfs` of a session; a refusal says when ranges and cameras do not agree about the metre."""
    rng = np.random.default_rng(seed)
    try:
        return calibrate_lrfs(
            network, lrfs.spots, lrfs.settings,
            rng=rng, instrument=lrfs.instrument, rejection=rejection, frame=frame, held=held,
        )  # fmt: skip
    except (DegenerateError, ConvergenceError) as error:
        data = LrfData.of(lrfs.spots, lrfs.settings, network.views, lrfs.instrument)
        try:
            off = 1 / scale_by_ranges(network.points, data) - 1
        except DegenerateError:
            raise error from None
        if abs(off) < MAX_SCALE_DIFFERENCE:
            raise
        word = "longer" if off > 0 else "shorter"
        message = f"{error.message}; and the cameras' metres are {100 * abs(off):.1f} % {word} than those of the ranges"
        advice = "Check the distance or positions that tell the cameras' metres, their sigma, and the unit of range_m."
        raise type(error)(message, advice=advice) from error


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
    # The residuals of a few positions may be small by chance; their own places are not known better than this.
    relative = max(assessed.world.scale_sigma, _relative_location_sigma(assessed, anchor))
    return KnownDistance(cameras.names[a], cameras.names[b], distance_m, relative * distance_m)


def _relative_location_sigma(assessed: Assessed, anchor: Anchor) -> float:
    """What the images alone let the scale of given positions be wrong by."""
    if isinstance(anchor, KnownCentres):
        rows = [assessed.refined.cameras.names.index(name) for name in anchor.names]
        spread, given = assessed.spread.cameras[rows, 3:6, 3:6], anchor.centres_in_world_m
    elif isinstance(anchor, KnownPoints):
        number = np.cumsum(located(assessed.refined.points)) - 1
        rows = number[np.searchsorted(assessed.views.frames, anchor.frames)]
        spread, given = assessed.spread.spots[rows], anchor.points_in_world_m
    else:
        return 0.0
    variance = float(np.trace(spread, axis1=1, axis2=2).mean()) / 3
    return float(np.sqrt(variance / ((given - given.mean(axis=0)) ** 2).sum()))


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
    """The assessed network with the cameras and spots of the joint solve, and their covariance.

    Hold-out and repeats stay those of the cameras alone.
    """
    refined = replace(assessed.refined, cameras=solved.refined.cameras, points=solved.refined.points)
    spread = replace(assessed.spread, cameras=solved.covariance.cameras, spots=solved.covariance.points)
    return replace(assessed, world=world, refined=refined, spread=spread)


def _world(
    world: WorldFrame, anchor: Anchor, frame: JointFrame, lrfs: LrfSession, solved: LrfCalibration
) -> WorldFrame:
    """The frame with the words of its scale, which ranges and anchor share, and the sigma of this scale."""
    source = world.scale_source
    if frame.given is not None:
        rms_m = frame.rms_m(solved.refined.cameras, solved.refined.points)
        kind = "camera centres" if len(frame.given.cameras) else "points"
        source = f"{len(frame.given.in_world_m)} given {kind}, met within {rms_m:.4g} m RMS"
    ranges = f"{BY_RANGES}{', '.join(lrfs.names)}"
    words = ranges if isinstance(anchor, UnitScale) else f"{source}, and {ranges}"
    return replace(world, scale_source=words, scale_sigma=scale_sigma(solved.refined, solved.covariance))


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
