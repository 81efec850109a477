"""Equation 3 and its general form: a plane scanner that turns about a fixed line, the tilt axis.

Axes of an LRF: x forward, y left, z up; bearings count from x towards y; the scan plane is z = 0. A tilt above zero
turns the forward axis down (a right-handed turn about the axis direction, which is y in the paper).

The general model has ten degrees of freedom where the paper's equation 3 has eight and its equation 11 seven: the pose
of the LRF at one reference tilt, and the axis as any line. What the device reports is related to what is true by

    range_measured   = range_scale * range_true + range_bias
    bearing_measured = bearing_true + bearing_zero
    angle_turned     = tilt_gain * (tilt_reported - reference_tilt)
    time_true        = time_stamped + clock_offset
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.errors import InputError
from network_calib.gauge import Similarity
from network_calib.observations import BoolArray, FloatArray

# SCIP devices put error codes in place of a distance; all codes are below 20 mm.
FIRST_RANGE_MM = 20


@dataclass(frozen=True, slots=True)
class ScanSteps:
    """The steps of a scan; the defaults are those of an URG-04LX.

    Attributes:
        front_step: the step that looks along x.
        steps_per_turn: steps in 360 degrees.
        first_step: first step that is measured.
        last_step: last step that is measured, inclusive.
        range_min_m: shortest range that the device measures.
        range_max_m: longest range that the device measures.
        turn_s: time of one turn of the mirror; a step takes turn_s / steps_per_turn (97.66 us).
    """

    front_step: int = 384
    steps_per_turn: int = 1024
    first_step: int = 44
    last_step: int = 725
    range_min_m: float = 0.02
    range_max_m: float = 5.6
    turn_s: float = 0.1

    @property
    def step_rad(self) -> float:
        return 2 * np.pi / self.steps_per_turn

    @property
    def n_measured(self) -> int:
        return self.last_step - self.first_step + 1

    @property
    def bearings_rad(self) -> FloatArray:
        """(n_measured,) bearings of a whole scan, in its order."""
        return self.bearing_rad(np.arange(self.first_step, self.last_step + 1))

    def bearing_rad(self, step: npt.ArrayLike) -> FloatArray:
        """Bearings of steps, of any shape."""
        return (np.asarray(step, dtype=np.float64) - self.front_step) * self.step_rad

    def step(self, bearing_rad: npt.ArrayLike) -> FloatArray:
        """Steps of bearings, as fractions: the inverse of `bearing_rad`."""
        return np.asarray(bearing_rad, dtype=np.float64) / self.step_rad + self.front_step

    def time_s(self, step: npt.ArrayLike) -> FloatArray:
        """Seconds after step 0 at which each step is measured: step 0 carries the stamp of the scan."""
        return np.asarray(step, dtype=np.float64) * (self.turn_s / self.steps_per_turn)

    def beam_time_s(self, bearing_rad: npt.ArrayLike) -> FloatArray:
        """Seconds after the scan's stamp, from 0 to `turn_s`, at which beams of measured bearings are taken.

        On an URG-04LX 37.5 ms for the beam ahead and 70.8 ms for the last: a spot that moves with 0.3 m/s is 21 mm on.
        """
        return self.time_s(np.mod(self.step(bearing_rad), self.steps_per_turn))

    def is_range(self, value_mm: npt.ArrayLike) -> BoolArray:
        """Whether a reading is a distance: neither an error code (below 20) nor outside the device's reach."""
        value = np.asarray(value_mm)
        shortest, longest = max(FIRST_RANGE_MM, 1e3 * self.range_min_m), 1e3 * self.range_max_m
        return np.asarray((value >= shortest) & (value <= longest))


@dataclass(frozen=True, slots=True)
class PaperForm:
    """The same scanner in the paper's terms: p_axis = Ry(tilt) (R_mount p_lrf + [dx, 0, dz]).

    Attributes:
        world_from_axis: the paper's frame I: origin on the tilt axis, beside the LRF; y along the axis.
        dx_m: offset of the mirror from the axis, along x of I at tilt zero.
        dz_m: the same, along z.
        mount_roll_rad: R_mount = Rz(yaw) Rx(roll); the paper takes both as zero.
        mount_yaw_rad: see `mount_roll_rad`.
    """

    world_from_axis: RigidTransform
    dx_m: float
    dz_m: float
    mount_roll_rad: float
    mount_yaw_rad: float

    @property
    def d_m(self) -> float:
        """Distance of the mirror from the axis, the d of equation 10."""
        return float(np.hypot(self.dx_m, self.dz_m))

    @property
    def phi_rad(self) -> float:
        """The phase that equation 11 leaves out: the mirror is at d [sin(tilt + phi), 0, cos(tilt + phi)]."""
        return float(np.arctan2(self.dx_m, self.dz_m))


@dataclass(frozen=True, slots=True)
class TiltingScanner:
    """A plane scanner on a tilt axis. The module says how measured and true values are related.

    Attributes:
        world_from_lrf: pose at the reference tilt. The world is any fixed frame, the stereo camera's in the paper.
        axis_direction_in_world: (3,) unit vector; a growing tilt turns right-handed about it.
        axis_point_in_world: (3,) the point of the axis that is nearest to the origin: of all points of the line, this
            one is taken on construction.
        reference_tilt_rad: the tilt of `world_from_lrf`.
        tilt_gain: angle turned over angle reported.
        range_bias_m: see the module.
        range_scale: see the module.
        bearing_zero_rad: see the module. A turn of the LRF about its own z does the same, so a solve that frees the
            pose must hold this.
        clock_offset_s: what the scanner's stamps lack to the cameras' clock: above zero when beams are later than their
            stamps say. Without effect on points that stand still, and so on equation 14.
    """

    world_from_lrf: RigidTransform
    axis_direction_in_world: FloatArray
    axis_point_in_world: FloatArray
    reference_tilt_rad: float = 0.0
    tilt_gain: float = 1.0
    range_bias_m: float = 0.0
    range_scale: float = 1.0
    bearing_zero_rad: float = 0.0
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        direction = np.asarray(self.axis_direction_in_world, dtype=np.float64)
        point = np.asarray(self.axis_point_in_world, dtype=np.float64)
        length = float(np.linalg.norm(direction))
        if not (length > 0 and np.isfinite(length) and np.isfinite(point).all()):
            raise InputError(f"a tilt axis needs a direction and a point, got {direction} and {point}")
        if not (self.range_scale > 0 and self.tilt_gain > 0):
            raise InputError(f"range scale {self.range_scale} and tilt gain {self.tilt_gain} must be positive")
        direction = direction / length
        object.__setattr__(self, "axis_direction_in_world", direction)
        object.__setattr__(self, "axis_point_in_world", point - (point @ direction) * direction)

    @classmethod
    def from_paper(
        cls,
        world_from_axis: RigidTransform,
        dx_m: float,
        dz_m: float,
        *,
        mount_roll_rad: float = 0.0,
        mount_yaw_rad: float = 0.0,
        reference_tilt_rad: float = 0.0,
    ) -> TiltingScanner:
        """Equation 3 with the frame I at `world_from_axis` and the LRF mounted as in `PaperForm`."""
        mount = RigidTransform.from_components([dx_m, 0.0, dz_m], _mount(mount_roll_rad, mount_yaw_rad))
        turn = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, reference_tilt_rad, 0.0]))
        return cls(
            world_from_lrf=world_from_axis * turn * mount,
            axis_direction_in_world=world_from_axis.rotation.as_matrix()[:, 1],
            axis_point_in_world=world_from_axis.translation,
            reference_tilt_rad=reference_tilt_rad,
        )

    @property
    def instrument(self) -> FloatArray:
        """(5,) tilt gain, range bias (m), range scale, bearing zero (rad), clock offset (s)."""
        return np.array(
            [self.tilt_gain, self.range_bias_m, self.range_scale, self.bearing_zero_rad, self.clock_offset_s]
        )

    def as_paper(self) -> PaperForm:
        """The scanner in the paper's terms; a tilt gain other than one is not part of them.

        Frame I is placed beside the mirror (no offset along the axis) and turned so that tilt zero has no pitch left.

        Raises:
            InputError: the axis points along the LRF's x, where roll and pitch cannot be told apart.
        """
        rotation = self.world_from_lrf.rotation
        along = rotation.inv().apply(self.axis_direction_in_world)
        if np.hypot(along[1], along[2]) < 1e-9:
            raise InputError("the tilt axis points along the LRF's forward axis: the paper's form does not exist")
        # The axis is y of I: R_mount^T y = (sin yaw, cos yaw cos roll, -cos yaw sin roll) in the LRF.
        roll = float(np.arctan2(-along[2], along[1]))
        yaw = float(np.arctan2(along[0], np.hypot(along[1], along[2])))
        back = Rotation.from_rotvec([0.0, -self.reference_tilt_rad, 0.0])
        world_from_axis = rotation * _mount(roll, yaw).inv() * back
        origin, direction = self.world_from_lrf.translation, self.axis_direction_in_world
        foot = self.axis_point_in_world + (origin @ direction) * direction
        # At the reference tilt the mirror is at Ry(reference) [dx, 0, dz] in I.
        offset = back.apply(world_from_axis.inv().apply(origin - foot))
        return PaperForm(
            world_from_axis=RigidTransform.from_components(foot, world_from_axis),
            dx_m=float(offset[0]),
            dz_m=float(offset[2]),
            mount_roll_rad=roll,
            mount_yaw_rad=yaw,
        )

    def world_from_lrf_at(self, tilt_rad: npt.ArrayLike) -> RigidTransform:
        """Poses at tilts (N,), the paper's L(alpha)_T_C; a single pose for a number."""
        angle = np.asarray(self.turned_rad(tilt_rad))
        turn = Rotation.from_rotvec(angle[..., None] * self.axis_direction_in_world)
        shift = self.axis_point_in_world - turn.apply(self.axis_point_in_world)
        return RigidTransform.from_components(shift, turn) * self.world_from_lrf

    def turned_rad(self, tilt_rad: npt.ArrayLike) -> FloatArray:
        """(N,) angles turned about the axis since the reference tilt."""
        return self.tilt_gain * (np.asarray(tilt_rad, dtype=np.float64) - self.reference_tilt_rad)

    def points_in_lrf(self, range_m: npt.ArrayLike, bearing_rad: npt.ArrayLike) -> FloatArray:
        """(N, 3) points in the scan plane, from measured ranges and bearings (N,)."""
        true_range = (np.asarray(range_m, dtype=np.float64) - self.range_bias_m) / self.range_scale
        true_bearing = np.asarray(bearing_rad, dtype=np.float64) - self.bearing_zero_rad
        x, y = true_range * np.cos(true_bearing), true_range * np.sin(true_bearing)
        return np.stack(np.broadcast_arrays(x, y, 0.0), axis=-1)

    def points_in_world(
        self, range_m: npt.ArrayLike, bearing_rad: npt.ArrayLike, tilt_rad: npt.ArrayLike
    ) -> FloatArray:
        """(N, 3) points of measured ranges, bearings and tilts (N,), which broadcast: equations 2 and 3."""
        at_reference = self._from_lrf(self.points_in_lrf(range_m, bearing_rad))
        return self._turned(at_reference, self.turned_rad(tilt_rad))

    def measure(
        self, points_in_world: FloatArray, tilt_rad: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What the scanner would report of points (N, 3), and how far they lie above its plane.

        Returns:
            (N,) measured ranges, (N,) measured bearings in [-pi, pi), (N,) heights above the scan plane in metres.
            Range and bearing are those of the foot in the plane: `points_in_world` inverts them where the height is 0.
        """
        back = self._turned(np.asarray(points_in_world, dtype=np.float64), -self.turned_rad(tilt_rad))
        offset = back - self.world_from_lrf.translation
        x, y, z = np.moveaxis(offset @ self.world_from_lrf.rotation.as_matrix(), -1, 0)
        bearing = np.arctan2(y, x) + self.bearing_zero_rad
        wrapped = (bearing + np.pi) % (2 * np.pi) - np.pi
        return self.range_scale * np.hypot(x, y) + self.range_bias_m, wrapped, z

    def moved_by(self, target_from_source: RigidTransform | Similarity) -> TiltingScanner:
        """The same scanner when the world moves; under a similarity the range scale takes the new unit up.

        Points of the moved scanner are the moved points of this one; what it measures of them stays.
        """
        motion = target_from_source
        if isinstance(motion, RigidTransform):
            motion = Similarity(1.0, motion.rotation.as_matrix(), np.asarray(motion.translation))
        rotation = Rotation.from_matrix(motion.rotation)
        origin = motion.apply(np.asarray(self.world_from_lrf.translation)[None])[0]
        return replace(
            self,
            world_from_lrf=RigidTransform.from_components(origin, rotation * self.world_from_lrf.rotation),
            axis_direction_in_world=rotation.apply(self.axis_direction_in_world),
            axis_point_in_world=motion.apply(self.axis_point_in_world[None])[0],
            range_scale=self.range_scale / motion.scale,
        )

    def _from_lrf(self, points_in_lrf: FloatArray) -> FloatArray:
        rotation = self.world_from_lrf.rotation.as_matrix()
        return points_in_lrf @ rotation.T + self.world_from_lrf.translation

    def _turned(self, points: FloatArray, angle_rad: FloatArray) -> FloatArray:
        """Points (N, 3) turned about the axis by angles (N,): Rodrigues' formula about the axis point."""
        direction, arm = self.axis_direction_in_world, points - self.axis_point_in_world
        cosine, sine = np.cos(angle_rad)[..., None], np.sin(angle_rad)[..., None]
        along = (arm @ direction)[..., None] * direction
        return self.axis_point_in_world + along + cosine * (arm - along) + sine * np.cross(direction, arm)


def eq3_points(
    range_m: npt.ArrayLike, bearing_rad: npt.ArrayLike, tilt_rad: npt.ArrayLike, dx_m: float, dz_m: float
) -> FloatArray:
    """Equation 3 as printed: (N, 3) points in the frame I of the tilt axis, of true ranges, bearings and tilts (N,)."""
    rho = np.asarray(range_m, dtype=np.float64)
    ci, si = np.cos(tilt_rad), np.sin(tilt_rad)
    cj, sj = np.cos(bearing_rad), np.sin(bearing_rad)
    x = ci * cj * rho + ci * dx_m + si * dz_m
    y = sj * rho
    z = -si * cj * rho - si * dx_m + ci * dz_m
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def _mount(roll_rad: float, yaw_rad: float) -> Rotation:
    return Rotation.from_rotvec([0.0, 0.0, yaw_rad]) * Rotation.from_rotvec([roll_rad, 0.0, 0.0])
