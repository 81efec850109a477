"""Tilting scanners and their tilt angles as shared parameters of the joint engine.

Tangent of one scanner, as in SCANNER_TANGENT: world_from_lrf at the reference tilt (rotation on the left about
the LRF origin, then translation), the tilt axis (two turns of its direction, two shifts of its foot point, both in the
axis's own basis), then what may be wrong with the instrument: tilt gain, range bias, range scale, bearing zero, clock
offset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.scanner import TiltingScanner
from network_calib.observations import FloatArray, IntArray
from network_calib.result import LRF_PARAMETER_NAMES

# The names and order that the result file uses.
SCANNER_TANGENT = LRF_PARAMETER_NAMES
N_GEOMETRY, N_SCANNER = 10, 15


@dataclass(frozen=True, slots=True)
class ScannerPart:
    """S scanners.

    Attributes:
        rotations: (S, 3, 3) world_from_lrf at the reference tilt.
        translations: (S, 3) LRF origin in world at the reference tilt.
        directions: (S, 3) unit tilt axes in world.
        foot_points: (S, 3) points of the axes nearest to the world's origin.
        instrument: (S, 5) as in `TiltingScanner.instrument`.
        columns: (S, 15) tangent columns within this part, -1 where fixed.
    """

    rotations: FloatArray
    translations: FloatArray
    directions: FloatArray
    foot_points: FloatArray
    instrument: FloatArray
    columns: IntArray

    @classmethod
    def from_scanners(cls, scanners: tuple[TiltingScanner, ...], columns: IntArray) -> ScannerPart:
        """Take the numbers of scanners."""
        return cls(
            rotations=np.stack([s.world_from_lrf.rotation.as_matrix() for s in scanners]),
            translations=np.stack([s.world_from_lrf.translation for s in scanners]),
            directions=np.stack([s.axis_direction_in_world for s in scanners]),
            foot_points=np.stack([s.axis_point_in_world for s in scanners]),
            instrument=np.stack([s.instrument for s in scanners]),
            columns=columns,
        )

    def apply_to(self, scanners: tuple[TiltingScanner, ...]) -> tuple[TiltingScanner, ...]:
        """The same scanners with these numbers."""
        return tuple(
            replace(
                scanner,
                world_from_lrf=RigidTransform.from_components(
                    self.translations[i], Rotation.from_matrix(self.rotations[i])
                ),
                axis_direction_in_world=self.directions[i],
                axis_point_in_world=self.foot_points[i],
                tilt_gain=float(self.instrument[i, 0]),
                range_bias_m=float(self.instrument[i, 1]),
                range_scale=float(self.instrument[i, 2]),
                bearing_zero_rad=float(self.instrument[i, 3]),
                clock_offset_s=float(self.instrument[i, 4]),
            )
            for i, scanner in enumerate(scanners)
        )

    @property
    def size(self) -> int:
        """Tangent dimension."""
        return int(self.columns.max(initial=-1)) + 1

    def axis_basis(self) -> FloatArray:
        """(S, 3, 2) two unit vectors across each axis."""
        return across(self.directions)

    def retract(self, step: FloatArray) -> ScannerPart:
        """The scanners moved by a tangent step (size,)."""
        moves = np.append(step, 0.0)[self.columns]
        basis = self.axis_basis()
        directions = self.directions + np.einsum("sij,sj->si", basis, moves[:, 6:8])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        foot_points = self.foot_points + np.einsum("sij,sj->si", basis, moves[:, 8:10])
        foot_points -= (foot_points * directions).sum(axis=1, keepdims=True) * directions
        return replace(
            self,
            rotations=Rotation.from_rotvec(moves[:, :3]).as_matrix() @ self.rotations,
            translations=self.translations + moves[:, 3:6],
            directions=directions,
            foot_points=foot_points,
            instrument=self.instrument + moves[:, 10:],
        )

    def rigid_directions(self) -> FloatArray:
        """(size, 6) tangent directions of moving the whole world: translation, rotation about the origin."""
        out = np.zeros((self.size + 1, 6))
        basis = self.axis_basis()
        for s in range(len(self.columns)):
            for axis, unit in enumerate(np.eye(3)):
                shift = unit - (unit @ self.directions[s]) * self.directions[s]
                out[self.columns[s, 3:6], axis] = unit
                out[self.columns[s, 8:10], axis] = basis[s].T @ shift
                out[self.columns[s, :3], 3 + axis] = unit
                out[self.columns[s, 3:6], 3 + axis] = np.cross(unit, self.translations[s])
                out[self.columns[s, 6:8], 3 + axis] = basis[s].T @ np.cross(unit, self.directions[s])
                out[self.columns[s, 8:10], 3 + axis] = basis[s].T @ np.cross(unit, self.foot_points[s])
        return out[:-1]


@dataclass(frozen=True, slots=True)
class TiltPart:
    """Angles of T tilt settings.

    Attributes:
        angle_rad: (T,).
        columns: (T,) tangent column within this part, -1 where held: each scanner's reference setting.
    """

    angle_rad: FloatArray
    columns: IntArray

    @property
    def size(self) -> int:
        """Tangent dimension."""
        return int(self.columns.max(initial=-1)) + 1

    def retract(self, step: FloatArray) -> TiltPart:
        """Angles moved by a step (size,)."""
        return replace(self, angle_rad=self.angle_rad + np.append(step, 0.0)[self.columns])


def across(direction: FloatArray) -> FloatArray:
    """(..., 3, 2) two unit vectors orthogonal to unit directions (..., 3) and to each other."""
    # The world axis that stands most across the direction gives the best conditioned start.
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    first = np.asarray(np.cross(direction, helper), dtype=np.float64)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.asarray(np.cross(direction, first), dtype=np.float64)], axis=-1)
