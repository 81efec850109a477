"""What to change about the exposure, from the spots and the light of the last seconds."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nodes.detection.spots import Advice, AdviceKind, DetectorState, FloatArray, Spot

# Frames; some ten seconds.
WINDOW_FRAMES = 250
# So few frames with a spot say nothing about it.
MIN_SPOTS = 15
MIN_FRAMES = 50
# What looks less like the pointer's spot is no ground for advice.
MIN_SCORE = 0.25
SATURATED_SHARE = 0.3
# A spot that reaches this share of full scale is bright enough with room above.
GOOD_PEAK = 0.6
DIM_PEAK = 0.12
BLIND_SHARE = 0.1
# A smear longer than the spot is wide across (four standard deviations) is one that the eye sees.
SMEAR_OVER_WIDTH = 4.0
UNSTEADY_SHARE = 0.015
N_RELEARNINGS = 3
UNSEEN_FRAMES = 125


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """What one frame says about the exposure.

    Attributes:
        state: what the detector was doing.
        spot: the best one, if any.
        brightness: mean of the picture, as a share of full scale.
        blind_share: share 0..1 of the picture so bright that no spot can stand out of it.
        exposure_s: exposure time where it is known.
    """

    state: DetectorState
    spot: Spot | None
    brightness: float
    blind_share: float
    exposure_s: float | None = None


class ExposureWatch:
    """Remembers the last seconds and advises."""

    def __init__(self) -> None:
        self._facts: deque[FrameFacts] = deque(maxlen=WINDOW_FRAMES)

    def note(self, facts: FrameFacts) -> None:
        """Take the next frame into account."""
        self._facts.append(facts)

    def advice(self) -> tuple[Advice, ...]:
        """What may be better, the gravest first; empty when all is well or too little was seen."""
        facts = tuple(self._facts)
        spots = [one.spot for one in facts if one.spot is not None and one.spot.score >= MIN_SCORE]
        given = [_unseen(facts), _background(facts), _unsteady(facts)]
        if len(spots) >= MIN_SPOTS:
            given = [_saturated(spots), _too_dim(spots), *given, _smeared(spots, facts)]
        return tuple(one for one in given if one is not None)


def _saturated(spots: list[Spot]) -> Advice | None:
    share = sum(one.is_saturated for one in spots) / len(spots)
    if share < SATURATED_SHARE:
        return None
    # The fit sees past the full samples, but not far: more than a factor of ten at once is guesswork.
    peak = min(float(np.median([one.peak for one in spots if one.is_saturated])), 6.0)
    to = _part(GOOD_PEAK / max(peak, 1.0))
    return Advice(
        AdviceKind.SATURATED,
        f"the spot is saturated in {share:.0%} of the frames that show it: lower the exposure or the gain to {to}",
    )


def _too_dim(spots: list[Spot]) -> Advice | None:
    peak = float(np.median([one.peak for one in spots]))
    if peak >= DIM_PEAK or any(one.is_saturated for one in spots):
        return None
    return Advice(
        AdviceKind.TOO_DIM,
        f"the spot reaches only {peak:.0%} of full scale: raise the exposure or the gain about "
        f"{min(GOOD_PEAK / peak, 10.0):.0f} times, take a brighter spot or dim the light",
    )


def _smeared(spots: list[Spot], facts: tuple[FrameFacts, ...]) -> Advice | None:
    smear = float(np.median([one.smear_px for one in spots]))
    width = float(np.median([one.width_px for one in spots]))
    if smear <= SMEAR_OVER_WIDTH * width:
        return None
    to = _part(SMEAR_OVER_WIDTH * width / smear)
    exposures = [one.exposure_s for one in facts if one.exposure_s is not None]
    now = f" (now {1e3 * exposures[-1]:.3g} ms)" if exposures else ""
    return Advice(
        AdviceKind.SMEARED,
        f"the spot is smeared over {smear:.0f} px, {smear / width:.0f} times its width: shorten the exposure to "
        f"{to}{now}, or move it more slowly",
    )


def _background(facts: tuple[FrameFacts, ...]) -> Advice | None:
    watching = [one.blind_share for one in facts if one.state is DetectorState.WATCHING]
    if not watching or watching[-1] < BLIND_SHARE:
        return None
    return Advice(
        AdviceKind.BACKGROUND_TOO_BRIGHT,
        f"{watching[-1]:.0%} of the picture is so bright that no spot can stand out of it: lower the exposure to about "
        "a half, dim the light, or turn the camera away from lamps and windows",
    )


def _unsteady(facts: tuple[FrameFacts, ...]) -> Advice | None:
    n_relearnings = sum(
        later.state is DetectorState.RELEARNING and earlier.state is DetectorState.WATCHING
        for earlier, later in pairwise(facts)
    )
    if n_relearnings >= N_RELEARNINGS:
        return Advice(
            AdviceKind.UNSTEADY_LIGHT,
            f"the light changed {n_relearnings} times in {len(facts)} frames: switch off automatic exposure, and leave "
            "lamps and blinds as they are",
        )
    share = _flicker([one.brightness for one in facts])
    if len(facts) < MIN_FRAMES or share < UNSTEADY_SHARE:
        return None
    return Advice(
        AdviceKind.UNSTEADY_LIGHT,
        f"the picture flickers by {share:.1%} from frame to frame: set the exposure to a multiple of 10 ms "
        "where the mains have 50 Hz, of 8.33 ms where they have 60 Hz, or switch off automatic exposure",
    )


def _flicker(brightness: list[float]) -> float:
    """Median step from frame to frame, as a share of the brightness: a lamp switched on once is no flicker."""
    values: FloatArray = np.array(brightness)
    if len(values) < 2 or values.mean() <= 0:
        return 0.0
    return float(np.median(np.abs(np.diff(values))) / values.mean())


def _unseen(facts: tuple[FrameFacts, ...]) -> Advice | None:
    n_unseen = 0
    for one in reversed(facts):
        if one.spot is not None and one.spot.score >= MIN_SCORE:
            break
        n_unseen += one.state is DetectorState.WATCHING
    if n_unseen < UNSEEN_FRAMES:
        return None
    at_least = "at least the last" if n_unseen == len(facts) else "the last"
    return Advice(
        AdviceKind.NOTHING_SEEN,
        f"no spot in {at_least} {n_unseen} frames: is it switched on and in this camera's view? If so, raise the "
        "exposure, or dim the light",
    )


def _part(factor: float) -> str:
    """A factor below one in words."""
    n = max(round(1 / factor), 1)
    names = {1: "a little less", 2: "about a half", 3: "about a third", 4: "about a quarter", 5: "about a fifth"}
    return names.get(n, f"about 1/{math.ceil(n)} of it")
