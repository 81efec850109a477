"""The scanner that a result file describes."""

from __future__ import annotations

from lrf_stereo.scanner import TiltingScanner
from network_calib.result import CalibratedLrf


def scanner_of(lrf: CalibratedLrf) -> TiltingScanner:
    """The scanner of a calibrated LRF, in the result's world."""
    tilt_gain, range_bias_m, range_scale, bearing_zero_rad, clock_offset_s = lrf.instrument.tolist()
    return TiltingScanner(
        world_from_lrf=lrf.world_from_lrf,
        axis_direction_in_world=lrf.axis_direction_in_world,
        axis_point_in_world=lrf.axis_point_in_world,
        reference_tilt_rad=lrf.reference_tilt_rad,
        tilt_gain=tilt_gain,
        range_bias_m=range_bias_m,
        range_scale=range_scale,
        bearing_zero_rad=bearing_zero_rad,
        clock_offset_s=clock_offset_s,
    )
