"""A calibration with an LRF on disk, and the service that answers under it, in this process."""

import threading
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import paper_scene
from network_calib.formats.calibration_json import save
from network_calib.synthetic import Room, observe
from nodes.bus.session import BusOptions
from nodes.projection.points import Beams
from nodes.projection.service import run_projection
from nodes.simulation.lrf_simulation import true_lrf
from nodes.simulation.spots_simulation import truth_calibration

SITE = "s1"
TILT_RAD = 0.4
SIGMA_PX, SIGMA_M = 0.5, 1e-3


def calibration_of(seed):
    """Five cameras and the LRF L0, with covariances of about half a pixel and a millimetre."""
    rng = np.random.default_rng(seed)
    scene = paper_scene(rng=rng, n_room_cameras=3)
    room = Room("served", scene.cameras, scene.spots_in_world, 25.0)
    result = truth_calibration(room, observe(room, rng=rng, sigma_px=0.2), noise_px=0.2, seed=seed)
    cameras = tuple(
        replace(camera, covariance=_covariance(14, rng), is_intrinsics_fixed=False) for camera in result.cameras
    )
    lrf = replace(true_lrf(scene.scanner, scene.tilts_rad), covariance=_covariance(15, rng), held=())
    return replace(result, cameras=cameras, lrfs=(lrf,))


def _covariance(n, rng):
    root = SIGMA_M * rng.standard_normal((n, n)) / np.sqrt(n)
    return root @ root.T


def write_calibration(path, seed=1):
    save(calibration_of(seed), path)
    return path


def beams(*, seed=3, **changes):
    """A whole scan of an URG-04LX, a few of its beams without a range."""
    rng = np.random.default_rng(seed)
    bearing_rad = ScanSteps().bearings_rad
    range_m = rng.uniform(1.0, 3.5, len(bearing_rad))
    range_m[::50] = np.nan
    return replace(Beams("L0", range_m, bearing_rad, TILT_RAD), **changes)


@contextmanager
def serving(endpoint, calibration):
    """The service in a thread, under a file or, with None, under what the bus tells; gives what it said."""
    stop, said = threading.Event(), []
    thread = threading.Thread(
        target=run_projection,
        args=(BusOptions(SITE, (endpoint,)), calibration),
        kwargs={"stop": stop, "say": said.append},
        daemon=True,
    )
    thread.start()
    try:
        yield said
    finally:
        stop.set()
        thread.join(20)
        assert not thread.is_alive()
