"""The joint engine against COLMAP's bundle adjustment: the same problem, the same start, the same optimum."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from network_calib.blocks import Problem, State
from network_calib.bundle import SolverOptions, solve
from network_calib.camera_block import PART, cameras_of
from network_calib.camera_parameters import CameraParameters, free_columns
from network_calib.cameras import Cameras, LensModel
from network_calib.gauge import inner_gauge
from network_calib.spots import SpotViews
from network_calib.synthetic import compare
from tests.network_calib.scenes import camera_block, perturbed, waved

pycolmap = pytest.importorskip("pycolmap")
# COLMAP counts from the corner of the top-left pixel, we from its centre.
HALF_PIXEL = 0.5


def same_problem(name, **numbers):
    """A joint problem without priors, free in all that COLMAP's OPENCV model frees, and a start off the truth."""
    scene, seen = waved(name, **numbers)
    n = len(scene.cameras)
    cameras = Cameras(
        scene.cameras.names,
        scene.cameras.size_px,
        (LensModel.K1_K2_P1_P2,) * n,
        scene.cameras.intrinsics,
        scene.cameras.cam_from_world,
    )
    columns = free_columns(
        cameras.lenses,
        is_pose_fixed=np.zeros(n, dtype=bool),
        is_intrinsics_fixed=np.zeros(n, dtype=bool),
        groups=np.arange(n),
        is_aspect_free=True,
    )
    views = SpotViews.of(seen.observations)
    block = camera_block(views.camera, views.point, views.px, columns)
    truth = State(
        {PART: CameraParameters.from_cameras(cameras, columns)},
        np.ascontiguousarray(scene.trajectory[views.frames].T),
    )
    return cameras, views, Problem([block], (), inner_gauge), perturbed(truth, size=0.5)


def colmap_reconstruction(cameras, views, points):
    """The same cameras, tracks and points as a COLMAP reconstruction."""
    reconstruction = pycolmap.Reconstruction()
    index_in_image = np.zeros(len(views.camera), dtype=int)
    for c in range(len(cameras)):
        own = views.camera == c
        index_in_image[own] = np.arange(own.sum())
        params = cameras.intrinsics[c].copy()
        params[2:4] += HALF_PIXEL
        width, height = cameras.size_px[c]
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(model="OPENCV", width=int(width), height=int(height), params=params, camera_id=c + 1)
        )
        image = pycolmap.Image(
            name=cameras.names[c], camera_id=c + 1, image_id=c + 1, keypoints=views.px[own] + HALF_PIXEL
        )
        rotation = cameras.rotations[c]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ cameras.centres_in_world[c])
        reconstruction.add_image_with_trivial_frame(image, pose)
    for j, point in enumerate(points):
        track = pycolmap.Track()
        for k in np.flatnonzero(views.point == j):
            track.add_element(int(views.camera[k]) + 1, int(index_in_image[k]))
        reconstruction.add_point3D(point, track)
    return reconstruction


def adjusted_by_colmap(cameras, reconstruction):
    """COLMAP's optimum: cameras, points, and half the sum of squared pixels."""
    config = pycolmap.BundleAdjustmentConfig()
    for c in range(len(cameras)):
        config.add_image(c + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.solver_options.function_tolerance = 1e-14
    options.ceres.solver_options.gradient_tolerance = 1e-12
    options.ceres.solver_options.parameter_tolerance = 1e-14
    options.ceres.solver_options.max_num_iterations = 500
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    images = [reconstruction.image(c + 1) for c in range(len(cameras))]
    matrices = np.tile(np.eye(4), (len(cameras), 1, 1))
    for c, image in enumerate(images):
        matrices[c, :3] = image.cam_from_world().matrix()
    intrinsics = np.stack([reconstruction.camera(c + 1).params for c in range(len(cameras))])
    intrinsics[:, 2:4] -= HALF_PIXEL
    found = Cameras(cameras.names, cameras.size_px, cameras.lenses, intrinsics, RigidTransform.from_matrix(matrices))
    return found, np.stack([reconstruction.point3D(j + 1).xyz for j in range(len(reconstruction.points3D))])


@pytest.mark.parametrize(
    ("name", "numbers"),
    [("ring_room", {"n_cameras": 5, "n_frames": 700, "missing": 0.3}), ("smart_room", {"n_frames": 400, "seed": 2})],
)
def test_optimum_is_that_of_colmap(name, numbers):
    cameras, views, problem, start = same_problem(name, **numbers)
    found = solve(problem, start, SolverOptions(cost_tolerance=1e-12))
    assert found.has_converged
    start_cameras = cameras_of(start.parts).apply_to(cameras)
    theirs, their_points = adjusted_by_colmap(
        start_cameras, colmap_reconstruction(start_cameras, views, start.points.T)
    )
    px, _ = theirs.img_from_world(views.camera, their_points[views.point])
    their_cost = 0.5 * ((px - views.px) ** 2).sum()
    # Four digits are the promise; with such tolerances in both, many more of the cost agree.
    assert found.cost == pytest.approx(their_cost, rel=1e-7)
    ours = cameras_of(found.state.parts).apply_to(cameras)
    errors = compare(ours, theirs)
    size_m = np.linalg.norm(np.ptp(theirs.centres_in_world, axis=0))
    assert errors.centre_m.max() < 1e-4 * size_m
    assert errors.rotation_deg.max() < np.degrees(1e-4)
    np.testing.assert_allclose(ours.intrinsics[:, :4], theirs.intrinsics[:, :4], rtol=1e-4)
    np.testing.assert_allclose(ours.intrinsics[:, 4:], theirs.intrinsics[:, 4:], atol=1e-4)
    # The start is much further away: agreement is not that of two solvers that did not move.
    assert compare(start_cameras, theirs).centre_m.max() > 20 * 1e-4 * size_m
