"""Do the ranges agree with the metres of the cameras? One more solve in which all range scales are as good as free.

A wrong baseline bends the LRF's pose and a few residuals; what the ranges alone say of the scale is the sharper
question. Without an anchor the ranges are the scale, and there is nothing to ask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrf_stereo.held_cameras import CameraSpread
from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.loose_solve import solve_loosely
from lrf_stereo.lrf_block import SCANNERS
from lrf_stereo.refine import LrfRefined
from lrf_stereo.scanner_part import ScannerPart
from network_calib.camera_block import cameras_of
from network_calib.observations import FloatArray
from network_calib.result import LRF_PARAMETER_NAMES

# As good as free, and still determined where the spots say nothing.
LOOSE = 0.3
RANGE_SCALE = LRF_PARAMETER_NAMES.index("range_scale")


@dataclass(frozen=True, slots=True)
class ScaleCheck:
    """Ranges of one LRF over the metres of the cameras.

    Attributes:
        ratio: above one where the ranges are too long.
        sigma: of the ratio: of the sightings, of the cameras' metres, and what the range scale was given.
    """

    ratio: float
    sigma: float

    def is_surprising(self, sigma: float) -> bool:
        """Whether the ratio is more than `sigma` of its own away from one."""
        return abs(self.ratio - 1) > sigma * self.sigma


def check_scales(
    refined: LrfRefined, network: NetworkData, data: LrfData, *, held: CameraSpread | None
) -> tuple[ScaleCheck, ...]:
    """Compare each LRF's ranges with the metres of the cameras.

    Args:
        refined: the optimum.
        network: the camera side.
        data: the LRF side.
        held: what held cameras may be wrong by; None where they are exact, or solved along.

    Returns:
        One check for each scanner; none at all where no anchor tells metres, or the spots do not determine the scale.
    """
    if not network.is_held and network.baseline is None:
        return ()
    loose = replace(data, instrument=tuple(replace(sigma, range_scale=LOOSE) for sigma in data.instrument))
    solved = solve_loosely(refined, network, loose, held)
    if solved is None:
        return ()
    state, spread = solved
    part = state.parts[SCANNERS]
    assert isinstance(part, ScannerPart)
    columns = part.columns[:, RANGE_SCALE] + cameras_of(state.parts).size
    variance = spread[columns, columns] + np.array([sigma.range_scale for sigma in data.instrument]) ** 2
    return tuple(
        ScaleCheck(float(scale), float(sigma))
        for scale, sigma in zip(_range_scales(part), np.sqrt(variance), strict=True)
    )


def _range_scales(part: ScannerPart) -> FloatArray:
    return part.instrument[:, RANGE_SCALE - LRF_PARAMETER_NAMES.index("tilt_gain")]
