"""Scenes that several tests share: named rooms with detections, what is known of them, and their joint problems."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from network_calib.blocks import Problem, State
from network_calib.calibrate import calibrate
from network_calib.camera_block import PART, CameraBlock
from network_calib.camera_parameters import N_PARAMETERS, CameraParameters, free_columns
from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.gauge import inner_gauge
from network_calib.observations import FloatArray, IntArray, Observations
from network_calib.refine import build_problem
from network_calib.result import Calibration
from network_calib.robust_loss import Loss, SquaredLoss
from network_calib.room_setup import CameraSetup, KnownDistance, Options
from network_calib.spots import SpotViews
from network_calib.synthetic import Room, Sighting, observe, room
from network_calib.synthetic_rooms import look_at

SIGMA_PX = 0.2


@functools.cache
def waved(
    name: str,
    *,
    seed: int = 0,
    n_frames: int | None = None,
    n_cameras: int | None = None,
    missing: float = 0.0,
    false_detections: float = 0.0,
) -> tuple[Room, Sighting]:
    """A named room and the detections of its spot at 0.2 px."""
    rng = np.random.default_rng(seed)
    scene = room(name, rng=rng, n_frames=n_frames, n_cameras=n_cameras)
    return scene, observe(scene, rng=rng, sigma_px=SIGMA_PX, missing=missing, false_detections=false_detections)


def setups_of(scene: Room) -> list[CameraSetup]:
    """Image sizes and lens models; intrinsics unknown."""
    cameras = scene.cameras
    return [
        CameraSetup(name, (int(width), int(height)), lens)
        for name, (width, height), lens in zip(cameras.names, cameras.size_px, cameras.lenses, strict=True)
    ]


def stereo_anchor(scene: Room) -> KnownDistance:
    """The true baseline of the stereo pair."""
    return KnownDistance("C0", "C1", scene.baseline_m, is_stereo_pair=True)


@functools.cache
def calibrated(
    name: str,
    *,
    seed: int = 0,
    n_frames: int | None = None,
    n_cameras: int | None = None,
    missing: float = 0.3,
    false_detections: float = 0.1,
) -> tuple[Room, Calibration]:
    """A named room calibrated from its own detections with the stereo baseline for scale."""
    scene, seen = waved(
        name, seed=seed, n_frames=n_frames, n_cameras=n_cameras, missing=missing, false_detections=false_detections
    )
    options = Options(n_repeats=1)
    return scene, calibrate(seen.observations, setups_of(scene), anchor=stereo_anchor(scene), options=options)


def joint_problem(
    scene: Room,
    seen: Sighting,
    *,
    loss: Loss | None = None,
    setups: Sequence[CameraSetup] | None = None,
    has_prior: bool = True,
) -> tuple[Problem, State, SpotViews]:
    """The joint problem of all detections, its state at the truth, and the views in the order of its rows."""
    views = SpotViews.of(seen.observations)
    problem, state = build_problem(
        setups_of(scene) if setups is None else setups,
        scene.cameras,
        views,
        scene.trajectory[views.frames],
        np.arange(len(views.camera)),
        np.ones(views.n_points, dtype=bool),
        np.full(views.n_cameras, SIGMA_PX),
        SquaredLoss() if loss is None else loss,
    )
    return (problem if has_prior else Problem(problem.point_blocks, (), problem.gauge)), state, views


def block_of(problem: Problem) -> CameraBlock:
    """The one camera block of a problem."""
    (block,) = problem.point_blocks
    assert isinstance(block, CameraBlock)
    return block


def perturbed(state: State, *, seed: int = 0, size: float = 1.0) -> State:
    """The state with cameras turned by about 0.6 degrees, moved by 2 cm, focal lengths off by 8 px, spots by 2 cm."""
    rng = np.random.default_rng(seed)
    parameters = state.parts[PART]
    assert isinstance(parameters, CameraParameters)
    scale = np.array([*[0.01] * 3, *[0.02] * 3, 8.0, 0.0, 4.0, 4.0, *[0.01] * 2, *[0.0] * 2])
    moves = size * scale * rng.standard_normal((len(parameters.columns), N_PARAMETERS))
    step = np.zeros(parameters.size)
    is_free = parameters.columns >= 0
    step[parameters.columns[is_free]] = moves[is_free]
    return state.retract(step, size * 0.02 * rng.standard_normal(state.points.shape))


def random_problem(
    *, n_cameras: int, n_points: int, seed: int = 0, missing: float = 0.0, loss: Loss | None = None
) -> tuple[Problem, State]:
    """Pinholes on a ring around spots drawn evenly in a ball, the state off the optimum.

    Camera 0 sees only the first half of the spots.
    """
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(n_cameras) / n_cameras
    centres = np.stack([4 * np.cos(angle), 4 * np.sin(angle), 1 + rng.random(n_cameras)], axis=1)
    lenses = (LensModel.K1,) * n_cameras
    cameras = Cameras(
        names=tuple(f"C{i}" for i in range(n_cameras)),
        size_px=np.full((n_cameras, 2), 600),
        lenses=lenses,
        intrinsics=np.tile([500.0, 500.0, 300.0, 300.0, -0.1, 0.0, 0.0, 0.0], (n_cameras, 1)),
        cam_from_world=poses_from_centres(look_at(centres, 0.3 * rng.standard_normal((n_cameras, 3))), centres),
    )
    points = rng.uniform(-1, 1, (n_points, 3))
    point, camera = (a.ravel() for a in np.meshgrid(np.arange(n_points), np.arange(n_cameras), indexing="ij"))
    is_seen = (rng.random(len(point)) >= missing) & ((camera != 0) | (point < n_points / 2))
    n_views = np.bincount(point[is_seen], minlength=n_points)
    is_seen |= (n_views[point] < 2) & (camera > 0)
    point, camera = point[is_seen], camera[is_seen]
    px, _ = cameras.img_from_world(camera, points[point])
    px += rng.standard_normal(px.shape)
    columns = free_columns(
        lenses,
        is_pose_fixed=np.zeros(n_cameras, dtype=bool),
        is_intrinsics_fixed=np.zeros(n_cameras, dtype=bool),
        groups=np.arange(n_cameras),
    )
    block = camera_block(camera, point, px, columns, loss=loss)
    return Problem([block], (), inner_gauge), State(
        {PART: CameraParameters.from_cameras(cameras, columns)}, np.ascontiguousarray(points.T)
    )


def camera_block(
    camera: IntArray, point: IntArray, px: FloatArray, columns: IntArray, *, loss: Loss | None = None
) -> CameraBlock:
    """A block of detections (K, 2) of one pixel noise."""
    return CameraBlock(
        group=camera,
        point=point,
        px=np.ascontiguousarray(px.T),
        inverse_sigma=np.ones(len(camera)),
        columns=columns,
        loss=SquaredLoss() if loss is None else loss,
    )


def dense_jacobian(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """Residuals (M,) and Jacobian (M, n + 3 F) of a small problem, row by row; points follow in the order x, y, z."""
    n, n_points = state.n_shared, state.points.shape[1]
    rows, residuals = [], []
    for block in problem.point_blocks:
        residual, by_shared, by_point = block.linearise(
            state.parts, state.points[:, block.point], slice(0, len(block.point))
        )
        weight = block.loss.weight((residual**2).sum(axis=0))
        root = np.ones(residual.shape[1]) if weight is None else np.sqrt(weight)
        for k in range(residual.shape[1]):
            columns = block.columns[block.group[k]]
            for m in range(residual.shape[0]):
                row = np.zeros(n + 3 * n_points)
                row[columns[columns >= 0]] = by_shared[columns >= 0, m, k] * root[k]
                row[n + 3 * block.point[k] + np.arange(3)] = by_point[:, m, k] * root[k]
                rows.append(row)
                residuals.append(residual[m, k] * root[k])
    for shared in problem.shared_blocks:
        residual, jacobian = shared.linearise(state.parts)
        for k in range(len(residual)):
            row = np.zeros(n + 3 * n_points)
            is_used = shared.columns[k] >= 0
            row[shared.columns[k][is_used]] = jacobian[k][is_used]
            rows.append(row)
            residuals.append(residual[k])
    return np.array(residuals), np.array(rows)


def with_frames_shifted(observations: Observations, camera: int, n_frames: int) -> Observations:
    """The same detections, one camera's frame numbers moved by n_frames."""
    frame = observations.frame + np.where(observations.camera == camera, n_frames, 0)
    return Observations.from_columns(
        observations.camera_names, camera=observations.camera, frame=frame, px=observations.px
    )
