"""Equations 10 to 13: from the LRF's poses at a few tilts to its pose at any tilt; as printed, and in general.

As printed (`paper_axis`) the radius comes from the circle through three origins and the LRF is taken to sit straight
above the axis (dx = 0), parallel to it. Both are wrong in general: the circle is ill-conditioned on a short arc, and
with dx the predicted origin is off by 2 sin(|a - a0| / 2) |(dx, dz) - (0, d)|.

In general (`screw_axis`) the axis is any line, and with known angles every pose speaks of it linearly:
t_i = q + R(n, a_i - a_0) (t_0 - q).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.scanner import TiltingScanner
from network_calib.errors import DegenerateError, InputError
from network_calib.observations import FloatArray

MIN_SPAN_RAD = float(np.deg2rad(5))


def circumradius(origins_in_cam: FloatArray) -> float:
    """Equation 10: radius of the circle through three LRF origins (3, 3), in the unit of the origins.

    Raises:
        DegenerateError: the origins lie on one line, so that no circle passes through them.
    """
    sides = origins_in_cam - np.roll(origins_in_cam, 1, axis=0)
    area = float(np.linalg.norm(np.cross(sides[0], sides[1]))) / 2
    product = float(np.prod(np.linalg.norm(sides, axis=1)))
    if area <= 1e-12 * float((sides**2).sum()):
        raise DegenerateError(
            "the LRF origins at the three tilts lie on one line: equation 10 has no circle",
            advice="Use three tilts farther apart, or the method `screw`, which needs no circle.",
        )
    return product / (4 * area)


def axis_from_lrf(radius_m: float, tilt_rad: float) -> RigidTransform:
    """Equation 11: pose of the LRF in the frame I of the tilt axis, L(alpha)_T_I, as printed."""
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    return RigidTransform.from_matrix([[c, 0, s, radius_m * s], [0, 1, 0, 0], [-s, 0, c, radius_m * c], [0, 0, 0, 1]])


def cam_from_axis(cam_from_lrf: RigidTransform, radius_m: float, tilt_rad: float) -> RigidTransform:
    """Equation 13: pose of the frame I in the camera, from the LRF's pose at one tilt."""
    return cam_from_lrf * axis_from_lrf(radius_m, tilt_rad).inv()


def paper_axis(cam_from_lrf: RigidTransform, tilt_rad: FloatArray) -> TiltingScanner:
    """Equations 10, 11, 13 and 12 as printed, anchored at the first tilt; the world is the camera's frame.

    Args:
        cam_from_lrf: batch of three poses.
        tilt_rad: (3,) their tilts.

    Raises:
        InputError: not exactly three poses and tilts.
        DegenerateError: the origins lie on one line.
    """
    if cam_from_lrf.shape != (3,) or len(tilt_rad) != 3:
        raise InputError(
            f"the paper's circle needs exactly 3 tilts, got {len(tilt_rad)} and {cam_from_lrf.shape} poses"
        )
    radius = circumradius(cam_from_lrf.translation)
    # Equation 12 is equation 3 with dx = 0 and dz = d.
    axis = cam_from_axis(cam_from_lrf[0], radius, float(tilt_rad[0]))
    return TiltingScanner.from_paper(axis, 0.0, radius, reference_tilt_rad=float(tilt_rad[0]))


def screw_axis(cam_from_lrf: RigidTransform, tilt_rad: FloatArray) -> TiltingScanner:
    """The general axis and the pose at the mean tilt, by linear least squares; the world is the camera's frame.

    Args:
        cam_from_lrf: batch of T poses, T >= 2.
        tilt_rad: (T,) their tilts, known.

    Raises:
        InputError: numbers of poses and tilts differ.
        DegenerateError: fewer than two tilts, or tilts that span less than 5 degrees.
    """
    if cam_from_lrf.shape != (len(tilt_rad),):
        raise InputError(f"each pose needs its tilt, got {cam_from_lrf.shape} poses and {len(tilt_rad)} tilts")
    _refuse_short_span(tilt_rad)
    reference = float(np.mean(tilt_rad))
    direction = _axis_direction(cam_from_lrf.rotation, tilt_rad)
    turn = Rotation.from_rotvec((tilt_rad - reference)[:, None] * direction)
    # Each pose, turned back to the reference, is one vote for the rotation there.
    rotation = (turn.inv() * cam_from_lrf.rotation).mean()
    origin, point = _origin_and_point(cam_from_lrf.translation, turn.as_matrix())
    return TiltingScanner(RigidTransform.from_components(origin, rotation), direction, point, reference)


def _axis_direction(rotation: Rotation, tilt_rad: FloatArray) -> FloatArray:
    """(3,) mean over pairs of log(R_j R_i^T) = (a_j - a_i) n: least squares, so each log counts by its angle."""
    first, second = np.triu_indices(len(tilt_rad), 1)
    matrices = rotation.as_matrix()
    logs = Rotation.from_matrix(matrices[second] @ np.swapaxes(matrices[first], 1, 2)).as_rotvec()
    total = (tilt_rad[second] - tilt_rad[first]) @ logs
    return total / np.linalg.norm(total)


def _origin_and_point(origins: FloatArray, turns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least squares of t_i = (I - R_i) q + R_i t for the origin t at the reference and the axis point q.

    Along the axis q is free; the shortest solution is the foot point.
    """
    n = len(origins)
    design = np.concatenate([turns.reshape(3 * n, 3), (np.eye(3) - turns).reshape(3 * n, 3)], axis=1)
    solution = np.asarray(np.linalg.lstsq(design, origins.ravel(), rcond=1e-10)[0], dtype=np.float64)
    return solution[:3], solution[3:]


def _refuse_short_span(tilt_rad: FloatArray) -> None:
    if len(tilt_rad) < 2:
        raise DegenerateError(
            f"a tilt axis needs 2 tilts or more, got {len(tilt_rad)}", advice="Repeat the waving at another tilt."
        )
    span = float(np.ptp(tilt_rad))
    if not span >= MIN_SPAN_RAD:
        raise DegenerateError(
            f"the tilts span {np.rad2deg(span):.1f} degrees: the tilt axis is unobservable below "
            f"{np.rad2deg(MIN_SPAN_RAD):.0f}, because the LRF origin moves by no more than span x distance",
            advice="Add a tilt at least 20 degrees away.",
        )
