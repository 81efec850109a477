"""Bytes that somebody sent as questions again, or the refusal that they deserve."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from google.protobuf.message import DecodeError, Message

from lrf_stereo.noise import LrfNoise
from network_calib.observations import FloatArray
from nodes.bus import spotcal_pb2 as pb
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.points import Beams, CovarianceOf, LrfPoints, Points, WorldPoints
from nodes.projection.requests import (
    BearingsAsked,
    CameraPixels,
    FloorAsked,
    LocateAsked,
    ProjectAsked,
    RaysAsked,
    TriangulateAsked,
)
from nodes.projection.wire import F64

M = TypeVar("M", bound=Message)
MAX_REQUEST_BYTES = 4 * 2**20
MAX_CAMERAS = 4096
MAX_SIGMA = 1e6


def project_asked(payload: bytes) -> ProjectAsked:
    """Of a payload.

    Raises:
        ProjectionError: TOO_LARGE or BAD_REQUEST.
    """
    message = _parsed(pb.ProjectRequest, payload)
    cameras = tuple(message.cameras)
    if len(cameras) > MAX_CAMERAS:
        raise too_large(f"{len(cameras)} cameras", f"{MAX_CAMERAS} at most")
    return ProjectAsked(
        _points(message),
        cameras or None,
        _covariance_of(message.covariance) if message.HasField("covariance") else None,
        message.calibration_id,
    )


def _points(message: pb.ProjectRequest) -> Points:
    match message.WhichOneof("points"):
        case "beams":
            told = message.beams
            range_m, bearing_rad = unpacked(told.range_m, "range_m"), unpacked(told.bearing_rad, "bearing_rad")
            return Beams(told.lrf, range_m, bearing_rad, *_tilt_of(told))
        case "lrf_points":
            told = message.lrf_points
            return LrfPoints(told.lrf, unpacked(told.xyz_m, "xyz_m", 3), *_tilt_of(told))
        case "world_points":
            return WorldPoints(unpacked(message.world_points.xyz_m, "xyz_m", 3))
    raise bad("the request holds no points", "set one of beams, lrf_points, world_points")


def _tilt_of(told: pb.Beams | pb.LrfPoints | pb.BearingsRequest) -> tuple[float | FloatArray | None, int | None]:
    stamp_ns = told.stamp_ns if told.HasField("stamp_ns") else None
    if not told.tilt_rad:
        return None, stamp_ns
    tilt_rad = unpacked(told.tilt_rad, "tilt_rad")
    return (float(tilt_rad[0]) if len(tilt_rad) == 1 else tilt_rad), stamp_ns


def _covariance_of(told: pb.CovarianceOf) -> CovarianceOf:
    noise = None
    if not told.is_measurement_exact:
        given = told.noise
        noise = LrfNoise()
        if told.HasField("noise"):
            sigmas = (given.range_floor_m, given.range_per_m, given.bearing_rad, given.tilt_rad)
            noise = LrfNoise(*(_sigma(sigma, "noise") for sigma in sigmas))
    return CovarianceOf(not told.is_calibration_exact, noise, _sigma(told.point_sigma_m, "point_sigma_m"))


def _sigma(sigma: float, name: str) -> float:
    """A standard deviation whose square is a number."""
    if not 0 <= sigma <= MAX_SIGMA:
        raise bad(f"{name} holds {sigma:g}", f"a standard deviation is from 0 to {MAX_SIGMA:g}")
    return sigma


def locate_asked(payload: bytes) -> LocateAsked:
    """Of a payload.

    Raises:
        ProjectionError: TOO_LARGE or BAD_REQUEST.
    """
    message = _parsed(pb.LocateRequest, payload)
    match message.WhichOneof("pixels"):
        case "rays":
            return RaysAsked(message.rays.camera, unpacked(message.rays.px, "px", 2), message.calibration_id)
        case "floor":
            floor = message.floor
            px, told = unpacked(floor.pixels.px, "px", 2), floor.plane
            normal = np.array([told.normal_x, told.normal_y, told.normal_z])
            plane = (normal, told.offset) if floor.HasField("plane") else None
            return FloorAsked(
                floor.pixels.camera, px, _sigma(floor.sigma_px, "sigma_px"), plane, message.calibration_id
            )
        case "triangulated":
            seen = message.triangulated
            if len(seen.pixels) > MAX_CAMERAS:
                raise too_large(f"{len(seen.pixels)} cameras", f"{MAX_CAMERAS} at most")
            pixels = {one.camera: unpacked(one.px, "px", 2) for one in seen.pixels}
            if len(pixels) < len(seen.pixels):
                raise bad("a camera stands twice in the request", "give each camera's pixels once")
            return TriangulateAsked(pixels, _sigma(seen.sigma_px, "sigma_px"), message.calibration_id)
    raise bad("the request holds no pixels", "set one of rays, floor, triangulated")


def bearings_asked(payload: bytes) -> BearingsAsked:
    """Of a payload.

    Raises:
        ProjectionError: TOO_LARGE or BAD_REQUEST.
    """
    message = _parsed(pb.BearingsRequest, payload)
    tilt_rad, stamp_ns = _tilt_of(message)
    if isinstance(tilt_rad, np.ndarray):
        raise bad(f"{len(tilt_rad)} tilts", "expected one, or a stamp")
    match message.WhichOneof("points"):
        case "xyz_m":
            points = unpacked(message.xyz_m, "xyz_m", 3)
        case "pixels":
            points = CameraPixels(message.pixels.camera, unpacked(message.pixels.px, "px", 2))
        case _:
            raise bad("the request holds no points", "set one of xyz_m, pixels")
    return BearingsAsked(message.lrf, points, tilt_rad, stamp_ns, message.calibration_id)


def unpacked(column: bytes, name: str, width: int = 1) -> FloatArray:
    """(N,) or (N, width) numbers of a column, which is not copied.

    Raises:
        ProjectionError: BAD_REQUEST: a number of bytes that holds no such array.
    """
    if len(column) % (8 * width):
        raise bad(f"{name} holds {len(column)} bytes", f"expected a multiple of {8 * width}")
    numbers = np.frombuffer(column, dtype=F64)
    return numbers if width == 1 else numbers.reshape(-1, width)


def _parsed(message_type: type[M], payload: bytes) -> M:
    if len(payload) > MAX_REQUEST_BYTES:
        raise too_large(f"a request of {len(payload)} bytes", f"{MAX_REQUEST_BYTES} at most: ask in parts")
    message = message_type()
    try:
        message.ParseFromString(payload)
    except (DecodeError, ValueError):
        raise bad(f"no {message_type.__name__}", "see spotcal.proto") from None
    return message


def bad(message: str, detail: str) -> ProjectionError:
    """A request that is malformed."""
    return ProjectionError(ErrorCode.BAD_REQUEST, message, detail)


def too_large(message: str, detail: str) -> ProjectionError:
    """A request that asks for too much at a time."""
    return ProjectionError(ErrorCode.TOO_LARGE, message, detail)
