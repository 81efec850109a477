"""What the joint engine is made of: parts of the shared parameters, residual blocks, the gauge, the problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from network_calib.observations import FloatArray, IntArray
from network_calib.robust_loss import Loss


class Part(Protocol):
    """A named piece of the shared parameters with its own tangent space."""

    @property
    def size(self) -> int:
        """Tangent dimension: free parameters only."""
        ...

    def retract(self, step: FloatArray) -> Self:
        """The part moved by a tangent step (size,)."""
        ...


Parts = Mapping[str, Part]


class PointBlock(Protocol):
    """K measurements with m residuals each; each sees one latent point and the shared parameters of one group.

    A group sees a point at most once in a block.
    """

    @property
    def point(self) -> IntArray:
        """(K,) latent point index."""
        ...

    @property
    def group(self) -> IntArray:
        """(K,) group index."""
        ...

    @property
    def columns(self) -> IntArray:
        """(G, D) the global column of the shared tangent for each group's Jacobian columns; -1 where fixed."""
        ...

    @property
    def loss(self) -> Loss:
        """Robust loss on the squared norm of each measurement."""
        ...

    def take(self, rows: IntArray) -> Self:
        """The block with its measurements reordered or thinned."""
        ...

    def residual(self, parts: Parts, points: FloatArray, rows: slice) -> FloatArray:
        """(m, n) whitened residuals of the measurements `rows`, whose points are (3, n)."""
        ...

    def linearise(self, parts: Parts, points: FloatArray, rows: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (m, n), Jacobian (D, m, n) by the shared columns and (3, m, n) by the points."""
        ...


class SharedBlock(Protocol):
    """M residuals of shared parameters alone; each row touches at most D columns."""

    @property
    def columns(self) -> IntArray:
        """(M, D) global columns, -1 where fixed or unused."""
        ...

    def linearise(self, parts: Parts) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (M,) and Jacobian (M, D)."""
        ...


@dataclass(frozen=True, slots=True)
class State:
    """Where a solve stands: shared parts by name, in tangent order, and points (3, F)."""

    parts: Parts
    points: FloatArray

    @property
    def n_shared(self) -> int:
        return sum(part.size for part in self.parts.values())

    def retract(self, shared_step: FloatArray, point_step: FloatArray) -> State:
        """The state moved by a tangent step (n_shared,) and (3, F)."""
        moved, start = {}, 0
        for name, part in self.parts.items():
            moved[name] = part.retract(shared_step[start : start + part.size])
            start += part.size
        return State(moved, self.points + point_step)


@dataclass(frozen=True, slots=True)
class Gauge:
    """Directions that the residuals leave free, and the constraints that name the choice.

    A covariance is that of the solution with `constraints @ step == 0`.

    Attributes:
        constraints: (g, n) rows over the shared tangent vector.
        null: (n, g) directions of the shared tangent vector along which no residual changes.
    """

    constraints: FloatArray
    null: FloatArray

    @classmethod
    def none(cls, n_shared: int) -> Gauge:
        """No freedom left: the residuals determine everything."""
        return cls(np.zeros((0, n_shared)), np.zeros((n_shared, 0)))


@dataclass(frozen=True, slots=True)
class Problem:
    """What is minimised: half the sum of losses of point blocks plus half the squares of shared blocks.

    Attributes:
        point_blocks: measurements of latent points.
        shared_blocks: residuals of shared parameters alone.
        gauge: names the gauge at a state; None when the residuals determine everything.
    """

    point_blocks: Sequence[PointBlock]
    shared_blocks: Sequence[SharedBlock] = ()
    gauge: Callable[[State], Gauge] | None = None

    def gauge_at(self, state: State) -> Gauge:
        """The gauge at a state; empty when the problem has none."""
        return Gauge.none(state.n_shared) if self.gauge is None else self.gauge(state)
