"""Residual block of the joint engine: a spot seen by a camera, and its analytic Jacobians.

Arrays are stored with the observation as the last axis, so that every operation runs over contiguous memory.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from network_calib.blocks import Parts
from network_calib.camera_parameters import N_PARAMETERS, CameraParameters
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.robust_loss import Loss, SquaredLoss

PART = "cameras"


@dataclass(frozen=True, slots=True)
class CameraBlock:
    """K detections: (predicted - detected pixel) / sigma.

    Attributes:
        group: (K,) camera index.
        point: (K,) spot index.
        px: (2, K) detected pixels.
        inverse_sigma: (K,) one over the standard deviation per axis.
        columns: (C, 14) global tangent columns of each camera.
        loss: robust loss.
    """

    group: IntArray
    point: IntArray
    px: FloatArray
    inverse_sigma: FloatArray
    columns: IntArray
    loss: Loss = field(default_factory=SquaredLoss)

    def take(self, rows: IntArray) -> CameraBlock:
        """The block with its rows reordered or thinned."""
        return replace(
            self,
            group=self.group[rows],
            point=self.point[rows],
            px=np.ascontiguousarray(self.px[:, rows]),
            inverse_sigma=self.inverse_sigma[rows],
        )

    def residual(self, parts: Parts, points: FloatArray, rows: slice) -> FloatArray:
        """(2, n) whitened residuals; NaN behind the camera."""
        cameras = cameras_of(parts)
        camera = self.group[rows]
        optics = cameras.optics.T[:, camera]
        u, v, _ = _normalise(cameras, camera, points)
        ud, vd = _distort(optics, cameras.is_fisheye[camera], u, v)
        out = np.empty((2, len(u)))
        out[0] = optics[0] * ud + optics[2] - self.px[0, rows]
        out[1] = optics[0] * optics[1] * vd + optics[3] - self.px[1, rows]
        out *= self.inverse_sigma[rows]
        return out

    def linearise(self, parts: Parts, points: FloatArray, rows: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (2, n), Jacobians (14, 2, n) by the camera's tangent and (3, 2, n) by the point."""
        cameras = cameras_of(parts)
        camera, weight = self.group[rows], self.inverse_sigma[rows]
        optics = cameras.optics.T[:, camera]
        is_fisheye = cameras.is_fisheye[camera]
        u, v, inverse_z = _normalise(cameras, camera, points)
        ud, vd = _distort(optics, is_fisheye, u, v)
        focal_x, focal_y = optics[0] * weight, optics[0] * optics[1] * weight
        residual = np.empty((2, len(u)))
        residual[0] = focal_x * ud + (optics[2] - self.px[0, rows]) * weight
        residual[1] = focal_y * vd + (optics[3] - self.px[1, rows]) * weight

        by_camera = np.zeros((N_PARAMETERS, 2, len(u)))
        a00, a01, a11 = _distortion_slope(optics, is_fisheye, u, v)
        by_point_in_cam = np.empty((3, 2, len(u)))  # times z, by (x, y, z) in the camera frame
        np.multiply(focal_x, a00, out=by_point_in_cam[0, 0])
        np.multiply(focal_x, a01, out=by_point_in_cam[1, 0])
        np.multiply(focal_y, a01, out=by_point_in_cam[0, 1])
        np.multiply(focal_y, a11, out=by_point_in_cam[1, 1])
        j0, j1 = by_point_in_cam[0], by_point_in_cam[1]
        j2 = np.negative(j0 * u + j1 * v, out=by_point_in_cam[2])
        # x_in_cam moves by omega x x_in_cam; the depth cancels.
        by_camera[0] = j2 * v - j1
        by_camera[1] = j0 - j2 * u
        by_camera[2] = j1 * u - j0 * v
        by_point = np.empty_like(by_point_in_cam)
        rotation = cameras.rotations.transpose(1, 2, 0)[:, :, camera] * inverse_z
        for k in range(3):
            by_point[k] = j0 * rotation[0, k] + j1 * rotation[1, k] + j2 * rotation[2, k]
        np.negative(by_point, out=by_camera[3:6])
        by_camera[6, 0] = ud * weight
        by_camera[6, 1] = optics[1] * vd * weight
        by_camera[7, 1] = optics[0] * vd * weight
        by_camera[8, 0] = weight
        by_camera[9, 1] = weight
        _by_distortion(by_camera[10:], is_fisheye, u, v, focal_x, focal_y)
        return residual, by_camera, by_point


def cameras_of(parts: Parts) -> CameraParameters:
    """The camera part of the shared parameters."""
    cameras = parts[PART]
    assert isinstance(cameras, CameraParameters)
    return cameras


def _normalise(
    cameras: CameraParameters, camera: IntArray, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x/z, y/z and 1/z in the camera frame; NaN where z <= 0."""
    rotation = cameras.rotations.transpose(1, 2, 0)[:, :, camera]
    d0, d1, d2 = points - cameras.centres.T[:, camera]
    x = rotation[0, 0] * d0 + rotation[0, 1] * d1 + rotation[0, 2] * d2
    y = rotation[1, 0] * d0 + rotation[1, 1] * d1 + rotation[1, 2] * d2
    z = rotation[2, 0] * d0 + rotation[2, 1] * d1 + rotation[2, 2] * d2
    inverse_z = 1.0 / np.where(z > 0, z, np.nan)
    return x * inverse_z, y * inverse_z, inverse_z


def _distort(optics: FloatArray, is_fisheye: BoolArray, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    k1, k2, p1, p2 = optics[4:]
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * k2)
    cross = 2 * u * v
    ud = u * radial + p1 * cross + p2 * (r2 + 2 * u * u)
    vd = v * radial + p1 * (r2 + 2 * v * v) + p2 * cross
    if is_fisheye.any():
        scale, _ = _fisheye_scale(optics, r2)
        ud, vd = np.where(is_fisheye, u * scale, ud), np.where(is_fisheye, v * scale, vd)
    return ud, vd


def _fisheye_scale(optics: FloatArray, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """theta_d / r, and its derivative by r2; series near the axis, where both are 0/0."""
    d0, d1, d2, d3 = optics[4:]
    is_near = r2 < 1e-6
    safe = np.where(is_near, 1.0, r2)
    r = np.sqrt(safe)
    theta = np.arctan(r)
    t2 = theta * theta
    theta_d = theta * (1 + t2 * (d0 + t2 * (d1 + t2 * (d2 + t2 * d3))))
    slope = 1 + t2 * (3 * d0 + t2 * (5 * d1 + t2 * (7 * d2 + t2 * 9 * d3)))
    scale = theta_d / r
    # d(theta_d / r)/d(r2) = (theta_d' / (1 + r2) - theta_d / r) / (2 r2)
    by_r2 = (slope / (1 + safe) - scale) / (2 * safe)
    # theta_d / r = 1 + (d0 - 1/3) r2 + O(r2^2)
    return np.where(is_near, 1 + (d0 - 1 / 3) * r2, scale), np.where(is_near, d0 - 1 / 3, by_r2)


def _distortion_slope(
    optics: FloatArray, is_fisheye: BoolArray, u: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Entries 00, 01 (= 10), 11 of the derivative of the distorted by the undistorted coordinates."""
    k1, k2, p1, p2 = optics[4:]
    r2 = u * u + v * v
    radial, slope = 1 + r2 * (k1 + r2 * k2), 2 * k1 + 4 * k2 * r2
    a00 = radial + slope * u * u + 2 * p1 * v + 6 * p2 * u
    a11 = radial + slope * v * v + 6 * p1 * v + 2 * p2 * u
    a01 = slope * u * v + 2 * (p1 * u + p2 * v)
    if is_fisheye.any():
        scale, by_r2 = _fisheye_scale(optics, r2)
        a00 = np.where(is_fisheye, scale + 2 * by_r2 * u * u, a00)
        a11 = np.where(is_fisheye, scale + 2 * by_r2 * v * v, a11)
        a01 = np.where(is_fisheye, 2 * by_r2 * u * v, a01)
    return a00, a01, a11


def _by_distortion(
    out: FloatArray, is_fisheye: BoolArray, u: FloatArray, v: FloatArray, focal_x: FloatArray, focal_y: FloatArray
) -> None:
    """Fill (4, 2, n): derivative of the pixel by d0..d3."""
    r2 = u * u + v * v
    fu, fv = focal_x * u, focal_y * v
    out[0, 0], out[0, 1] = fu * r2, fv * r2
    out[1, 0], out[1, 1] = out[0, 0] * r2, out[0, 1] * r2
    out[2, 0], out[2, 1] = 2 * fu * v, focal_y * (r2 + 2 * v * v)
    out[3, 0], out[3, 1] = focal_x * (r2 + 2 * u * u), 2 * fv * u
    if is_fisheye.any():
        r = np.sqrt(np.maximum(r2, 1e-300))
        theta = np.arctan(r)
        power = theta / r * theta * theta
        for k in range(4):
            out[k, 0] = np.where(is_fisheye, fu * power, out[k, 0])
            out[k, 1] = np.where(is_fisheye, fv * power, out[k, 1])
            power = power * theta * theta
