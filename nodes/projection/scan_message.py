"""A projected scan as it travels: columns of little-endian numbers, written and read in one place.

Rows go from the first to the last beam that the camera sees; what lies between them without being seen is not valid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from network_calib.observations import BoolArray, FloatArray, IntArray
from nodes.bus import spotcal_pb2 as pb
from nodes.bus.checks import MAX_BEAMS, MessageError

F8, F4 = np.dtype("<f8"), np.dtype("<f4")
Column = npt.NDArray[np.floating]


@dataclass(frozen=True, slots=True)
class ScanInCamera:
    """The beams of one scan in one camera.

    Attributes:
        lrf: name.
        camera: name.
        calibration_id: of the calibration that was used.
        scan: number of the LrfScan.
        stamp_ns: (n,) time of each beam on the cameras' clock.
        step: (n,) bearing step.
        px: (n, 2) NaN behind the camera or without a range.
        range_m: (n,) as measured; NaN without a range.
        sigma_px: (n,) along the long axis of the error ellipse; NaN where not valid.
        is_valid: (n,) within the image.
    """

    lrf: str
    camera: str
    calibration_id: str
    scan: int
    stamp_ns: IntArray
    step: IntArray
    px: FloatArray
    range_m: FloatArray
    sigma_px: FloatArray
    is_valid: BoolArray


def seen_rows(is_valid: BoolArray) -> tuple[IntArray, IntArray]:
    """First valid row, and the one after the last, of each camera (C, N); of one without any, all rows."""
    return is_valid.argmax(axis=1), is_valid.shape[1] - is_valid[:, ::-1].argmax(axis=1)


def fill_columns(
    message: pb.Projection, px: FloatArray, range_m: Column, sigma_px: Column, is_valid: BoolArray
) -> None:
    """Fill in what is different for each beam: (n, 2) and (n,). Arrays that have the type already are not copied."""
    message.n_beams = len(range_m)
    message.px = px.astype(F8, order="C", copy=False).tobytes()
    message.range_m = range_m.astype(F4, copy=False).tobytes()
    message.sigma_px = sigma_px.astype(F4, copy=False).tobytes()
    message.is_valid = is_valid.tobytes()


def read_scan(payload: bytes) -> ScanInCamera:
    """A projected scan as a subscriber receives it.

    Raises:
        MessageError: it is none.
    """
    try:
        message = pb.Projection.FromString(payload)
    except Exception as error:  # protobuf's DecodeError, which is no ValueError in every version
        raise MessageError("message: no protobuf of its type") from error
    n = message.n_beams
    columns = ((message.px, 16), (message.range_m, 4), (message.sigma_px, 4), (message.is_valid, 1))
    if n > MAX_BEAMS or any(len(column) != size * n for column, size in columns):
        raise MessageError("px, range_m, sigma_px, is_valid: wrong length")
    if not 0 <= message.step_s <= 1:
        raise MessageError("step_s: out of bounds")
    step = message.first_step + np.arange(n)
    return ScanInCamera(
        lrf=message.lrf,
        camera=message.camera,
        calibration_id=message.calibration_id,
        scan=message.scan,
        stamp_ns=message.stamp_ns + np.rint(1e9 * message.step_s * step).astype(np.int64),
        step=step,
        px=np.frombuffer(message.px, F8).reshape(n, 2),
        range_m=np.frombuffer(message.range_m, F4).astype(np.float64),
        sigma_px=np.frombuffer(message.sigma_px, F4).astype(np.float64),
        is_valid=np.frombuffer(message.is_valid, np.uint8) != 0,
    )
