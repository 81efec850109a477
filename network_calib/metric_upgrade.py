"""Euclidean upgrade by the absolute dual quadric: step 4 of Svoboda, Martinec, Pajdla; weights as Pollefeys (2004).

Projective cameras P_c see the absolute dual quadric Q (4 x 4, rank 3) as w_c = P_c Q P_c^T = K_c K_c^T up to scale. In
nominal rays K_c is near diag(r, r, 1), r the focal ratio, so with the expected deviations

    skew       w_xy / r^2      0 +- 0.005        aspect   f_x / f_y     1 +- 2 %
    principal  w_xz, w_yz      0 +- 0.1          focal    r             1, within a factor 3

each weighted equation counts standard deviations. (Pollefeys expects 10 % of the aspect and 1 % of the skew, for video
cameras; sensors of today have square pixels, and it is the aspect that holds the focal length where few cameras or a
line of them hardly do.) Q = H H^T with H (4 x 3); the columns of H are the axes of the metric
frame. A linear solve gives a start, and Gauss-Newton on H itself the answer: it keeps Q of rank 3 and not negative,
which the linear solve alone violates even with honest data (as measured on real recordings). Several starts, with
different expected focal ratios, guard against a local minimum.

Chirality: projective cameras come with positive depths, so det(P_c H) has one sign for all cameras, which is made
positive; and the metric spots have one sign of their fourth coordinate, which settles the last freedom, the mirrored
or inside-out twin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from network_calib.cameras import poses_from_centres
from network_calib.errors import DegenerateError
from network_calib.observations import BoolArray, FloatArray

START_FOCAL_RATIOS = (0.6, 1.0, 1.8)
FOCAL_RATIO_LIMITS = (0.2, 5.0)
# Mean square of the deviations, in expected ones: 1 where all expectations hold, 4 where all are off by two sigma.
MAX_MEAN_SQUARE = 4.0
MIN_SHARE_IN_FRONT = 0.9
N_STEPS = 30
_ENTRIES = tuple((i, j) for i in range(4) for j in range(i, 4))


@dataclass(frozen=True, slots=True)
class MetricRoom:
    """C cameras in a metric frame of their own: right-handed, centroid of the centres at 0, their RMS distance 1.

    Attributes:
        cam_from_world: C poses.
        focal_ratio: (C,) true over nominal focal length; 1 where it is known.
        mean_square: of the deviations from square pixels and so on, in expected ones.
    """

    cam_from_world: RigidTransform
    focal_ratio: FloatArray
    mean_square: float


@dataclass(frozen=True, slots=True)
class _Expected:
    """Standard deviations of one camera's departures from the nominal one, each (C,)."""

    skew: FloatArray
    aspect: FloatArray
    principal: FloatArray
    log_focal: FloatArray

    @classmethod
    def of(cls, is_focal_known: BoolArray) -> _Expected:
        """Given intrinsics may be wrong by some percent, nominal ones are wrong."""
        return cls(
            np.full(len(is_focal_known), 0.005),
            np.full(len(is_focal_known), 0.02),
            np.where(is_focal_known, 0.03, 0.1),
            np.where(is_focal_known, 0.02, np.log(3.0)),
        )


def upgrade_to_metric(
    matrices: FloatArray, points: FloatArray, *, is_focal_known: BoolArray, names: tuple[str, ...]
) -> MetricRoom:
    """Poses and focal ratios from projective cameras.

    Args:
        matrices: (C, 3, 4) projective cameras in nominal rays, depths of the points positive.
        points: (J, 4) homogeneous spots; rows of NaN are passed over.
        is_focal_known: (C,) cameras whose focal ratio is 1.
        names: C camera names, for messages.

    Raises:
        DegenerateError: no metric frame makes the cameras plausible, or it puts spots behind the cameras.
    """
    expected = _Expected.of(is_focal_known)
    # A projective frame in which the stacked cameras have orthonormal columns makes all of H alike in size.
    _, size, vt = np.linalg.svd(matrices.reshape(-1, 4), full_matrices=False)
    matrices = matrices @ (vt.T / size)
    matrices = matrices / np.linalg.norm(matrices, axis=(1, 2))[:, None, None]
    points = points[np.isfinite(points).all(axis=1)] @ (vt.T * size)
    guesses = [np.where(is_focal_known, 1.0, ratio) for ratio in START_FOCAL_RATIOS]
    starts = np.stack([_linear_frame(matrices, expected, guess) for guess in guesses])
    frames, mean_squares = _refine_frames(starts, matrices, expected)
    order = np.argsort(mean_squares)
    best = int(order[0])
    if not mean_squares[best] <= MAX_MEAN_SQUARE:
        raise DegenerateError(
            f"no metric frame gives the cameras square pixels and a principal point near the image centre: RMS "
            f"deviation {mean_squares[best] ** 0.5:.1f} x the expected",
            advice="Wave through more of the volume, or give the intrinsics of a camera or a stereo pair as anchor.",
        )
    cam_from_world, focal_ratio = _euclidean(frames[best], matrices, points)
    focal_ratio = np.where(is_focal_known, 1.0, focal_ratio)
    _check_focal_ratios(focal_ratio, names)
    return MetricRoom(cam_from_world, focal_ratio, float(mean_squares[best]))


def _linear_frame(matrices: FloatArray, expected: _Expected, guess: FloatArray) -> FloatArray:
    """H (4, 3) of the positive part of the linear solution for Q, with guessed focal ratios (C,).

    The equations are linear in Q but their weights need w_zz: reweighted from the last solution.
    """
    xx, yy, zz = (_products(matrices, axis, axis) for axis in range(3))
    xy, xz, yz = _products(matrices, 0, 1), _products(matrices, 0, 2), _products(matrices, 1, 2)
    w_zz = np.ones(len(matrices))
    area = guess**2
    equations = [
        (xy, expected.skew * area),
        (xz, expected.principal),
        (yz, expected.principal),
        (xx - yy, 2 * expected.aspect * area),
        (xx - area[:, None] * zz, 2 * expected.log_focal * area),
        (yy - area[:, None] * zz, 2 * expected.log_focal * area),
    ]
    q = np.zeros(10)
    for _ in range(4):
        q = np.linalg.svd(np.concatenate([row / (sigma * w_zz)[:, None] for row, sigma in equations]))[2][-1]
        seen = zz @ q
        q = q * np.sign(np.median(seen))
        w_zz = np.maximum(np.abs(seen), 1e-3 * np.median(np.abs(seen)))
    quadric = np.zeros((4, 4))
    for value, (i, j) in zip(q, _ENTRIES, strict=True):
        quadric[i, j] = quadric[j, i] = value
    values, vectors = np.linalg.eigh(quadric)
    frame = vectors[:, 1:] * np.sqrt(np.maximum(values[1:], 1e-6 * values[-1]))
    return frame / np.linalg.norm(frame)


def _products(matrices: FloatArray, k: int, m: int) -> FloatArray:
    """(C, 10) coefficients of w_km in the ten entries of Q."""
    a, b = matrices[:, k], matrices[:, m]
    return np.stack([a[:, i] * b[:, j] + (a[:, j] * b[:, i] if i != j else 0.0) for i, j in _ENTRIES], axis=1)


def _refine_frames(starts: FloatArray, matrices: FloatArray, expected: _Expected) -> tuple[FloatArray, FloatArray]:
    """Levenberg-Marquardt from S starts (S, 4, 3) at once; also returns their mean squared deviations (S,).

    H has twelve entries for eight degrees of freedom (a rotation of the axes and a scale are free); the damping passes
    over the four idle ones.
    """
    frames, damping = starts.copy(), np.full(len(starts), 1e-3)
    residual, jacobian = _deviations(frames, matrices, expected)
    cost = (residual**2).sum(axis=1)
    for _ in range(N_STEPS):
        normal = jacobian.swapaxes(1, 2) @ jacobian
        size = np.trace(normal, axis1=1, axis2=2) / 12
        normal += (damping * size)[:, None, None] * np.eye(12)
        step = np.linalg.solve(normal, jacobian.swapaxes(1, 2) @ residual[..., None])[..., 0]
        trial = frames - step.reshape(-1, 4, 3)
        trial /= np.linalg.norm(trial, axis=(1, 2))[:, None, None]
        trial_residual, trial_jacobian = _deviations(trial, matrices, expected)
        trial_cost = (trial_residual**2).sum(axis=1)
        is_better = trial_cost < cost
        is_done = is_better & (trial_cost > (1 - 1e-4) * cost)
        frames[is_better], cost[is_better] = trial[is_better], trial_cost[is_better]
        residual[is_better], jacobian[is_better] = trial_residual[is_better], trial_jacobian[is_better]
        damping = np.clip(np.where(is_better, damping / 10, damping * 10), 1e-9, 1e9)
        if (is_done | (damping >= 1e6)).all():
            break
    return frames, cost / residual.shape[1]


def _deviations(frames: FloatArray, matrices: FloatArray, expected: _Expected) -> tuple[FloatArray, FloatArray]:
    """(S, 5 C) deviations in expected ones and their (S, 5 C, 12) Jacobian with respect to the entries of H."""
    axes = np.einsum("cka,sab->sckb", matrices, frames)
    w = axes @ axes.swapaxes(-1, -2)
    half = np.einsum("cka,scmb->sckmab", matrices, axes)
    dw = (half + half.swapaxes(2, 3)).reshape(*w.shape, 12)
    w = np.where(np.eye(3, dtype=bool), np.maximum(w, 1e-12), w)
    xx, yy, zz = w[..., 0, 0], w[..., 1, 1], w[..., 2, 2]
    dlog_xx, dlog_yy, dlog_zz = (dw[..., i, i, :] / w[..., i, i, None] for i in range(3))
    skew, principal_x, principal_y = w[..., 0, 1] / np.sqrt(xx * yy), w[..., 0, 2] / zz, w[..., 1, 2] / zz
    rows = [
        (
            skew,
            dw[..., 0, 1, :] / np.sqrt(xx * yy)[..., None] - skew[..., None] * (dlog_xx + dlog_yy) / 2,
            expected.skew,
        ),
        (principal_x, dw[..., 0, 2, :] / zz[..., None] - principal_x[..., None] * dlog_zz, expected.principal),
        (principal_y, dw[..., 1, 2, :] / zz[..., None] - principal_y[..., None] * dlog_zz, expected.principal),
        (np.log(xx / yy) / 2, (dlog_xx - dlog_yy) / 2, expected.aspect),
        (np.log(xx * yy / zz**2) / 4, (dlog_xx + dlog_yy - 2 * dlog_zz) / 4, expected.log_focal),
    ]
    residual = np.concatenate([value / sigma for value, _, sigma in rows], axis=1)
    jacobian = np.concatenate([slope / sigma[:, None] for _, slope, sigma in rows], axis=1)
    return residual, jacobian


def _euclidean(frame: FloatArray, matrices: FloatArray, points: FloatArray) -> tuple[RigidTransform, FloatArray]:
    """Poses and focal ratios (C,) in the metric frame whose axes are `frame` (4, 3); see the module on chirality.

    A principal point off the centre is given to the rotation: the joint engine starts with it at the centre, and so
    the image centre looks where it should.
    """
    own = matrices @ frame
    handedness = np.sign(np.linalg.det(own))
    frame, own = frame * np.sign(handedness.sum() or 1.0), own * np.sign(handedness.sum() or 1.0)
    origin = np.linalg.svd(frame.T)[2][3]  # completes H to a basis of space
    fourth = np.linalg.solve(np.column_stack([frame, origin]), points.T)[3]
    origin = origin * np.sign(np.sum(np.sign(fourth)) or 1.0)
    share = min((np.sign(fourth) == np.sign(np.median(fourth))).mean(), abs(handedness.mean() + 1e-9))
    if share < MIN_SHARE_IN_FRONT:
        raise DegenerateError(
            f"the metric frame puts {100 * (1 - share):.0f} % of the spots or cameras on the wrong side: the plane at "
            f"infinity cuts through the room",
            advice="Wave through more of the volume, or give the intrinsics of a camera or a stereo pair as anchor.",
        )
    w = own @ own.swapaxes(1, 2)
    focal_ratio = (w[:, 0, 0] * w[:, 1, 1] / w[:, 2, 2] ** 2) ** 0.25
    centres = -np.linalg.solve(own, (matrices @ origin)[..., None])[..., 0]
    centres -= centres.mean(axis=0)
    centres /= np.sqrt((centres**2).sum(axis=1).mean())
    return poses_from_centres(_rotations(own), centres), focal_ratio


def _rotations(own: FloatArray) -> FloatArray:
    """(C, 3, 3) rotations of cameras K R (C, 3, 3): z looks through the image centre, x and y share the rest."""
    z = np.linalg.solve(own, np.broadcast_to(np.array([0.0, 0.0, 1.0])[:, None], (len(own), 3, 1)))[..., 0]
    z /= np.linalg.norm(z, axis=1)[:, None]
    across = own[:, :2] - (own[:, :2] @ z[:, :, None]) * z[:, None, :]
    # The two image axes need not be orthogonal: the polar factor turns them equally.
    u, _, vt = np.linalg.svd(across, full_matrices=False)
    return np.concatenate([u @ vt, z[:, None, :]], axis=1)


def _check_focal_ratios(focal_ratio: FloatArray, names: tuple[str, ...]) -> None:
    low, high = FOCAL_RATIO_LIMITS
    wrong = np.flatnonzero((focal_ratio < low) | (focal_ratio > high))
    if len(wrong):
        listed = ", ".join(f"{names[c]} {focal_ratio[c]:.2f}" for c in wrong)
        raise DegenerateError(
            f"focal lengths relative to the image's longer side are out of {low}..{high}: {listed}",
            advice="The focal length may be unobservable: give intrinsics, or wave through more of the volume.",
        )
