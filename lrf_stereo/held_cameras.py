"""What held cameras are wrong by goes into the LRFs that are calibrated to them.

With the spots eliminated from the normal equations of cameras C and LRFs L (scanners and tilt angles), the optimum for
other cameras is d_L = S d_C with S = -H_LL^-1 H_LC. A result states each camera's covariance but not how the errors of
different cameras go together, and common errors add up where independent ones do not. So the sum is bounded: whatever
the correlations, (sum of a_c)(sum of a_c)' <= sum of a_c a_c' / w_c for any weights of sum one (Cauchy, Schwarz). Where
one camera alone is uncertain, as of a stereo pair in the first one's frame, the bound is the covariance itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.joint_problem import build_joint_problem
from lrf_stereo.lrf_block import TILTS
from lrf_stereo.refine import LrfCovariance, LrfRefined, with_shared_covariance
from lrf_stereo.scanner_part import TiltPart
from network_calib.blocks import State
from network_calib.camera_block import cameras_of
from network_calib.linearisation import Assembler
from network_calib.observations import FloatArray, IntArray
from network_calib.priors import LensPrior
from network_calib.result import Calibration
from network_calib.robust_loss import SquaredLoss
from network_calib.room_setup import Knowledge

# In the words of `world.scale_source`: then the cameras' covariances hold the scale's sigma already.
BY_RANGES = "the ranges of "
# A camera that names the frame has no variance but that of rounding.
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class CameraSpread:
    """What held cameras may be wrong by.

    Attributes:
        cameras: (C, 14, 14) in the order of `network_calib.result.PARAMETER_NAMES`; correlations are not known.
        scale_sigma: relative, of the scale of all, where it is not part of `cameras`.
        fixed_point: (3,) of the world, which stays when the scale changes.
    """

    cameras: FloatArray
    scale_sigma: float
    fixed_point: FloatArray

    @classmethod
    def of(cls, calibration: Calibration) -> CameraSpread:
        """As a result states it."""
        covariance = np.stack([camera.covariance for camera in calibration.cameras])
        centres = calibration.as_cameras().centres_in_world
        is_inside = BY_RANGES in calibration.world.scale_source
        variance = np.einsum("cii->ci", covariance)[:, :6]
        is_first_fixed = variance[0].max() <= ROUNDING * variance.max()
        return cls(
            cameras=covariance,
            scale_sigma=0.0 if is_inside else calibration.world.scale_sigma,
            fixed_point=centres[0] if is_first_fixed else centres.mean(axis=0),
        )


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """How the optimum of a solve with held cameras follows the cameras.

    Attributes:
        by_camera: (n, C, 14) derivative of scanners and tilts by each camera's parameters.
        curvature: (C, 14, C, 14) K, when cameras that are off by d cost d' K d in chi-square, all else following.
        centres: (C, 3) of the cameras in world.
    """

    by_camera: FloatArray
    curvature: FloatArray
    centres: FloatArray

    @classmethod
    def at(cls, refined: LrfRefined, network: NetworkData, data: LrfData) -> Sensitivity:
        """At an optimum, of the parameters that `data` leaves free."""
        reduced, columns = _reduced(refined, network, data)
        c, n = slice(0, int(columns.max()) + 1), slice(int(columns.max()) + 1, None)
        slope = -np.linalg.solve(reduced[n, n], reduced[n, c])
        curvature = np.pad(reduced[c, c] + reduced[c, n] @ slope, (0, 1))
        return cls(
            by_camera=np.asarray(np.pad(slope, ((0, 0), (0, 1)))[:, columns], dtype=np.float64),
            curvature=curvature[columns[:, :, None, None], columns],
            centres=refined.cameras.centres_in_world,
        )

    def covariance(self, spread: CameraSpread, own: FloatArray) -> FloatArray:
        """(n, n) upper bound of what the cameras put on the parameters, beside their own covariance `own` (n, n).

        The weights are those of the smallest trace in units of `own`.
        """
        root = self.by_camera.transpose(1, 0, 2) @ _root(spread.cameras)
        strength = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(own), root), axis=(1, 2))
        is_uncertain = strength > 0
        share = strength[is_uncertain] / strength.sum() if is_uncertain.any() else strength[is_uncertain]
        weighted = root[is_uncertain] / np.sqrt(share)[:, None, None]
        scaled = np.einsum("nci,ci->n", self.by_camera[:, :, 3:6], self._by_scale(spread))
        return np.einsum("cik,cjk->ij", weighted, weighted) + np.outer(scaled, scaled)

    def misfit(self, spread: CameraSpread) -> float:
        """Upper bound of what the cameras' errors add to chi-square in the mean."""
        own = np.einsum("cicj->cij", self.curvature)
        strength = np.sqrt(np.maximum(np.einsum("cij,cji->c", own, spread.cameras), 0.0))
        scaled = self._by_scale(spread)
        by_scale = np.einsum("ci,cidj,dj->", scaled, self.curvature[:, 3:6, :, 3:6], scaled)
        return float(strength.sum() ** 2 + by_scale)

    def with_cameras(self, spread: CameraSpread) -> FloatArray:
        """(C, 14, n) covariance of each camera's parameters with these, as far as it is known."""
        return spread.cameras @ self.by_camera.transpose(1, 2, 0)

    def _by_scale(self, spread: CameraSpread) -> FloatArray:
        """(C, 3) how far the cameras' centres move by one sigma of the scale."""
        return spread.scale_sigma * (self.centres - spread.fixed_point)


def _reduced(refined: LrfRefined, network: NetworkData, data: LrfData) -> tuple[FloatArray, IntArray]:
    """The normal matrix with the spots eliminated: cameras, scanners, tilts; and the cameras' columns (C, 14)."""
    setups = [replace(setup, knowledge=Knowledge.INITIAL, group=None) for setup in network.setups]
    freed = replace(network, setups=setups, points=refined.points, is_held=False, baseline=None)
    is_used = np.zeros(network.views.n_points, dtype=bool)
    is_used[data.point[refined.is_inlier]] = True
    problem, state = build_joint_problem(freed, refined.scanners, data, refined.is_inlier, is_used, SquaredLoss())
    tilts = state.parts[TILTS]
    assert isinstance(tilts, TiltPart)
    state = State({**state.parts, TILTS: replace(tilts, angle_rad=refined.tilt_rad)}, state.points)
    measured = [block for block in problem.shared_blocks if not isinstance(block, LensPrior)]
    assembler = Assembler(replace(problem, shared_blocks=measured), state)
    reduced, _ = assembler.reduce(assembler.linearise(state), 0.0)
    return reduced, cameras_of(state.parts).columns


def with_camera_errors(
    own: LrfCovariance, spread: CameraSpread, refined: LrfRefined, network: NetworkData, data: LrfData
) -> LrfCovariance:
    """The covariance given the cameras, and on top of it what the cameras may be wrong by."""
    sensitivity = Sensitivity.at(refined, network, data)
    total = own.joint + sensitivity.covariance(spread, own.joint)
    return with_shared_covariance(own, refined, total, sensitivity.with_cameras(spread))


def _root(spread: FloatArray) -> FloatArray:
    """(C, 14, 14) matrices A with A A' the covariance, which may be singular."""
    values, vectors = np.linalg.eigh(spread)
    return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
