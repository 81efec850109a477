"""How long the joint solves take: LRF with a stereo pair, and LRF with five cameras that are solved as well."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.measure import interleaved
from benchmarks.report import Row, Run, at_most
from benchmarks.rooms import baseline_of, random_generator, setups_of, solve_once
from lrf_stereo.calibrate import LrfCalibration, calibrate_lrfs
from lrf_stereo.joint_problem import NetworkData
from lrf_stereo.noise import LrfNoise
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.scanner import ScanSteps, TiltingScanner
from lrf_stereo.study import StudySetup, simulate
from network_calib.observations import FloatArray, IntArray, Observations
from network_calib.optimum import Network
from network_calib.room_setup import Options
from network_calib.spots import SpotViews
from network_calib.synthetic import Room, observe, room
from network_calib.world import in_world

N_FRAMES, SIGMA_PX, HEIGHT_SIGMA_M = 2000, 0.2, 4e-3
N_SIGHTINGS = 66
TILTS_RAD = np.radians([-12.0, 0.0, 12.0])
# Spots that are moved no farther than this into a scan plane stay in view.
MAX_MOVE_M = 0.25


def time_rows(run: Run) -> Iterator[Row]:
    """Wall times; nothing fails on a slow machine."""
    yield _stereo(run)
    yield _five_cameras(run)


def _stereo(run: Run) -> Row:
    data = simulate(StudySetup(), n_spots=22, run=0, seed=0)

    def joint() -> LrfCalibration:
        return calibrate_lrfs(data.network, data.spots, data.settings, rng=random_generator(0))

    (timed,) = interleaved([joint], repeats=run.pick(20, 3))
    note = "start, outlier rounds, covariance and checks included"
    return at_most("joint LRF + stereo solve, 66 spots: time", timed.seconds, 0.2, unit=" s", note=note)


def _five_cameras(run: Run) -> Row:
    truth, spots, settings = _room_with_lrf()
    observations = observe(truth, rng=random_generator(3), sigma_px=SIGMA_PX).observations

    def cameras_alone() -> LrfCalibration | Network:
        return solve_once(observations, setups_of(truth), anchor=baseline_of(truth))

    def cameras_and_lrf() -> LrfCalibration | Network:
        return _with_lrf(truth, observations, spots, settings)

    alone, both = interleaved([cameras_alone, cameras_and_lrf], repeats=run.pick(7, 2))
    note = f"{both.seconds:.2f} s against {alone.seconds:.2f} s"
    what = f"five cameras × {N_FRAMES:,} spots + LRF / the cameras alone: time"
    return at_most(what, both.seconds / alone.seconds, 2.0, note=note)


def _with_lrf(truth: Room, observations: Observations, spots: LrfSpots, settings: TiltSettings) -> LrfCalibration:
    """Cameras first, then everything together, as a session with an LRF is calibrated."""
    anchor, setups, views = baseline_of(truth), setups_of(truth), SpotViews.of(observations)
    network = solve_once(observations, setups, anchor=anchor)
    _, refined = in_world(network.refined, views, anchor, Options())
    data = NetworkData(
        setups=setups,
        cameras=refined.cameras,
        views=views,
        points=refined.points,
        is_inlier=refined.is_inlier,
        noise=refined.noise,
        is_held=False,
        baseline=anchor,
    )
    return calibrate_lrfs(data, spots, settings, rng=random_generator(0))


def _room_with_lrf() -> tuple[Room, LrfSpots, TiltSettings]:
    """The smart room with a scanner at its stereo pair; some spots of the walk are moved into its scan planes."""
    rng = random_generator(2)
    walk = room("smart_room", rng=rng, n_frames=N_FRAMES)
    scanner = _scanner(walk)
    heights = np.stack([scanner.measure(walk.trajectory, float(tilt))[2] for tilt in TILTS_RAD])
    setting = np.abs(heights).argmin(axis=0)
    near = np.flatnonzero(np.abs(heights).min(axis=0) < MAX_MOVE_M)
    frame = np.sort(rng.choice(near, N_SIGHTINGS, replace=False))
    tilts = TILTS_RAD[setting[frame]]
    normals = scanner.world_from_lrf_at(tilts).rotation.as_matrix()[:, :, 2]
    # Into the plane, but for the crossing's error.
    move = HEIGHT_SIGMA_M * rng.standard_normal(N_SIGHTINGS) - heights[setting[frame], frame]
    trajectory = walk.trajectory.copy()
    trajectory[frame] += move[:, None] * normals
    settings = TiltSettings(np.zeros(len(TILTS_RAD), dtype=np.int64), TILTS_RAD, np.zeros((3, 3)))
    spots = _sightings(scanner, frame, setting[frame], trajectory[frame], rng)
    return replace(walk, trajectory=trajectory), spots, settings


def _scanner(walk: Room) -> TiltingScanner:
    """Beside C0, its forward axis along the camera's."""
    # LRF axes x forward, y left, z up are z, -x, -y of the camera.
    cam_from_lrf = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    axis = RigidTransform.from_components([0.1, 0.0, 0.0], cam_from_lrf)
    return TiltingScanner.from_paper(walk.cameras.cam_from_world[0].inv() * axis, 0.04, 0.06)


def _sightings(
    scanner: TiltingScanner, frame: IntArray, setting: IntArray, points: FloatArray, rng: np.random.Generator
) -> LrfSpots:
    noise, steps, n = LrfNoise(), ScanSteps(), len(frame)
    range_m, bearing, _ = scanner.measure(points, TILTS_RAD[setting])
    sigma_range = noise.range_m(range_m)
    return LrfSpots(
        frame=frame,
        setting=setting,
        range_m=range_m + sigma_range * rng.standard_normal(n),
        bearing_rad=steps.bearing_rad(np.round(steps.step(bearing))),
        out_of_plane_m=np.zeros(n),
        sigma_range_m=sigma_range,
        sigma_bearing_rad=np.full(n, noise.bearing_rad),
        sigma_out_of_plane_m=np.full(n, HEIGHT_SIGMA_M),
    )
