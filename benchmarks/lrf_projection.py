"""Equation 14 against a loop of `cv2.projectPoints`: a whole scan into 5 and into 1,000 cameras, one thread each.

OpenCV's Python function computes its Jacobian whether asked or not, and neither validity nor covariance. The cameras'
rotation vectors and matrices are prepared outside its loop, as is what the projector prepares once for a calibration.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.measure import interleaved
from benchmarks.report import Row, Run, at_least, at_most
from benchmarks.rooms import random_generator
from lrf_stereo.noise import LrfNoise
from lrf_stereo.projection import CalibrationCovariance, LrfProjector, project_lrf
from lrf_stereo.scanner import ScanSteps, TiltingScanner
from lrf_stereo.scanner_part import N_SCANNER
from lrf_stereo.synthetic import paper_scene
from lrf_stereo.synthetic_scans import ScannedRoom
from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.observations import FloatArray
from network_calib.synthetic_rooms import look_at

TILT_RAD = float(np.radians(23.2))


def measure(run: Run) -> Iterator[Row]:
    """Speed and agreement for both network sizes."""
    cv2.setNumThreads(1)
    scene = paper_scene(rng=random_generator(5), n_room_cameras=3)
    range_m, _ = ScannedRoom.of(scene, rng=random_generator(6)).true_ranges(TILT_RAD)
    site = _cameras_of_a_site(1000, scene.room.world_from_room, random_generator(7))
    for cameras, repeats in ((scene.cameras, run.pick(100, 20)), (site, run.pick(15, 5))):
        yield from _against_opencv(scene.scanner, cameras, range_m, repeats)


def _against_opencv(scanner: TiltingScanner, cameras: Cameras, range_m: FloatArray, repeats: int) -> Iterator[Row]:
    bearings, noise = ScanSteps().bearings_rad, LrfNoise(tilt_rad=1e-3)
    points = scanner.points_in_world(range_m, bearings, TILT_RAD)
    prepared = [_for_opencv(cameras, i) for i in range(len(cameras))]
    covariance = _uncertain(cameras, random_generator(8))
    plain, spread = LrfProjector(scanner, cameras), LrfProjector(scanner, cameras, covariance=covariance)

    # What is measured is thrown away: kept from round to round, large results would make every run fetch new memory.
    def loop() -> None:
        for one in prepared:
            cv2.projectPoints(points, *one)

    def ours() -> None:
        plain.project(range_m, bearings, TILT_RAD)

    def unprepared() -> None:
        project_lrf(scanner, cameras, range_m, bearings, TILT_RAD)

    def with_covariance() -> None:
        spread.project(range_m, bearings, TILT_RAD, noise=noise)

    timings = interleaved([loop, ours, unprepared, with_covariance], repeats=repeats)
    # The fastest of many runs: what another program does at the same time only ever adds.
    times = [1e3 * min(one.all_s) for one in timings]
    projection = plain.project(range_m, bearings, TILT_RAD)
    by_opencv = np.stack([cv2.projectPoints(points, *one)[0].reshape(-1, 2) for one in prepared])
    difference = np.abs(projection.px - by_opencv)[projection.is_valid]
    what = f"{len(range_m)} beams x {len(cameras)} cameras"
    share = f"{100 * projection.is_valid.mean():.0f} % of the pixels valid"
    notes = [f"{times[0]:.2f} ms over {time:.2f} ms" for time in times]
    yield at_least(f"{what}, with validity, over OpenCV", times[0] / times[1], 2, note=notes[1])
    yield Row(f"{what}, the same unprepared", f"{times[0] / times[2]:.3g} ({notes[2]})")
    yield at_least(f"{what}, with covariance", times[0] / times[3], 1, note=f"{notes[3]}, {share}")
    yield at_most(f"{what}, difference to OpenCV", float(difference.max()), 1e-9, unit=" px")


def _cameras_of_a_site(n: int, world_from_room: RigidTransform, rng: np.random.Generator) -> Cameras:
    """Surveillance cameras under the ceiling of the scanner's room, all looking at its middle."""
    centres = np.column_stack([rng.uniform(0.1, 5.9, n), rng.uniform(-2.4, 2.4, n), rng.uniform(2.2, 2.8, n)])
    targets = np.array([2.5, 0.0, 0.8]) + 0.5 * rng.standard_normal((n, 3))
    intrinsics = np.zeros((n, 8))
    intrinsics[:, :2] = rng.uniform(400, 520, (n, 1))
    intrinsics[:, 2:4] = [319.5, 239.5]
    intrinsics[:, 4], intrinsics[:, 5] = rng.uniform(-0.30, -0.20, n), 0.06
    return Cameras(
        names=tuple(f"C{i}" for i in range(n)),
        size_px=np.tile([640, 480], (n, 1)),
        lenses=(LensModel.K1_K2,) * n,
        intrinsics=intrinsics,
        cam_from_world=poses_from_centres(look_at(centres, targets), centres) * world_from_room.inv(),
    )


def _for_opencv(cameras: Cameras, camera: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    pose, row = cameras.cam_from_world.as_matrix()[camera], cameras.intrinsics[camera]
    matrix = np.array([[row[0], 0, row[2]], [0, row[1], row[3]], [0, 0, 1]])
    return np.asarray(cv2.Rodrigues(pose[:3, :3])[0]), pose[:3, 3].copy(), matrix, row[4:]


def _uncertain(cameras: Cameras, rng: np.random.Generator) -> CalibrationCovariance:
    """Covariances as a calibration gives them: aspect and tangential terms held, everything else correlated."""
    roots = rng.standard_normal((len(cameras), 14, 14)) * 1e-3
    roots[:, [7, 12, 13]] = 0.0
    scanner = rng.standard_normal((N_SCANNER, N_SCANNER)) * 1e-3
    return CalibrationCovariance(roots @ roots.transpose(0, 2, 1), scanner @ scanner.T)
