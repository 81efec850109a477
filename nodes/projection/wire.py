"""Questions as bytes; `spotcal.proto` says what these are. The way back: `wire_requests.py`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from network_calib.observations import FloatArray
from nodes.bus import spotcal_pb2 as pb
from nodes.projection.points import Beams, CovarianceOf, LrfPoints, WorldPoints
from nodes.projection.requests import (
    Asked,
    BearingsAsked,
    CameraPixels,
    FloorAsked,
    LocateAsked,
    ProjectAsked,
    RaysAsked,
    TriangulateAsked,
)

F64 = np.dtype("<f8")


def encode(asked: Asked) -> bytes:
    """A question, ready to be sent."""
    match asked:
        case ProjectAsked():
            message = _project(asked)
        case BearingsAsked():
            message = _bearings(asked)
        case _:
            message = _locate(asked)
    return message.SerializeToString()


def packed(values: npt.ArrayLike) -> bytes:
    """Numbers as a column of the bus."""
    return np.asarray(values, dtype=F64).tobytes()


def _project(asked: ProjectAsked) -> pb.ProjectRequest:
    message = pb.ProjectRequest(calibration_id=asked.calibration_id, cameras=asked.cameras or ())
    points = asked.points
    match points:
        case Beams():
            message.beams.lrf = points.lrf
            message.beams.range_m = packed(points.range_m)
            message.beams.bearing_rad = packed(points.bearing_rad)
            _put_tilt(message.beams, points)
        case LrfPoints():
            message.lrf_points.lrf = points.lrf
            message.lrf_points.xyz_m = packed(points.xyz_m)
            _put_tilt(message.lrf_points, points)
        case WorldPoints():
            message.world_points.xyz_m = packed(points.xyz_m)
    if asked.covariance is not None:
        message.covariance.CopyFrom(_covariance(asked.covariance))
    return message


def _put_tilt(message: pb.Beams | pb.LrfPoints, points: Beams | LrfPoints) -> None:
    message.tilt_rad = _packed_tilt(points.tilt_rad)
    if points.stamp_ns is not None:
        message.stamp_ns = points.stamp_ns


def _packed_tilt(tilt_rad: float | FloatArray | None) -> bytes:
    return b"" if tilt_rad is None else packed(tilt_rad)


def _covariance(wanted: CovarianceOf) -> pb.CovarianceOf:
    noise = wanted.noise
    return pb.CovarianceOf(
        is_calibration_exact=not wanted.calibration,
        is_measurement_exact=noise is None,
        noise=None
        if noise is None
        else pb.LrfNoise(
            range_floor_m=noise.range_floor_m,
            range_per_m=noise.range_per_m,
            bearing_rad=noise.bearing_rad,
            tilt_rad=noise.tilt_rad,
        ),
        point_sigma_m=wanted.point_sigma_m,
    )


def _bearings(asked: BearingsAsked) -> pb.BearingsRequest:
    message = pb.BearingsRequest(
        calibration_id=asked.calibration_id,
        lrf=asked.lrf,
        tilt_rad=_packed_tilt(asked.tilt_rad),
        stamp_ns=asked.stamp_ns,
    )
    match asked.points:
        case CameraPixels(camera, px):
            message.pixels.CopyFrom(pb.Pixels(camera=camera, px=packed(px)))
        case points:
            message.xyz_m = packed(points)
    return message


def _locate(asked: LocateAsked) -> pb.LocateRequest:
    message = pb.LocateRequest(calibration_id=asked.calibration_id)
    match asked:
        case RaysAsked():
            message.rays.CopyFrom(pb.Pixels(camera=asked.camera, px=packed(asked.px)))
        case FloorAsked():
            message.floor.pixels.CopyFrom(pb.Pixels(camera=asked.camera, px=packed(asked.px)))
            message.floor.sigma_px = asked.sigma_px
            if asked.plane is not None:
                (x, y, z), offset = asked.plane
                message.floor.plane.CopyFrom(pb.Plane(normal_x=x, normal_y=y, normal_z=z, offset=offset))
        case TriangulateAsked():
            message.triangulated.sigma_px = asked.sigma_px
            for camera, px in asked.pixels.items():
                message.triangulated.pixels.add(camera=camera, px=packed(px))
    return message
