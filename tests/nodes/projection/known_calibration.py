"""A calibration of given cameras and scanners, with covariances; and the cameras and scanner of a small room."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.scanner_part import ScannerPart
from network_calib.camera_parameters import CameraParameters
from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.result import (
    CalibratedCamera,
    Calibration,
    CameraQuality,
    ErrorSummary,
    NetworkQuality,
    Provenance,
    WorldFrame,
)
from network_calib.synthetic_rooms import look_at
from nodes.simulation.lrf_simulation import true_lrf

TERMS = {
    LensModel.NONE: (0, 0, 0, 0),
    LensModel.K1: (-0.15, 0, 0, 0),
    LensModel.K1_K2: (-0.26, 0.07, 0, 0),
    LensModel.K1_K2_P1_P2: (-0.26, 0.07, 0.002, -0.003),
    LensModel.FISHEYE: (-0.02, 0.004, -0.002, 0.0002),
}
LRF = "L0"
NONE = ErrorSummary(0, np.nan, np.nan, np.nan, np.nan)
QUALITY = NetworkQuality(0, 0, 0, NONE, NONE, np.nan, np.nan, np.nan, np.nan, np.nan)


def a_scanner():
    """On a wall, every parameter away from its neutral value."""
    pose = RigidTransform.from_components([-2.5, -0.1, 2.1], Rotation.from_rotvec([0.05, -0.1, 0.2]))
    scanner = TiltingScanner.from_paper(pose, 0.04, 0.06, mount_roll_rad=0.02, mount_yaw_rad=-0.015)
    return replace(
        scanner, reference_tilt_rad=0.1, tilt_gain=1.02, range_bias_m=0.012, range_scale=1.01, bearing_zero_rad=0.01
    )


def cameras_of(lenses, seed=0):
    """Under the ceiling, looking at the middle of the floor."""
    rng = np.random.default_rng(seed)
    n = len(lenses)
    centres = np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-3, 3, n), rng.uniform(2.2, 2.8, n)])
    targets = 0.5 * rng.standard_normal((n, 3))
    intrinsics = np.zeros((n, 8))
    intrinsics[:, :2] = rng.uniform(400, 500, (n, 1)) * [1.0, 1.01]
    intrinsics[:, 2:4] = [322.0, 236.0]
    intrinsics[:, 4:] = [TERMS[lens] for lens in lenses]
    poses = poses_from_centres(look_at(centres, targets), centres)
    return Cameras(tuple(f"C{i}" for i in range(n)), np.tile([640, 480], (n, 1)), tuple(lenses), intrinsics, poses)


def result_of(cameras, scanner, camera_covariance=None, lrf_covariance=None):
    """The calibration that says exactly this."""
    of_camera = np.zeros((len(cameras), 14, 14)) if camera_covariance is None else camera_covariance
    of_lrf = np.zeros((15, 15)) if lrf_covariance is None else lrf_covariance
    lrf = replace(true_lrf(scanner, np.array([0.1, 0.3])), name=LRF, covariance=of_lrf, held=())
    return Calibration(
        cameras=tuple(
            CalibratedCamera(
                cameras.names[k],
                (int(cameras.size_px[k, 0]), int(cameras.size_px[k, 1])),
                cameras.lenses[k],
                cameras.intrinsics[k],
                cameras.cam_from_world[k],
                of_camera[k],
                False,
                CameraQuality(0, NONE, NONE, 0.3, 0.0),
            )
            for k in range(len(cameras))
        ),
        world=WorldFrame("floor", "m", "truth", 0.0),
        quality=QUALITY,
        warnings=(),
        provenance=Provenance("test", "", "room", "", 0, "truth", "{}"),
        lrfs=(lrf,),
    )


def moved_cameras(cameras, steps):
    """The cameras moved by steps (C, 14) in the order of PARAMETER_NAMES."""
    columns = np.arange(steps.size).reshape(steps.shape)
    return CameraParameters.from_cameras(cameras, columns).retract(steps.ravel()).apply_to(cameras)


def moved_scanner(scanner, step):
    """The scanner moved by a step (15,) in the order of LRF_PARAMETER_NAMES."""
    part = ScannerPart.from_scanners((scanner,), np.arange(15)[None])
    return part.retract(step).apply_to((scanner,))[0]
