"""Is a camera out of step with the rest? One time offset per camera, estimated in the joint solve.

A detection that was taken dt later shows the spot where it will be: pixel = projection + velocity * dt. The velocity in the
image is the central difference over the neighbouring frames, so the offset is one more shared parameter for each camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from network_calib.blocks import Gauge, Parts, Problem, State
from network_calib.bundle import SolverOptions, covariance, solve
from network_calib.camera_block import PART, CameraBlock
from network_calib.gauge import inner_gauge
from network_calib.observations import FloatArray, IntArray
from network_calib.robust_loss import Loss
from network_calib.spots import SpotViews

CLOCKS = "clocks"


@dataclass(frozen=True, slots=True)
class Clocks:
    """Time offset of each camera in frames; the first stays zero.

    Attributes:
        offset_frames: (C,) positive when the camera's exposures are later than the first's.
    """

    offset_frames: FloatArray

    @property
    def size(self) -> int:
        """One for each camera but the first."""
        return len(self.offset_frames) - 1

    def retract(self, step: FloatArray) -> Clocks:
        """Offsets moved by a step (C - 1,)."""
        return Clocks(self.offset_frames + np.append(0.0, step))


@dataclass(frozen=True, slots=True)
class DelayedCameraBlock:
    """A camera block whose detections were taken at their camera's time offset.

    Attributes:
        inner: the block without offsets.
        velocity_px: (2, K) image velocity, px a frame; zero where unknown.
        clock_columns: (C,) global column of each camera's offset, -1 for the first.
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
        return replace(
            self, inner=self.inner.take(rows), velocity_px=np.ascontiguousarray(self.velocity_px[:, rows])
        )

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
    """Estimated offsets against the first camera, in frames, and their standard deviations (zero for the first)."""

    offset_frames: FloatArray
    sigma_frames: FloatArray


def estimate_time_offsets(problem: Problem, state: State, views: SpotViews, rows: IntArray) -> TimeOffsets:
    """Solve the joint problem once more with a time offset for each camera.

    Args:
        problem: a camera problem whose only point block is a CameraBlock over `rows` of the views, in that order.
        state: its optimum.
        views: the observations, whose frame numbers count time.
        rows: observations in the block.
    """
    (block,) = problem.point_blocks
    assert isinstance(block, CameraBlock)
    n_cameras, n_columns = views.n_cameras, state.n_shared
    columns = n_columns - 1 + np.arange(n_cameras)
    columns[0] = -1
    delayed = DelayedCameraBlock(block, image_velocity(views)[rows].T, columns)
    extended = Problem([delayed], problem.shared_blocks, _gauge)
    start = State({PART: state.parts[PART], CLOCKS: Clocks(np.zeros(n_cameras))}, state.points)
    solution = solve(extended, start, SolverOptions(cost_tolerance=1e-6, max_iterations=20))
    clocks = solution.state.parts[CLOCKS]
    assert isinstance(clocks, Clocks)
    sigma = np.sqrt(np.diag(covariance(extended, solution.state).shared)[n_columns:])
    return TimeOffsets(clocks.offset_frames, np.append(0.0, sigma))


def _gauge(state: State) -> Gauge:
    inner = inner_gauge(state)
    pad = state.n_shared - inner.null.shape[0]
    return Gauge(np.pad(inner.constraints, ((0, 0), (0, pad))), np.pad(inner.null, ((0, pad), (0, 0))))


def image_velocity(views: SpotViews) -> FloatArray:
    """(K, 2) central difference of each camera's detections, px a frame; zero without both neighbouring frames."""
    order = np.lexsort((views.observations.frame, views.camera))
    camera, frame, px = views.camera[order], views.observations.frame[order], views.px[order]
    velocity = np.zeros_like(px)
    is_between = (camera[2:] == camera[:-2]) & (frame[2:] == frame[1:-1] + 1) & (frame[1:-1] == frame[:-2] + 1)
    middle = np.flatnonzero(is_between) + 1
    # A jump is a false detection, not motion: the two halves must agree.
    ahead, behind = px[middle + 1] - px[middle], px[middle] - px[middle - 1]
    speed = np.linalg.norm(ahead + behind, axis=1) / 2
    is_smooth = np.linalg.norm(ahead - behind, axis=1) < 0.5 * speed + 2.0
    velocity[middle[is_smooth]] = ((ahead + behind) / 2)[is_smooth]
    out = np.empty_like(velocity)
    out[order] = velocity
    return out
