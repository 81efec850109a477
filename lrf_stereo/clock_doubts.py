"""What a person should know of a scan's clock: an offset was asked for, and the spot's motion does not tell it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.refine import LrfCovariance, LrfRefined
from lrf_stereo.scanner_part import SCANNER_TANGENT
from lrf_stereo.sighting_block import spot_motion
from network_calib.observations import BoolArray, FloatArray
from network_calib.result import Doubt

CLOCK_OFFSET = SCANNER_TANGENT.index("clock_offset_s")
# Data that leave more than this share of the prior's sigma say less than the prior does.
MAX_SHARE = float(np.sqrt(0.5))


def clock_doubts(spread: LrfCovariance, refined: LrfRefined, network: NetworkData, data: LrfData) -> Iterator[Doubt]:
    """Doubts about the clock offsets; messages about one scanner begin with its number.

    Args:
        spread: covariance at the optimum.
        refined: the optimum.
        network: the camera side that it started from.
        data: the LRF side.
    """
    motion = spot_motion(network, data, refined.scanners)
    for scanner, instrument in enumerate(data.instrument):
        prior_s = instrument.clock_offset_s
        own = refined.is_inlier & (data.scanner == scanner)
        sigma_s = float(np.sqrt(spread.scanners[scanner, CLOCK_OFFSET, CLOCK_OFFSET]))
        if sigma_s > MAX_SHARE * prior_s:
            yield Doubt(
                "clock offset",
                f"LRF {scanner}: {_why(motion.is_known[own], motion.spread_m_s[own])}, so its sightings do not tell "
                f"the offset of its clock: ± {1e3 * sigma_s:.2g} ms, and ± {1e3 * prior_s:.2g} ms was given",
                "Move the spot at 0.3 m/s or more through the scan plane, up and down and to both sides, in view of "
                "two cameras whose frames have stamps.",
            )
        elif data.spots.delay_s[own].any() and not motion.is_known[own].any():
            delay_ms = 1e3 * float(np.abs(data.spots.delay_s[own]).max())
            yield Doubt(
                "clock offset",
                f"LRF {scanner}: its beams are up to {delay_ms:.2g} ms off the frames, and no frames just before "
                "and after tell how the spot moves; its sightings count for less",
                "Give the frames' stamps, and record the spot on its whole way.",
            )


def _why(is_known: BoolArray, spread_m_s: FloatArray) -> str:
    n_known = int(is_known.sum())
    if 2 * n_known < len(is_known):
        return f"{n_known} of {len(is_known)} sightings have located spots within 0.15 s before and after"
    return f"the spot moves too slowly or always the same way (± {spread_m_s.mean():.2g} m/s on each axis)"
