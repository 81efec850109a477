"""A small room with cameras and an LRF whose calibration is known, and what its node would publish of it."""

from dataclasses import replace

import numpy as np

from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import paper_scene
from lrf_stereo.synthetic_scans import ScannedRoom
from network_calib.result import (
    PARAMETER_NAMES,
    CalibratedCamera,
    CameraQuality,
    ErrorSummary,
    NetworkQuality,
    Provenance,
    WorldFrame,
)
from network_calib.result import Calibration as Result
from nodes.bus import spotcal_pb2 as pb
from nodes.projection.calibration import Calibration
from nodes.simulation.lrf_simulation import LRF_NAME, true_lrf

STEPS = ScanSteps()
NONE = ErrorSummary(0, np.nan, np.nan, np.nan, np.nan)
NODE = "n-lrf"
TILT_RAD = float(np.radians(23.2))
CLOCK_OFFSET_S = 0.004


def scene(seed=5, *, n_room_cameras=3):
    return paper_scene(rng=np.random.default_rng(seed), n_room_cameras=n_room_cameras)


def calibration_of(truth, *, name="c1", sigma=1e-3):
    """The true calibration, each parameter uncertain by sigma (rad, m; intrinsics are exact)."""
    covariance = np.zeros((len(PARAMETER_NAMES),) * 2)
    covariance[:6, :6] = sigma**2 * np.eye(6)
    cameras = truth.cameras
    lrf = true_lrf(replace(truth.scanner, clock_offset_s=CLOCK_OFFSET_S), truth.tilts_rad)
    result = Result(
        cameras=tuple(
            CalibratedCamera(
                name=cameras.names[k],
                size_px=(int(cameras.size_px[k, 0]), int(cameras.size_px[k, 1])),
                lens=cameras.lenses[k],
                intrinsics=cameras.intrinsics[k],
                cam_from_world=cameras.cam_from_world[k],
                covariance=covariance,
                is_intrinsics_fixed=True,
                quality=CameraQuality(0, NONE, NONE, 0.3, 0.0),
            )
            for k in range(len(cameras))
        ),
        world=WorldFrame("room", "m", "truth", 0.0),
        quality=NetworkQuality(0, 0, 0, NONE, NONE, np.nan, np.nan, np.nan, np.nan, np.nan),
        warnings=(),
        provenance=Provenance("test", "", "room", "", 0, "truth", "{}"),
        lrfs=(lrf,),
    )
    return Calibration.of(result, name)


def ranges_mm(truth, tilt_rad=TILT_RAD):
    """Readings of a scan in the empty room."""
    rng = np.random.default_rng(6)
    return ScannedRoom.of(truth, rng=rng, steps=STEPS).readings_mm(tilt_rad, rng=rng)


def header(stamp_ns, *, sequence=0):
    return pb.Header(schema=1, node=NODE, boot=bytes(16), sequence=sequence, stamp_ns=stamp_ns, session="s")


def info(stamp_ns):
    return pb.LrfInfo(
        header=header(stamp_ns),
        lrf=LRF_NAME,
        front_step=STEPS.front_step,
        steps_per_turn=STEPS.steps_per_turn,
        first_step=STEPS.first_step,
        last_step=STEPS.last_step,
        range_min_m=STEPS.range_min_m,
        range_max_m=STEPS.range_max_m,
        turn_s=STEPS.turn_s,
    )


def tilt(stamp_ns, tilt_rad=TILT_RAD, setting=0):
    return pb.TiltSample(
        header=header(stamp_ns), lrf=LRF_NAME, setting=setting, tilt_rad=tilt_rad, steps=100, has_steps=True
    )


def moving(stamp_ns):
    return pb.NodeEvent(header=header(stamp_ns), text="moving")


def scan(stamp_ns, readings_mm, number=0):
    return pb.LrfScan(
        header=header(stamp_ns, sequence=number), lrf=LRF_NAME, scan=number, stamp_ns=stamp_ns, readings_mm=readings_mm
    )
