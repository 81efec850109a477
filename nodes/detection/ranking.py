"""Which candidate of a frame is the spot most likely: by itself, beside the others, and by what was there before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nodes.detection.candidates import HEIGHT_POWER, SNR_POWER, Candidate
from nodes.detection.dwelling import Dwelling

# Where there is something all the time, a spot may have been put down: it stays a candidate, but all that moves goes
# before it. Shares of the time.
DWELLING_FROM, DWELLING_TO = 0.06, 0.3
DWELLING_FACTOR = 0.4


def ranked(found: Sequence[Candidate], dwelling: Dwelling) -> list[tuple[float, Candidate]]:
    """Score 0..1 and candidate, best first.

    A reflection of the spot, the edge of a sleeve and the picture on a screen may be compact too, but the spot is
    brighter, and stands out more of what its place is known to do: the others lose by how far they are behind.
    """
    if not found:
        return []
    own = [one.score * _freshness(dwelling.share(one.px)) for one in found]
    standing = [one.standing * score / one.score for score, one in zip(own, found, strict=True)]
    leader = found[standing.index(max(standing))]
    scores = [score * _behind(one, leader) for score, one in zip(own, found, strict=True)]
    return [(scores[k], found[k]) for k in np.argsort(-np.array(scores), kind="stable")]


def _behind(one: Candidate, leader: Candidate) -> float:
    height, snr = min(one.height / leader.height, 1.0), min(one.snr / leader.snr, 1.0)
    return height**HEIGHT_POWER * snr**SNR_POWER


def _freshness(share: float) -> float:
    settled = min(max((share - DWELLING_FROM) / (DWELLING_TO - DWELLING_FROM), 0.0), 1.0)
    return 1.0 - settled * (1.0 - DWELLING_FACTOR)
