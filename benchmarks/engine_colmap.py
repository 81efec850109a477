"""The same bundle adjustment by pycolmap's Ceres: its RADIAL model, unit weights, so the cost is the same number."""

from __future__ import annotations

import re
import time
from typing import Any

import numpy as np
import pycolmap

from benchmarks.colmap_sfm import cameras_of
from benchmarks.engine_problem import COST_TOLERANCE, Scene, Solved


def solve_colmap(scene: Scene, n_threads: int) -> Solved:
    """By pycolmap; `n_threads` -1 is its default, all cores."""
    pycolmap.logging.minloglevel = 3
    model = _reconstruction(scene)
    config = pycolmap.BundleAdjustmentConfig()
    for c in range(len(scene.cameras)):
        config.add_image(c + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.solver_options.function_tolerance = COST_TOLERANCE
    options.ceres.solver_options.num_threads = n_threads
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    begin = time.perf_counter()
    summary = adjuster.solve()
    seconds = time.perf_counter() - begin
    return Solved(seconds, _cost(model, scene), int(re.findall(r"Iterations: (\d+)", summary.brief_report())[0]))


def _cost(model: Any, scene: Scene) -> float:
    """Half the sum of squares of a reconstruction, by this project's own projection."""
    cameras = cameras_of(model, scene.cameras.names, scene.cameras.size_px)
    points = np.array([model.points3D[j + 1].xyz for j in range(len(scene.points))])
    px, _ = cameras.img_from_world(scene.observations.camera, points[scene.observations.frame])
    return 0.5 * float(((px - scene.observations.px) ** 2).sum())


def _reconstruction(scene: Scene) -> Any:
    cameras, seen = scene.cameras, scene.observations
    model = pycolmap.Reconstruction()
    feature = np.zeros(len(seen), dtype=np.int64)
    for c, pose in enumerate(cameras.cam_from_world.as_matrix()):
        own = seen.camera == c
        feature[own] = np.arange(own.sum())
        width, height = cameras.size_px[c]
        parameters = cameras.intrinsics[c, [0, 2, 3, 4, 5]]
        camera = pycolmap.Camera(model="RADIAL", width=width, height=height, params=parameters, camera_id=c + 1)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=str(c), camera_id=c + 1, image_id=c + 1, keypoints=seen.px[own])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    ends = np.searchsorted(seen.frame, np.arange(len(scene.points) + 1))
    for j, point in enumerate(scene.points):
        track = pycolmap.Track()
        for k in range(ends[j], ends[j + 1]):
            track.add_element(int(seen.camera[k]) + 1, int(feature[k]))
        model.add_point3D(point, track)
    return model
