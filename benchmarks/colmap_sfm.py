"""The peer: COLMAP's structure from motion with spots for features, one image for each camera.

A camera's keypoints are its spots; two keypoints of one frame are a match. From there on it is COLMAP's own way: pairs
verified by epipolar geometry, then incremental mapping with its own robust losses. Nothing is known of the cameras but
their size, as for the product.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from network_calib.cameras import Cameras, LensModel
from network_calib.observations import IntArray, Observations

# COLMAP's own default guess of an unknown focal length, in parts of the longer image side.
FOCAL_GUESS = 1.2
MIN_MATCHES = 15


@dataclass(frozen=True, slots=True)
class SfmModel:
    """What COLMAP found: the cameras when all are registered, else None."""

    n_registered: int
    cameras: Cameras | None


def structure_from_motion(observations: Observations, size_px: Sequence[tuple[int, int]], *, seed: int) -> SfmModel:
    """Run COLMAP from spots to a model; the largest where it makes several."""
    pycolmap.logging.minloglevel = 3
    pycolmap.set_random_seed(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "spots.db"
        _write_database(path, observations, size_px)
        pycolmap.geometric_verification(path)
        options = pycolmap.IncrementalPipelineOptions()
        options.min_model_size = 3
        options.multiple_models = False
        options.extract_colors = False
        models = pycolmap.incremental_mapping(path, folder, Path(folder) / "models", options)
    if not models:
        return SfmModel(0, None)
    best = max(models.values(), key=lambda model: model.num_reg_images())
    n = best.num_reg_images()
    return SfmModel(n, cameras_of(best, observations.camera_names, size_px) if n == len(size_px) else None)


def _write_database(path: Path, observations: Observations, size_px: Sequence[tuple[int, int]]) -> None:
    n_cameras, n_frames = observations.n_cameras, int(observations.frame.max()) + 1
    number = np.full((n_cameras, n_frames), -1, dtype=np.int64)
    database = pycolmap.Database.open(path)
    for c, size in enumerate(size_px):
        own = observations.camera == c
        number[c, observations.frame[own]] = np.arange(own.sum())
        _write_image(database, c + 1, size)
        database.write_keypoints(c + 1, observations.px[own].astype(np.float32))
    for a, b in zip(*np.triu_indices(n_cameras, 1), strict=True):
        shared = np.flatnonzero((number[a] >= 0) & (number[b] >= 0))
        if len(shared) >= MIN_MATCHES:
            database.write_matches(int(a) + 1, int(b) + 1, number[[a, b]][:, shared].T.astype(np.uint32))
    database.close()


def _write_image(database: Any, identity: int, size: tuple[int, int]) -> None:
    """One camera with one image; since COLMAP 4 an image stands in a frame of a rig, here trivial ones."""
    width, height = size
    camera = pycolmap.Camera(
        model="RADIAL",
        width=width,
        height=height,
        params=[FOCAL_GUESS * max(size), width / 2, height / 2, 0, 0],
        camera_id=identity,
    )
    rig = pycolmap.Rig(rig_id=identity)
    rig.add_ref_sensor(camera.sensor_id)
    image = pycolmap.Image(name=f"{identity}", camera_id=identity, image_id=identity)
    frame = pycolmap.Frame()
    frame.frame_id = frame.rig_id = identity
    frame.add_data_id(image.data_id)
    database.write_camera(camera, use_camera_id=True)
    database.write_rig(rig, use_rig_id=True)
    database.write_image(image, use_image_id=True)
    database.write_frame(frame, use_frame_id=True)


def cameras_of(model: Any, names: tuple[str, ...], size_px: Sequence[tuple[int, int]] | IntArray) -> Cameras:
    """RADIAL cameras 1, 2, ... of a reconstruction. Spots went in unshifted, and so do principal points come out."""
    identities = range(1, len(size_px) + 1)
    parameters = np.array([model.cameras[k].params for k in identities])
    intrinsics = np.zeros((len(size_px), 8))
    intrinsics[:, 0] = intrinsics[:, 1] = parameters[:, 0]
    intrinsics[:, 2:6] = parameters[:, 1:5]
    poses = np.tile(np.eye(4), (len(size_px), 1, 1))
    poses[:, :3] = [model.images[k].cam_from_world().matrix() for k in identities]
    return Cameras(
        names=names,
        size_px=np.array(size_px, dtype=np.int64),
        lenses=(LensModel.K1_K2,) * len(size_px),
        intrinsics=intrinsics,
        cam_from_world=RigidTransform.from_matrix(poses),
    )
