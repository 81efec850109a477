"""A projected scan as Foxglove image annotations: a common viewer draws it over the camera's image, live."""

from __future__ import annotations

import colorsys

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from google.protobuf.timestamp_pb2 import Timestamp

from network_calib.observations import BoolArray, FloatArray

# The viewer counts pixels from the corner of the top-left one, we from its centre; see nodes/recording/foxglove.py.
CORNER_FROM_CENTRE_PX = 0.5
POINT_PX = 4.0
S_NS = 10**9
N_COLOURS = 64
# Near is red, far is blue, by the turn of hue between them; as in the legend of `spotcal project`.
NEAR_HUE, FAR_HUE = 0.0, 0.66
PALETTE = tuple(
    Color(r=r, g=g, b=b, a=1.0)
    for r, g, b in (
        colorsys.hsv_to_rgb(NEAR_HUE + (FAR_HUE - NEAR_HUE) * k / (N_COLOURS - 1), 1.0, 1.0) for k in range(N_COLOURS)
    )
)


def scan_annotations(
    stamp_ns: int, px: FloatArray, range_m: FloatArray, is_valid: BoolArray, *, longest_m: float
) -> ImageAnnotations:
    """The valid beams as points coloured by their range; none take the former ones away.

    Args:
        stamp_ns: of the scan, on the cameras' clock.
        px: (n, 2).
        range_m: (n,).
        is_valid: (n,).
        longest_m: the range with the last colour.
    """
    seconds, nanos = divmod(stamp_ns, S_NS)
    stamp = Timestamp(seconds=seconds, nanos=nanos)
    if not is_valid.any():
        return ImageAnnotations(timestamp=stamp)
    corners = (px[is_valid] + CORNER_FROM_CENTRE_PX).tolist()
    colour = np.clip(range_m[is_valid] / longest_m * (N_COLOURS - 1), 0, N_COLOURS - 1).astype(int).tolist()
    points = PointsAnnotation(
        timestamp=stamp,
        type=PointsAnnotation.POINTS,
        points=[Point2(x=x, y=y) for x, y in corners],
        outline_colors=[PALETTE[k] for k in colour],
        thickness=POINT_PX,
    )
    return ImageAnnotations(timestamp=stamp, points=[points])
