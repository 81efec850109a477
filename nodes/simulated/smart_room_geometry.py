"""The truth of the simulated smart room: 6 x 4 m, five cameras, a tilting scanner below the stereo pair.

The world is the room's own frame: x along its 6 m, y across, z up, the origin on the floor in the middle of a short
wall. The stereo pair hangs on the long wall at y = -2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.synthetic import BoxRoom, LrfScene
from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.observations import FloatArray
from network_calib.synthetic_rooms import look_at

LRF_NAME = "L0"
SIZE_PX = (640, 480)
LOW_M, HIGH_M = (0.0, -2.0, 0.0), (6.0, 2.0, 2.9)
# The pair looks across the room, two cameras come from the far corners, one from a corner beside the pair.
CENTRES_M = ((2.75, -1.65, 2.3), (3.25, -1.65, 2.3), (5.65, 1.65, 2.4), (0.35, 1.65, 2.5), (5.65, -1.65, 2.55))
TARGETS_M = ((2.85, 1.0, 1.0), (3.15, 1.0, 1.0), (2.6, -0.2, 1.1), (3.4, -0.2, 1.1), (2.4, 0.2, 1.1))
# As far as an arm's reach and the walls let the spot come.
WAVED_LOW_M, WAVED_HIGH_M = (0.9, -1.5, 0.3), (5.1, 1.5, 2.15)
# In the middle of a long wall no wall is farther than the scanner reaches, 5.6 m: where one is about as far, its
# readings come and go like those of a spot.
TILT_AXIS_M = (3.05, -1.7, 1.75)
SCANNER_OFFSET_M = (0.04, 0.06)
# The scanner looks along the world's y.
ACROSS = Rotation.from_euler("z", 90, degrees=True)
MOUNT_DEG = (1.0, -0.5)
# Where the person stands at the crossings: range and bearing in the scan plane, far ones and near ones in turn; none so
# near that the scanner sees the rod that holds the spot.
PLACES = ((2.8, -0.42), (2.0, 0.15), (2.8, 0.42), (2.0, -0.3), (3.0, 0.0), (2.0, 0.5), (2.5, -0.2), (2.0, -0.5))

# By so much, m and rad, a place differs from tilt to tilt; and so far a hand drifts between rising and falling: two of
# the scanner's steps, so that their rounding is not the same in both.
PLACE_SPREAD, DRIFT_RAD = (0.1, 0.04), 0.025


@dataclass(frozen=True, slots=True)
class SmartRoom:
    """The truth.

    Attributes:
        cameras: C0 and C1 are the stereo pair.
        scanner: the LRF.
        seed: of all that is drawn.
    """

    cameras: Cameras
    scanner: TiltingScanner
    seed: int

    @classmethod
    def of(cls, seed: int) -> SmartRoom:
        """Draw lenses, and by how much cameras and scanner are mounted askew."""
        rng = np.random.default_rng([seed, 0x5A])
        centres, targets = np.array(CENTRES_M), np.array(TARGETS_M)
        askew = Rotation.from_rotvec(np.radians(1.5) * rng.standard_normal((len(centres), 3))).as_matrix()
        cameras = Cameras(
            names=tuple(f"C{k}" for k in range(len(centres))),
            size_px=np.tile(np.array(SIZE_PX, dtype=np.int64), (len(centres), 1)),
            lenses=(LensModel.K1_K2,) * len(centres),
            intrinsics=_lenses(len(centres), rng),
            cam_from_world=poses_from_centres(askew @ look_at(centres, targets), centres),
        )
        roll_rad, yaw_rad = np.radians(MOUNT_DEG)
        mounted = Rotation.from_rotvec(np.radians(0.7) * rng.standard_normal(3)) * ACROSS
        axis = RigidTransform.from_components(np.array(TILT_AXIS_M), mounted)
        scanner = TiltingScanner.from_paper(
            axis, *SCANNER_OFFSET_M, mount_roll_rad=float(roll_rad), mount_yaw_rad=float(yaw_rad)
        )
        return cls(cameras, scanner, seed)

    @property
    def baseline_m(self) -> float:
        """Between C0 and C1, which the user knows."""
        first, second = self.cameras.centres_in_world[:2]
        return float(np.linalg.norm(second - first))

    @property
    def scene(self) -> LrfScene:
        """As the emulated instruments want it; without spots."""
        room = BoxRoom(RigidTransform.identity(), np.array(LOW_M), np.array(HIGH_M))
        return LrfScene(self.cameras, self.scanner, np.zeros(0), np.empty((0, 3)), np.empty(0, dtype=np.int64), room)

    def place_in_world(self, tilt_rad: float, number: int, part: float) -> FloatArray:
        """(3,) a place in the scan plane, over and over, never quite the same; the hand drifts while it is there.

        Args:
            tilt_rad: of the plane.
            number: of the place.
            part: of the time there, from 0 to 1.
        """
        rng = np.random.default_rng([self.seed, 0x91, number, round(1e3 * tilt_rad) & 0xFFFF])
        range_m, bearing_rad = np.array(PLACES[number % len(PLACES)]) + rng.uniform(-1, 1, 2) * PLACE_SPREAD
        bearing_rad += DRIFT_RAD * (part - 0.5)
        return self.scanner.points_in_world(np.array([range_m]), np.array([bearing_rad]), tilt_rad)[0]


def _lenses(n: int, rng: np.random.Generator) -> FloatArray:
    """(n, 8) wide lenses with barrel distortion, principal points off by several px."""
    rows = np.zeros((n, 8))
    rows[:, :2] = rng.uniform(420, 470, (n, 1))
    rows[:, 2:4] = (np.array(SIZE_PX) - 1) / 2 + rng.choice([-1, 1], (n, 2)) * rng.uniform(3, 10, (n, 2))
    rows[:, 4] = rng.uniform(-0.28, -0.20, n)
    rows[:, 5] = rng.uniform(0.05, 0.08, n)
    return rows
