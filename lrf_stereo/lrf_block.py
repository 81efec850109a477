"""Residual block of the joint engine: a spot in the scan plane of a tilting LRF, and its analytic Jacobians.

A spot X is measured at tilt a as (range, bearing), and it lies in the scan plane. With theta = gain (a - a_ref) the
spot in the LRF frame is x = R' (q + Rn(-theta)(X - q) - t) + v (delay + offset): Rn is the turn about the tilt axis, q
its foot point, v the spot's velocity in the LRF frame, delay and clock offset what the beam is later than the cameras'
exposure that X belongs to. The velocity is data; given in the LRF frame, it leaves the residual as it is when the whole
world turns.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lrf_stereo.scanner_part import ScannerPart, TiltPart
from network_calib.blocks import Parts
from network_calib.observations import FloatArray, IntArray
from network_calib.robust_loss import Loss, SquaredLoss

SCANNERS, TILTS = "scanners", "tilts"
N_COLUMNS = 16
TILT = N_COLUMNS - 1


@dataclass(frozen=True, slots=True)
class LrfBlock:
    """K spots seen by LRFs: range, bearing, and zero height over the scan plane, whitened.

    Attributes:
        group: (K,) tilt setting.
        point: (K,) spot index.
        measured: (3, K) range (m), bearing (rad), out-of-plane offset (m; the crossing procedure's bias, mostly zero).
        whitening: (3, 3, K) matrices W on the left, W'W the inverse covariance of `measured` less what is predicted;
            one over the standard deviations on the diagonal where the spot stands still.
        velocity: (3, K) of the spot in the LRF frame, m/s; zero where it stands still or is not known.
        delay_s: (K,) stated time of the beam less that of the exposure.
        scanner_of_setting: (T,) scanner index.
        reference_rad: (S,) tilt at which each scanner's pose holds.
        columns: (T, 16) global columns: the scanner's 15, then the setting's angle.
        loss: robust loss.
    """

    group: IntArray
    point: IntArray
    measured: FloatArray
    whitening: FloatArray
    velocity: FloatArray
    delay_s: FloatArray
    scanner_of_setting: IntArray
    reference_rad: FloatArray
    columns: IntArray
    loss: Loss = field(default_factory=SquaredLoss)

    def take(self, rows: IntArray) -> LrfBlock:
        """The block with its rows reordered or thinned."""
        return replace(
            self,
            group=self.group[rows],
            point=self.point[rows],
            measured=np.ascontiguousarray(self.measured[:, rows]),
            whitening=np.ascontiguousarray(self.whitening[:, :, rows]),
            velocity=np.ascontiguousarray(self.velocity[:, rows]),
            delay_s=self.delay_s[rows],
        )

    def residual(self, parts: Parts, points: FloatArray, rows: slice) -> FloatArray:
        """(3, n) whitened residuals."""
        at = _Geometry.of(self, parts, points, rows)
        return _whitened(self.whitening[:, :, rows], self._difference(at, rows))

    def linearise(self, parts: Parts, points: FloatArray, rows: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (3, n), Jacobians (16, 3, n) by the shared columns and (3, 3, n) by the spot."""
        at = _Geometry.of(self, parts, points, rows)
        weight = self.whitening[:, :, rows]
        residual = _whitened(weight, self._difference(at, rows))
        # (3 components of x, 3 residuals, n)
        by_lrf = _whitened(weight, by_point_in_lrf(at.x, at.instrument[:, 2]))
        by_shared = np.zeros((N_COLUMNS, 3, len(at.theta)))
        for column, slope in enumerate(at.slopes()):
            by_shared[column] = np.einsum("imn,ni->mn", by_lrf, slope)
        by_theta = np.einsum("imn,ni->mn", by_lrf, at.by_theta())
        by_shared[10] = by_theta * at.swing
        by_shared[11] = weight[:, 0]
        by_shared[12] = np.hypot(at.x[:, 0], at.x[:, 1]) * weight[:, 0]
        by_shared[13] = weight[:, 1]
        by_shared[14] = np.einsum("imn,in->mn", by_lrf, self.velocity[:, rows])
        by_shared[TILT] = by_theta * at.instrument[:, 0]
        by_point = np.einsum("imn,nij->jmn", by_lrf, at.lrf_from_world_turn)
        return residual, by_shared, by_point

    def _difference(self, at: _Geometry, rows: slice) -> FloatArray:
        difference = at.predicted() - self.measured[:, rows]
        difference[1] = (difference[1] + np.pi) % (2 * np.pi) - np.pi
        return difference


def by_point_in_lrf(x: FloatArray, range_scale: FloatArray) -> FloatArray:
    """(3, 3, n) derivative of range, bearing, height (second axis) by x, y, z in the LRF frame (first axis).

    Args:
        x: (n, 3) spots in the LRF frame.
        range_scale: (n,).
    """
    planar2 = np.maximum(x[:, 0] ** 2 + x[:, 1] ** 2, 1e-12)
    planar = np.sqrt(planar2)
    out = np.zeros((3, 3, len(x)))
    out[0, 0], out[1, 0] = range_scale * x[:, 0] / planar, range_scale * x[:, 1] / planar
    out[0, 1], out[1, 1] = -x[:, 1] / planar2, x[:, 0] / planar2
    out[2, 2] = 1.0
    return out


def _whitened(whitening: FloatArray, values: FloatArray) -> FloatArray:
    """Matrices (3, 3, n) times columns (..., 3, n)."""
    return (whitening * values[..., None, :, :]).sum(axis=-2)


@dataclass(frozen=True, slots=True)
class _Geometry:
    """What residual and Jacobians share, for n measurements.

    Attributes:
        x: (n, 3) spot in the LRF frame when the beam hit it.
        turned: (n, 3) spot relative to the axis's foot point, turned back to the reference tilt.
        arm: (n, 3) spot relative to the LRF origin, turned back, in world.
        offset: (n, 3) spot relative to the foot point.
        lrf_from_axis: (n, 3, 3) R'.
        turn: (n, 3, 3) Rn(-theta).
        basis: (n, 3, 2) across the axis.
        direction: (n, 3) the axis.
        theta: (n,) turn about the axis, rad.
        swing: (n,) tilt over the reference tilt, rad, before the gain.
        instrument: (n, 5).
    """

    x: FloatArray
    turned: FloatArray
    arm: FloatArray
    offset: FloatArray
    lrf_from_axis: FloatArray
    turn: FloatArray
    basis: FloatArray
    direction: FloatArray
    theta: FloatArray
    swing: FloatArray
    instrument: FloatArray

    @classmethod
    def of(cls, block: LrfBlock, parts: Parts, points: FloatArray, rows: slice) -> _Geometry:
        scanners, tilts = parts[SCANNERS], parts[TILTS]
        assert isinstance(scanners, ScannerPart)
        assert isinstance(tilts, TiltPart)
        setting = block.group[rows]
        scanner = block.scanner_of_setting[setting]
        swing = tilts.angle_rad[setting] - block.reference_rad[scanner]
        instrument = scanners.instrument[scanner]
        theta = instrument[:, 0] * swing
        direction = scanners.directions[scanner]
        turn = Rotation.from_rotvec(-theta[:, None] * direction).as_matrix()
        offset = points.T - scanners.foot_points[scanner]
        turned = np.einsum("nij,nj->ni", turn, offset)
        arm = turned + scanners.foot_points[scanner] - scanners.translations[scanner]
        lrf_from_axis = scanners.rotations[scanner].transpose(0, 2, 1)
        moved = block.velocity[:, rows] * (block.delay_s[rows] + instrument[:, 4])
        x = np.einsum("nij,nj->ni", lrf_from_axis, arm) + moved.T
        basis = scanners.axis_basis()[scanner]
        return cls(x, turned, arm, offset, lrf_from_axis, turn, basis, direction, theta, swing, instrument)

    @property
    def lrf_from_world_turn(self) -> FloatArray:
        """(n, 3, 3) rotation from world to the LRF at the measurement's tilt."""
        return self.lrf_from_axis @ self.turn

    def predicted(self) -> FloatArray:
        """(3, n) range, bearing, height over the scan plane."""
        planar = np.hypot(self.x[:, 0], self.x[:, 1])
        bearing = np.arctan2(self.x[:, 1], self.x[:, 0]) + self.instrument[:, 3]
        return np.stack([self.instrument[:, 2] * planar + self.instrument[:, 1], bearing, self.x[:, 2]])

    def slopes(self) -> list[FloatArray]:
        """Derivatives (n, 3) of x by columns 0..9: pose and axis."""
        in_lrf = self._in_lrf
        # R <- exp(w) R turns the arm by -w; t <- t + dt shortens it.
        pose = [in_lrf(np.cross(self.arm, unit)) for unit in np.eye(3)] + [in_lrf(-unit) for unit in np.eye(3)]
        axis = [in_lrf(self._by_direction(self.basis[:, :, i])) for i in range(2)]
        stay = np.eye(3) - self.turn
        foot = [in_lrf(np.einsum("nij,nj->ni", stay, self.basis[:, :, i])) for i in range(2)]
        return [*pose, *axis, *foot]

    def by_theta(self) -> FloatArray:
        """(n, 3) derivative of x by the turn about the axis."""
        return self._in_lrf(-np.cross(self.direction, self.turned))

    def _in_lrf(self, vector: FloatArray) -> FloatArray:
        return np.einsum("nij,nj->ni", self.lrf_from_axis, np.broadcast_to(vector, self.x.shape))

    def _by_direction(self, change: FloatArray) -> FloatArray:
        """Derivative of Rn(-theta) offset by the axis direction along `change` (n, 3), which stands across it.

        Rodrigues: R y = cos y + sin n' x y + (1 - cos)(n' . y) n' with n' = n and angle -theta.
        """
        cosine, sine = np.cos(self.theta)[:, None], -np.sin(self.theta)[:, None]
        along = (self.direction * self.offset).sum(axis=1, keepdims=True)
        changed_along = (change * self.offset).sum(axis=1, keepdims=True)
        return sine * np.cross(change, self.offset) + (1 - cosine) * (changed_along * self.direction + along * change)
