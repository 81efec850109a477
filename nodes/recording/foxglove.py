"""Messages in the Foxglove schemas, made from a recording's own: common viewers show them as they are.

Schemas: docs.foxglove.dev/docs/sdk/schemas. Frames: `world` is the calibration's world frame; below it stand
`camera/<name>` (x right, y down, z forward) and `lrf/<name>` (x forward, y left, z up), as in docs/conventions.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from scipy.spatial.transform import RigidTransform

from lrf_stereo.scanner import ScanSteps, TiltingScanner
from network_calib.result import CalibratedCamera, CalibratedLrf, Calibration
from nodes.bus import spotcal_pb2 as pb
from nodes.recording.layout import DERIVED

WORLD = "world"
TRANSFORMS = f"{DERIVED}tf"
# "These coordinates use the top-left corner of the top-left pixel of the image as the origin"
# (docs.foxglove.dev/docs/sdk/schemas/points-annotation); ours, as OpenCV's, the centre of that pixel. The camera matrix
# of foxglove.CameraCalibration is OpenCV's own and stays as it is.
CORNER_FROM_CENTRE_PX = 0.5
BEST, OTHER = Color(r=0.3, g=1.0, b=0.3, a=1.0), Color(r=1.0, g=0.6, b=0.2, a=1.0)
POINT_PX = 6.0
S_NS = 10**9


def spots_topic(camera: str) -> str:
    """Where annotations of a camera go."""
    return f"{DERIVED}camera/{camera}/spots"


def calibration_topic(camera: str) -> str:
    """Where the calibration of a camera goes."""
    return f"{DERIVED}camera/{camera}/calibration"


def scan_topic(lrf: str) -> str:
    """Where the scans of an LRF go."""
    return f"{DERIVED}lrf/{lrf}/scan"


def spot_annotations(stamp_ns: int, px: Sequence[tuple[float, float]]) -> ImageAnnotations:
    """The candidates of one frame, best first; the best is green. Without any it takes the former ones away."""
    if not px:
        return ImageAnnotations(timestamp=_timestamp(stamp_ns))
    points = PointsAnnotation(
        timestamp=_timestamp(stamp_ns),
        type=PointsAnnotation.POINTS,
        points=[Point2(x=x + CORNER_FROM_CENTRE_PX, y=y + CORNER_FROM_CENTRE_PX) for x, y in px],
        outline_colors=[BEST, *[OTHER] * (len(px) - 1)],
        thickness=POINT_PX,
    )
    return ImageAnnotations(timestamp=_timestamp(stamp_ns), points=[points])


def laser_scan(scan: pb.LrfScan, info: pb.LrfInfo) -> LaserScan | None:
    """A scan in its own plane; NaN where the scanner measured nothing. None: not the beams that `info` speaks of."""
    steps = ScanSteps(
        info.front_step,
        info.steps_per_turn,
        info.first_step,
        info.last_step,
        info.range_min_m,
        info.range_max_m,
        info.turn_s,
    )
    readings_mm = np.array(scan.readings_mm)
    if len(readings_mm) != steps.n_measured:
        return None
    first_rad, last_rad = steps.bearing_rad([steps.first_step, steps.last_step])
    return LaserScan(
        timestamp=_timestamp(scan.stamp_ns),
        frame_id=f"lrf/{scan.lrf}",
        pose=Pose(position=Vector3(), orientation=Quaternion(w=1.0)),
        start_angle=first_rad,
        end_angle=last_rad,
        ranges=np.where(steps.is_range(readings_mm), 1e-3 * readings_mm, np.nan),
        intensities=scan.intensity,
    )


def camera_calibration(camera: CalibratedCamera, stamp_ns: int) -> CameraCalibration:
    """Intrinsics: `plumb_bob` with k3 = 0, or `kannala_brandt`, which is OpenCV's fisheye."""
    fx, fy, cx, cy, *distortion = np.asarray(camera.intrinsics).tolist()
    is_fisheye = camera.lens.is_fisheye
    return CameraCalibration(
        timestamp=_timestamp(stamp_ns),
        frame_id=f"camera/{camera.name}",
        width=camera.size_px[0],
        height=camera.size_px[1],
        distortion_model="kannala_brandt" if is_fisheye else "plumb_bob",
        D=distortion if is_fisheye else [*distortion, 0.0],
        K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
    )


def all_transforms(calibration: Calibration, stamp_ns: int) -> FrameTransforms:
    """Cameras, and LRFs at their reference tilts, in the world."""
    cameras = [(f"camera/{one.name}", one.cam_from_world.inv()) for one in calibration.cameras]
    lrfs = [(f"lrf/{one.name}", one.world_from_lrf) for one in calibration.lrfs]
    return _transforms((*cameras, *lrfs), stamp_ns)


def tilted_transform(lrf: CalibratedLrf, sample: pb.TiltSample, stamp_ns: int) -> FrameTransforms:
    """An LRF at a tilt: at the solved angle of that setting where there is one, else at what the tilt unit says."""
    scanner = TiltingScanner(
        lrf.world_from_lrf,
        lrf.axis_direction_in_world,
        lrf.axis_point_in_world,
        lrf.reference_tilt_rad,
        float(lrf.instrument[0]),
    )
    is_solved = sample.setting < len(lrf.tilt_rad)
    tilt_rad = float(lrf.tilt_rad[sample.setting]) if is_solved else sample.tilt_rad
    return _transforms([(f"lrf/{lrf.name}", scanner.world_from_lrf_at(tilt_rad))], stamp_ns)


def _transforms(world_from: Iterable[tuple[str, RigidTransform]], stamp_ns: int) -> FrameTransforms:
    return FrameTransforms(transforms=[_transform(child, pose, stamp_ns) for child, pose in world_from])


def _transform(child: str, world_from_child: RigidTransform, stamp_ns: int) -> FrameTransform:
    x, y, z = world_from_child.translation.tolist()
    qx, qy, qz, qw = world_from_child.rotation.as_quat().tolist()
    return FrameTransform(
        timestamp=_timestamp(stamp_ns),
        parent_frame_id=WORLD,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )


def _timestamp(stamp_ns: int) -> Timestamp:
    seconds, nanos = divmod(stamp_ns, S_NS)
    return Timestamp(seconds=seconds, nanos=nanos)
