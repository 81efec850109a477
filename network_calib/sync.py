"""Is a camera out of step with the rest? One time offset per camera, estimated in the joint solve.

A detection that was taken dt later shows the spot where it will be: pixel = projection + velocity * dt. The velocity
in the image is the central difference over the neighbouring detections, so the offset is one more shared parameter for
each camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError

from network_calib.blocks import Gauge, Parts, Problem, State
from network_calib.bundle import SolverOptions, covariance, solve
from network_calib.camera_block import PART, CameraBlock
from network_calib.gauge import inner_gauge
from network_calib.observations import FloatArray, IntArray
from network_calib.robust_loss import Loss
from network_calib.spots import SpotViews

CLOCKS = "clocks"
# Neighbouring detections further apart, in usual steps, do not tell the velocity between them: a hand turns in 0.2 s.
MAX_GAP = 3
# A camera has 14 parameters and a clock; fewer rows would leave the extended problem loose.
MIN_TELLING = 50


@dataclass(frozen=True, slots=True)
class Clocks:
    """Time offset of each camera in frames; that of one camera, the reference, stays zero.

    Attributes:
        offset_frames: (C,) positive when the camera's exposures are later than the reference's.
        reference: camera index.
    """

    offset_frames: FloatArray
    reference: int

    @property
    def size(self) -> int:
        """One for each camera but the reference."""
        return len(self.offset_frames) - 1

    def retract(self, step: FloatArray) -> Clocks:
        """Offsets moved by a step (C - 1,)."""
        return replace(self, offset_frames=self.offset_frames + np.insert(step, self.reference, 0.0))


@dataclass(frozen=True, slots=True)
class DelayedCameraBlock:
    """A camera block whose detections were taken at their camera's time offset.

    Attributes:
        inner: the block without offsets.
        velocity_px: (2, K) image velocity, px a frame.
        clock_columns: (C,) global column of each camera's offset, -1 for the reference.
    """

    inner: CameraBlock
    velocity_px: FloatArray
    clock_columns: IntArray

    @property
    def point(self) -> IntArray:
        """(K,) latent point index."""
        return self.inner.point

    @property
    def group(self) -> IntArray:
        """(K,) camera index."""
        return self.inner.group

    @property
    def columns(self) -> IntArray:
        """(C, 15) the camera's columns, then its clock's."""
        return np.column_stack([self.inner.columns, self.clock_columns])

    @property
    def loss(self) -> Loss:
        """The camera block's loss."""
        return self.inner.loss

    def take(self, rows: IntArray) -> DelayedCameraBlock:
        """The block with its rows reordered or thinned."""
        return replace(self, inner=self.inner.take(rows), velocity_px=np.ascontiguousarray(self.velocity_px[:, rows]))

    def residual(self, parts: Parts, points: FloatArray, rows: slice) -> FloatArray:
        """(2, n) whitened residuals."""
        return self.inner.residual(parts, points, rows) + self._slope(rows) * self._offset(parts, rows)

    def linearise(self, parts: Parts, points: FloatArray, rows: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (2, n), Jacobians (15, 2, n) and (3, 2, n)."""
        residual, by_camera, by_point = self.inner.linearise(parts, points, rows)
        slope = self._slope(rows)
        return residual + slope * self._offset(parts, rows), np.concatenate([by_camera, slope[None]]), by_point

    def _slope(self, rows: slice) -> FloatArray:
        return self.velocity_px[:, rows] * self.inner.inverse_sigma[rows]

    def _offset(self, parts: Parts, rows: slice) -> FloatArray:
        clocks = parts[CLOCKS]
        assert isinstance(clocks, Clocks)
        return clocks.offset_frames[self.inner.group[rows]]


@dataclass(frozen=True, slots=True)
class TimeOffsets:
    """Estimated offsets against one camera, in frames.

    Attributes:
        offset_frames: (C,) positive when the camera exposes later; zero for the reference.
        sigma_frames: (C,) standard deviations, zero for the reference; infinite where a camera's detections are too far
            apart in time to tell.
        reference: camera index.
    """

    offset_frames: FloatArray
    sigma_frames: FloatArray
    reference: int


def estimate_time_offsets(problem: Problem, state: State, views: SpotViews, rows: IntArray) -> TimeOffsets:
    """Solve the joint problem once more with a time offset for each camera.

    Only detections whose image velocity is known take part: others would hold their spots at an offset of zero. The
    reference is the camera of the smallest noise: one that is out of step itself has taken its lag for noise, and then
    the others had better not move for it.

    Args:
        problem: a camera problem whose only point block is a CameraBlock over `rows` of the views, in that order.
        state: its optimum.
        views: the observations, whose frame numbers count time.
        rows: observations in the block.
    """
    (block,) = problem.point_blocks
    assert isinstance(block, CameraBlock)
    n_cameras, n_columns = views.n_cameras, state.n_shared
    velocity_px = image_velocity(views.camera[rows], views.observations.frame[rows], views.px[rows])
    kept = _telling(block, velocity_px)
    reference = int(np.argmin([np.median(1 / block.inverse_sigma[block.group == c]) for c in range(n_cameras)]))
    is_free = np.arange(n_cameras) != reference
    unknown = TimeOffsets(np.zeros(n_cameras), np.where(is_free, np.inf, 0.0), reference)
    if (np.bincount(block.group[kept], minlength=n_cameras) < MIN_TELLING).any():
        return unknown
    columns = np.where(is_free, n_columns - 1 + np.cumsum(is_free), -1)
    points, number = np.unique(block.point[kept], return_inverse=True)
    inner = replace(block.take(kept), point=number.astype(np.int64))
    extended = Problem([DelayedCameraBlock(inner, velocity_px[kept].T, columns)], problem.shared_blocks, _gauge)
    start = State({PART: state.parts[PART], CLOCKS: Clocks(np.zeros(n_cameras), reference)}, state.points[:, points])
    solution = solve(extended, start, SolverOptions(cost_tolerance=1e-6, max_iterations=20))
    clocks = solution.state.parts[CLOCKS]
    assert isinstance(clocks, Clocks)
    try:
        variance = np.diag(covariance(extended, solution.state).shared)[n_columns:]
    except LinAlgError:
        return unknown
    return TimeOffsets(clocks.offset_frames, np.insert(np.sqrt(variance), reference, 0.0), reference)


def _telling(block: CameraBlock, velocity_px: FloatArray) -> IntArray:
    """Rows whose velocity is known, of points that two such rows see."""
    is_known = np.isfinite(velocity_px).all(axis=1)
    n_views = np.bincount(block.point[is_known], minlength=int(block.point.max(initial=-1)) + 1)
    return np.flatnonzero(is_known & (n_views[block.point] >= 2))


def _gauge(state: State) -> Gauge:
    inner = inner_gauge(state)
    pad = state.n_shared - inner.null.shape[0]
    return Gauge(np.pad(inner.constraints, ((0, 0), (0, pad))), np.pad(inner.null, ((0, pad), (0, 0))))


def image_velocity(camera: IntArray, frame: IntArray, px: FloatArray) -> FloatArray:
    """Image velocity of each detection from the one before and the one after it by the same camera.

    Args:
        camera: (K,) camera index.
        frame: (K,) frame number.
        px: (K, 2).

    Returns:
        (K, 2) px a frame; NaN where a neighbour is more than MAX_GAP frame steps away or the two halves disagree.
    """
    order = np.lexsort((frame, camera))
    gap = np.diff(frame[order]).astype(np.float64)
    is_same = np.diff(camera[order]) == 0
    step = np.median(gap[is_same]) if is_same.any() else 1.0
    is_near = is_same & (gap <= MAX_GAP * step)
    slope = np.diff(px[order], axis=0) / np.maximum(np.abs(gap), 1e-300)[:, None]
    behind, ahead, h_behind, h_ahead = slope[:-1], slope[1:], gap[:-1, None], gap[1:, None]
    central = (behind * h_ahead + ahead * h_behind) / (h_behind + h_ahead)
    # A jump is a false detection, not motion: the two halves must agree.
    is_smooth = np.linalg.norm(ahead - behind, axis=1) * step < 0.5 * np.linalg.norm(central, axis=1) * step + 2.0
    is_known = is_near[:-1] & is_near[1:] & is_smooth
    velocity = np.full((len(px), 2), np.nan)
    velocity[order[1:-1][is_known]] = central[is_known]
    return velocity
