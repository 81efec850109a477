"""Which of many cameras can see any of a scan's points: never one too few, and cheap.

A camera's valid pixels lie within four planes (`view_bounds`) and, where asked, within a largest distance. What an LRF
can reach at all lies in a ball around it: the cameras whose planes miss that ball are left out once and for all
(`FrustumIndex.around`). Of the others, a scan's bounding box leaves out most, and the boxes of its pieces more. A box
lies outside a camera's view when it lies wholly behind one of the planes. What remains may still see nothing; that
costs time only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrf_stereo.view_bounds import SIDES_RAD, side_bounds
from network_calib.cameras import Cameras
from network_calib.observations import BoolArray, FloatArray, IntArray

# Pieces of a scan: at 32 a piece of a URG's scan is 7.5 degrees wide, a third of a camera's view or less.
N_PIECES = 32
# Distances are compared with this slack, relative to the coordinates, so that rounding drops no camera.
SLACK = 1e-9


@dataclass(frozen=True, slots=True)
class FrustumIndex:
    """What C cameras can see.

    Attributes:
        cameras: (C,) their indices in the network, growing.
        centres: (C, 3) in world.
        normals: (C, 4, 3) of the planes through the centre, pointing inwards.
        offsets: (C, 4) normal times centre.
        max_distance_m: points farther away than this do not count as seen.
    """

    cameras: IntArray
    centres: FloatArray
    normals: FloatArray
    offsets: FloatArray
    max_distance_m: float

    @classmethod
    def of(cls, cameras: Cameras, *, max_distance_m: float = np.inf) -> FrustumIndex:
        """The index of all cameras of a network."""
        bounds, centres = side_bounds(cameras), cameras.centres_in_world
        # A ray towards the side psi at the angle b or less: x cos psi + y sin psi <= z tan b.
        in_cam = np.stack(
            [-np.cos(bounds) * np.cos(SIDES_RAD), -np.cos(bounds) * np.sin(SIDES_RAD), np.sin(bounds)], axis=-1
        )
        normals = np.einsum("csi,cij->csj", in_cam, cameras.rotations)
        offsets = np.einsum("csi,ci->cs", normals, centres)
        return cls(np.arange(len(cameras)), centres, normals, offsets, max_distance_m)

    def __len__(self) -> int:
        return len(self.cameras)

    def around(self, centre_in_world: FloatArray, reach_m: float) -> FrustumIndex:
        """The cameras that can see anything within a ball."""
        return self._take(self._may_see_balls(centre_in_world, reach_m))

    def seeing(self, points_in_world: FloatArray) -> IntArray:
        """Indices in the network of all cameras in which any of the points (N, 3) may be valid; rows of NaN are none.

        Points that follow one another, as in a scan, should be neighbours.
        """
        with np.errstate(invalid="ignore"):
            points = points_in_world[np.isfinite(points_in_world).all(axis=1)]
        if not len(points) or not len(self):
            return np.empty(0, dtype=np.int64)
        near = self._take(self._may_see(_Boxes.of(points, 1)))
        return near.cameras[near._may_see(_Boxes.of(points, N_PIECES))]

    def _take(self, is_kept: BoolArray) -> FrustumIndex:
        return replace(
            self,
            cameras=self.cameras[is_kept],
            centres=self.centres[is_kept],
            normals=self.normals[is_kept],
            offsets=self.offsets[is_kept],
        )

    def _may_see(self, boxes: _Boxes) -> BoolArray:
        """(C,) whether any of the boxes reaches into the view."""
        normals = self.normals.reshape(-1, 3)
        # The corner of a box that lies farthest inwards.
        depth = normals @ boxes.middle.T + np.abs(normals) @ boxes.half.T
        slack = self._slack(boxes.middle)
        is_in = np.all(depth.reshape(len(self), 4, len(boxes.half)) >= self.offsets[:, :, None] - slack, axis=1)
        if np.isfinite(self.max_distance_m):
            beyond = np.abs(boxes.middle - self.centres[:, None]) - boxes.half
            distance = np.linalg.norm(np.maximum(beyond, 0.0), axis=2)
            is_in &= distance <= self.max_distance_m + slack
        return np.asarray(np.any(is_in, axis=1))

    def _may_see_balls(self, centre: FloatArray, radius_m: float) -> BoolArray:
        """(C,) whether a ball reaches into the view."""
        slack = self._slack(centre)
        is_in = np.all(self.normals @ centre + radius_m >= self.offsets - slack, axis=1)
        distance = np.linalg.norm(self.centres - centre, axis=1)
        return np.asarray(is_in & (distance <= self.max_distance_m + radius_m + slack))

    def _slack(self, points: FloatArray) -> float:
        return SLACK * (1 + float(np.abs(points).max()) + float(np.abs(self.centres).max(initial=0.0)))


@dataclass(frozen=True, slots=True)
class _Boxes:
    """Boxes along the world's axes: (B, 3) middles and (B, 3) half sides."""

    middle: FloatArray
    half: FloatArray

    @classmethod
    def of(cls, points: FloatArray, n_pieces: int) -> _Boxes:
        """Boxes around pieces of finite points (N, 3), in their order."""
        begins = np.unique(np.linspace(0, len(points), n_pieces, endpoint=False, dtype=np.int64))
        low, high = np.minimum.reduceat(points, begins), np.maximum.reduceat(points, begins)
        return cls((low + high) / 2, (high - low) / 2)
