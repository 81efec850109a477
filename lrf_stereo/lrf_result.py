"""From a joint solve to what the result file says of each LRF: pose, axis, the paper's offsets, each with its sigma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lrf_stereo.calibrate import LrfCalibration
from lrf_stereo.joint_problem import LrfData, NetworkData
from lrf_stereo.lrf_block import TILTS
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.scanner_part import N_GEOMETRY, N_SCANNER, SCANNER_TANGENT, ScannerPart, TiltPart
from lrf_stereo.session import LrfSession
from lrf_stereo.sighting_block import spot_motion
from network_calib.observations import BoolArray, FloatArray
from network_calib.result import CalibratedLrf
from network_calib.spots import located

# Central differences: the error of the formula, step^2, and that of rounding, 1e-16 / step, are both below 1e-9.
STEP = 1e-6
HELD_CAMERAS, HELD_TILTS = "cameras", "tilt_angles"


def calibrated_lrfs(session: LrfSession, network: NetworkData, solved: LrfCalibration) -> tuple[CalibratedLrf, ...]:
    """Every LRF of a session, in its order."""
    data = LrfData.of(session.spots, session.settings, network.views, session.instrument)
    is_usable = (data.point >= 0) & located(network.points)[np.maximum(data.point, 0)]
    residual = _residuals(data, network, solved)
    return tuple(
        _calibrated(name, scanner, data, solved, residual, is_usable, is_held=network.is_held)
        for scanner, name in enumerate(session.names)
    )


def paper_numbers(scanner: TiltingScanner) -> FloatArray:
    """(4,) dx, dz, mount roll and yaw of the paper's form."""
    form = scanner.as_paper()
    return np.array([form.dx_m, form.dz_m, form.mount_roll_rad, form.mount_yaw_rad])


def paper_sigma(scanner: TiltingScanner, covariance: FloatArray) -> FloatArray:
    """(4,) standard deviations of `paper_numbers`, by the delta method.

    Args:
        scanner: where.
        covariance: (15, 15) of its tangent.
    """
    part = ScannerPart.from_scanners((scanner,), np.arange(N_SCANNER)[None])

    def moved(k: int, step: float) -> FloatArray:
        tangent = np.zeros(N_SCANNER)
        tangent[k] = step
        return paper_numbers(part.retract(tangent).apply_to((scanner,))[0])

    slopes = np.stack([(moved(k, STEP) - moved(k, -STEP)) / (2 * STEP) for k in range(N_GEOMETRY)], axis=1)
    return np.sqrt(np.maximum(np.diag(slopes @ covariance[:N_GEOMETRY, :N_GEOMETRY] @ slopes.T), 0.0))


def _calibrated(
    name: str,
    index: int,
    data: LrfData,
    solved: LrfCalibration,
    residual: FloatArray,
    is_usable: BoolArray,
    *,
    is_held: bool,
) -> CalibratedLrf:
    scanner, covariance = solved.refined.scanners[index], solved.covariance.scanners[index]
    own_settings = np.flatnonzero(data.settings.scanner == index)
    own = np.isin(data.spots.setting, own_settings)
    is_inlier = own & solved.refined.is_inlier
    rms = np.sqrt((residual[:, is_inlier] ** 2).mean(axis=1))
    dx_m, dz_m, roll, yaw = paper_numbers(scanner).tolist()
    return CalibratedLrf(
        name=name,
        world_from_lrf=scanner.world_from_lrf,
        reference_tilt_rad=scanner.reference_tilt_rad,
        axis_direction_in_world=scanner.axis_direction_in_world,
        axis_point_in_world=scanner.axis_point_in_world,
        instrument=scanner.instrument,
        covariance=covariance,
        dx_m=dx_m,
        dz_m=dz_m,
        mount_roll_rad=roll,
        mount_yaw_rad=yaw,
        paper_sigma=paper_sigma(scanner, covariance),
        tilt_rad=solved.refined.tilt_rad[own_settings],
        tilt_sigma_rad=np.sqrt(np.diag(solved.covariance.tilts)[own_settings]),
        n_sightings=int((own & is_usable).sum()),
        n_inliers=int(is_inlier.sum()),
        range_rms_m=float(rms[0]),
        bearing_rms_rad=float(rms[1]),
        out_of_plane_rms_m=float(rms[2]),
        held=_held(index, data, solved, is_held=is_held),
    )


def _held(index: int, data: LrfData, solved: LrfCalibration, *, is_held: bool) -> tuple[str, ...]:
    """What stayed as given: instrument numbers, tilt angles that are trusted, the cameras."""
    is_free = np.concatenate([np.ones(N_GEOMETRY, dtype=bool), data.instrument[index].as_array() > 0])
    names = [name for name, free in zip(SCANNER_TANGENT, is_free, strict=True) if not free]
    tilts = solved.refined.state.parts[TILTS]
    assert isinstance(tilts, TiltPart)
    own = np.flatnonzero(data.settings.scanner == index)
    # The reference setting is held always: it is where the pose is stated.
    trusted = [HELD_TILTS] if (tilts.columns[own[1:]] < 0).any() else []
    return (*names, *trusted, *([HELD_CAMERAS] if is_held else []))


def _residuals(data: LrfData, network: NetworkData, solved: LrfCalibration) -> FloatArray:
    """(3, M) predicted less measured range, bearing and height; NaN where the spot was not used."""
    refined, spots = solved.refined, data.spots
    motion = spot_motion(replace(network, cameras=refined.cameras, points=refined.points), data, refined.scanners)
    out = np.full((3, len(spots)), np.nan)
    for index, scanner in enumerate(refined.scanners):
        rows = np.flatnonzero(refined.is_inlier & (data.settings.scanner[spots.setting] == index))
        tilt_rad = refined.tilt_rad[spots.setting[rows]]
        moved = motion.displacement_m(spots.delay_s + scanner.clock_offset_s)[rows]
        at_beam = refined.points[data.point[rows]] + moved
        out[:, rows] = np.stack(scanner.measure(at_beam, tilt_rad)) - data.measured[:, rows]
    out[1] = (out[1] + np.pi) % (2 * np.pi) - np.pi
    return out
