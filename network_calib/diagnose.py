"""Why a network does not come together: a camera that lags by whole frames, or one whose image is mirrored.

Called only when the calibration has failed, to turn "does not agree" into words that a person can act on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from network_calib.errors import SpotcalError
from network_calib.observations import FloatArray, IntArray, Observations
from network_calib.pairs import PairGraph
from network_calib.room_setup import CameraSetup, Knowledge

MAX_SHIFT_FRAMES = 50
MAX_MATCHES = 400
MIN_MATCHES = 50
# Fewer shared spots than this are a short piece of way, which fits any epipolar geometry.
MIN_SHARED, MAX_PARTNERS = 200, 3
TOLERANCE_PX = 2.0
# A right shift makes most matches agree (half of them, where each view has 30 % false detections); a wrong one only
# those that lie near their epipolar line by chance.
MIN_SHARE, MIN_GAIN = 0.5, 1.5
# Half of a mirrored network can be fitted with errors of some px; the right one fits to a detector's noise.
MAX_HONEST_NOISE_PX = 2.0


def late_cameras(observations: Observations, graph: PairGraph) -> tuple[str, ...]:
    """Sentences about cameras that agree with their partners once their frame numbers are shifted."""
    main = set(graph.islands()[0])
    suspects = [c for c in range(observations.n_cameras) if c not in main]
    suspects += [d.camera for d in graph.disagreeing_cameras() if d.camera in main]
    sentences = []
    for c in suspects:
        partners = [p for p in main - {c} if graph.shared[c, p] >= MIN_SHARED]
        partners = sorted(partners, key=lambda p: (-graph.shared[c, p], p))[:MAX_PARTNERS]
        tried = [(*best_shift(observations, c, p), p) for p in partners]
        told = [t for t in tried if t[0] != 0 and t[1] > max(MIN_SHARE, MIN_GAIN * t[2])]
        if not told:
            continue
        shift, share, share_unshifted, partner = max(told, key=lambda t: t[1])
        if 2 * sum(t[0] == shift for t in told) > len(tried):
            word = "high" if shift > 0 else "low"
            sentences.append(
                f"the frame numbers of {graph.names[c]} are {abs(shift)} too {word}: corrected, {100 * share:.0f} % of "
                f"its spots agree with {graph.names[partner]}, as they are {100 * share_unshifted:.0f} %"
            )
    return tuple(sentences)


def best_shift(observations: Observations, camera: int, partner: int) -> tuple[int, float, float]:
    """By how much a camera's frame numbers are too high against its partner's, by epipolar agreement.

    Returns:
        The shift, its share of agreeing matches, and the share without a shift.
    """
    own, other = (observations.select(observations.camera == c) for c in (camera, partner))
    share = {
        shift: _agreeing_share(own.frame - shift, own.px, other.frame, other.px)
        for shift in range(-MAX_SHIFT_FRAMES, MAX_SHIFT_FRAMES + 1)
    }
    best = max(share, key=lambda shift: (share[shift], -abs(shift)))
    return best, share[best], share[0]


def _agreeing_share(frame_a: IntArray, px_a: FloatArray, frame_b: IntArray, px_b: FloatArray) -> float:
    _, at_a, at_b = np.intersect1d(frame_a, frame_b, assume_unique=True, return_indices=True)
    if len(at_a) < MIN_MATCHES:
        return 0.0
    chosen = np.linspace(0, len(at_a) - 1, min(MAX_MATCHES, len(at_a))).astype(np.int64)
    cv2.setRNGSeed(0)
    matrix, is_inlier = cv2.findFundamentalMat(
        px_a[at_a[chosen]], px_b[at_b[chosen]], cv2.USAC_FAST, TOLERANCE_PX, 0.99, 200
    )
    return 0.0 if matrix is None or is_inlier is None else float(is_inlier.mean())


def mirrored_camera(
    setups: Sequence[CameraSetup],
    observations: Observations,
    attempt: Callable[[Sequence[CameraSetup], Observations], float],
) -> str | None:
    """The name of the one camera whose mirrored image makes the network calibrate; None if there is no such camera.

    Epipolar geometry holds in a mirror, so nothing else tells: the camera's spots come to lie behind it.

    Args:
        setups: what is known of each camera.
        observations: as they are.
        attempt: calibrates and returns the largest noise of a camera in px, or raises a SpotcalError.
    """
    for c, setup in enumerate(setups):
        flipped_px = observations.px.copy()
        own = observations.camera == c
        flipped_px[own, 0] = setup.size_px[0] - 1 - flipped_px[own, 0]
        try:
            noise_px = attempt([*setups[:c], _flipped(setup), *setups[c + 1 :]], replace(observations, px=flipped_px))
        except SpotcalError:
            continue
        if noise_px < MAX_HONEST_NOISE_PX:
            return setup.name
    return None


def _flipped(setup: CameraSetup) -> CameraSetup:
    """Given intrinsics of a mirrored image; the nominal camera is symmetric."""
    if setup.intrinsics is None or setup.knowledge is Knowledge.UNKNOWN:
        return setup
    intrinsics = np.asarray(setup.intrinsics, dtype=np.float64).copy()
    intrinsics[2] = setup.size_px[0] - 1 - intrinsics[2]
    return replace(setup, intrinsics=intrinsics)
