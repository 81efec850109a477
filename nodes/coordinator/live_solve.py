"""A first calibration while the person still waves: on few instants, thinned evenly; runs in a process of its own.

What cannot be solved yet is no error but the reason why not.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from network_calib.calibrate import calibrate
from network_calib.cameras import Cameras, cam_from_img
from network_calib.candidates import Candidates
from network_calib.choose import choose
from network_calib.errors import InputError, SpotcalError
from network_calib.formats.recording import Recording, digest
from network_calib.observations import FloatArray, IntArray, Observations
from network_calib.result import Calibration
from network_calib.room_setup import CameraSetup, Options
from network_calib.triangulate import triangulate_robust
from nodes.camera.camera_detections import CameraDetections
from nodes.camera.matching_frames import candidates_of, match_frames
from nodes.config import resolve
from nodes.config_model import RoomConfig
from nodes.coordinator.live_result import LiveResult
from nodes.coordinator.room_cells import emptiest_place

MAX_INSTANTS = 400
MIN_INSTANTS = 40
# An honest ray misses its spot by no more while the lenses are still roughly known.
TOLERANCE_PX = 5.0


@dataclass(frozen=True, slots=True)
class LiveInput:
    """What a try is made of.

    Attributes:
        recordings: of the cameras that saw a spot.
        room: what is known of the cameras, and the anchor.
        stride: of so many instants one was kept in the recordings.
        seed: of all random draws.
    """

    recordings: tuple[CameraDetections, ...]
    room: RoomConfig
    stride: int = 1
    seed: int = 0


def solve_live(given: LiveInput) -> LiveResult:
    """Try to calibrate; never raises what a person could act on."""
    begin = time.monotonic()
    try:
        result = _solve(given)
    except SpotcalError as error:
        result = LiveResult(not_yet=error.message, advice=error.advice)
    return replace(result, seconds=time.monotonic() - begin)


def thinned(candidates: Candidates, *, most: int) -> tuple[Candidates, int]:
    """The candidates of at most so many instants that two cameras or more saw, evenly spread, and how many there were.

    Args:
        candidates: of all instants.
        most: instants.
    """
    is_group = candidates.is_best
    frames, n_cameras = np.unique(candidates.frame[is_group], return_counts=True)
    common = frames[n_cameras > 1]
    taken = common[np.unique(np.linspace(0, len(common) - 1, min(most, len(common))).astype(np.int64))]
    is_kept = np.isin(candidates.frame, taken)
    stamp_ns = None if candidates.stamp_ns is None else candidates.stamp_ns[is_kept]
    few = Candidates(
        candidates.camera_names,
        candidates.camera[is_kept],
        candidates.frame[is_kept],
        candidates.px[is_kept],
        candidates.sigma_px[is_kept],
        candidates.score[is_kept],
        stamp_ns,
    )
    return few, len(common)


def known_of(room: RoomConfig, names: Sequence[str]) -> RoomConfig:
    """The room with no other cameras than those that saw a spot, so that the others hinder nobody."""
    return room.model_copy(update={"cameras": [camera for camera in room.cameras if camera.name in names]})


def predicted_sigma(calibration: Calibration, *, n_used: int, n_instants: int) -> tuple[float, str]:
    """Standard deviation of the worst centre once all instants are solved for, and the camera it is of.

    Independent noise averages out with the root of the number of instants.
    """
    sigmas = [float(np.sqrt(np.linalg.eigvalsh(c.covariance[3:6, 3:6])[-1].clip(0))) for c in calibration.cameras]
    worst = int(np.argmax(sigmas))
    return sigmas[worst] * float(np.sqrt(n_used / n_instants)), calibration.cameras[worst].name


def _solve(given: LiveInput) -> LiveResult:
    recordings = given.recordings
    if len(recordings) < 2:
        seeing = ", ".join(recording.name for recording in recordings) or "no camera"
        raise InputError(f"{seeing} saw the spot, a network needs two", advice="Wave where two cameras look.")
    matched = match_frames(recordings, tolerance_ns=given.room.tolerance_ns)
    candidates, n_common = thinned(candidates_of(recordings, matched), most=MAX_INSTANTS)
    n_instants = n_common * given.stride
    if n_common < MIN_INSTANTS:
        return LiveResult(
            not_yet=f"{n_common} instants were seen by two cameras, {MIN_INSTANTS} are needed for a first look",
            advice="Wave where several cameras look.",
            n_instants=n_instants,
        )
    calibration, observations = _calibrated(candidates, given)
    n_used = len(np.unique(observations.frame))
    sigma, worst = predicted_sigma(calibration, n_used=n_used, n_instants=max(n_instants, n_used))
    cameras = calibration.as_cameras()
    emptiest = emptiest_place(_spots(observations, cameras), cameras, unit=calibration.world.unit)
    return LiveResult("", "", n_instants, n_used, sigma, worst, calibration.world.unit, emptiest)


def _calibrated(candidates: Candidates, given: LiveInput) -> tuple[Calibration, Observations]:
    sizes_px = {recording.name: recording.size_px for recording in given.recordings}
    chosen = choose(candidates, rng=np.random.default_rng(given.seed), size_px=sizes_px)
    setups = tuple(CameraSetup(name, size_px) for name, size_px in sizes_px.items())
    recording = Recording("live", chosen.observations, setups, None, (), digest(chosen.observations))
    resolved = resolve(recording, known_of(given.room, tuple(sizes_px)))
    calibration = calibrate(
        resolved.observations,
        resolved.setups,
        anchor=resolved.anchor,
        options=_quick(resolved.options),
        seed=given.seed,
        input_name="live",
    )
    return calibration, resolved.observations


def _quick(options: Options) -> Options:
    """Without the extra fits that only the final result needs; frames have other numbers here than in the end."""
    return replace(options, n_repeats=1, holdout_share=0.0, floor_frames=())


def _spots(observations: Observations, cameras: Cameras) -> FloatArray:
    """(n, 3) positions of the spots, in the world."""
    rows = observations.in_frames_with_views(2)
    intrinsics, is_fisheye = cameras.intrinsics[rows.camera], cameras.is_fisheye[rows.camera]
    ray_xy, has_ray = cam_from_img(intrinsics, is_fisheye, rows.px)
    camera: IntArray = rows.camera[has_ray]
    _, point = np.unique(rows.frame[has_ray], return_inverse=True)
    tolerance = TOLERANCE_PX / cameras.intrinsics[camera, 0]
    points, is_valid, _ = triangulate_robust(
        camera,
        point,
        ray_xy[has_ray],
        cameras.rotations,
        cameras.centres_in_world,
        int(point.max(initial=-1)) + 1,
        tolerance=tolerance,
    )
    return points[is_valid]
