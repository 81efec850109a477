"""What a person should know before trusting a calibration: each doubt with its numbers and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from network_calib.cameras import Cameras
from network_calib.observations import FloatArray
from network_calib.pairs import Overlap, PairGraph
from network_calib.priors import optics_of, prior_sigma
from network_calib.result import CameraQuality, ErrorSummary, Warning
from network_calib.room_setup import CameraSetup, Knowledge
from network_calib.sync import TimeOffsets

MIN_COVERAGE = 0.25
MIN_INLIER_SHARE = 0.8
MAX_RELATIVE_FOCAL_SIGMA = 0.01
MAX_NOISE_RATIO = 4.0
MAX_HOLDOUT_RATIO = 1.5
MAX_OFFSET_FRAMES = 0.1
OPTICS_WORDS = ("focal length", "aspect", "centre x", "centre y", "d0", "d1", "d2", "d3")


def about_cameras(
    setups: Sequence[CameraSetup], qualities: Sequence[CameraQuality], focal_px: FloatArray, focal_sigma_px: FloatArray
) -> Iterator[Warning]:
    """Thin coverage, many outliers, weak focal lengths, one camera much noisier than the rest."""
    typical_noise = float(np.median([quality.noise_sigma_px for quality in qualities]))
    for c, (setup, quality) in enumerate(zip(setups, qualities, strict=True)):
        name = setup.name
        if quality.coverage < MIN_COVERAGE:
            yield Warning(
                "coverage",
                f"{name}: spots cover {100 * quality.coverage:.0f} % of the image",
                "Distortion is a guess where no spot was seen: wave into this camera's corners.",
            )
        share = quality.fitted.n / max(quality.n_observations, 1)
        if share < MIN_INLIER_SHARE:
            yield Warning(
                "outliers",
                f"{name}: only {100 * share:.0f} % of {quality.n_observations} detections agree with the others",
                "Look for lamps, reflections or screens in its view.",
            )
        if focal_sigma_px[c] > MAX_RELATIVE_FOCAL_SIGMA * focal_px[c]:
            yield Warning(
                "focal",
                f"{name}: focal length {focal_px[c]:.0f} px is uncertain by {focal_sigma_px[c]:.0f} px",
                "Wave nearer to and farther from it, or give its intrinsics.",
            )
        if quality.noise_sigma_px > MAX_NOISE_RATIO * typical_noise:
            yield Warning(
                "noise",
                f"{name}: detection noise {quality.noise_sigma_px:.2f} px, the other cameras' is {typical_noise:.2f} px",
                "Check its focus, exposure and frame timing.",
            )


def about_geometry(graph: PairGraph, cameras: Cameras) -> Iterator[Warning]:
    """Weak ties and camera centres on one line."""
    best = [max((graph.inliers[c, d], d) for d in range(len(graph.names)) if d != c) for c in range(len(graph.names))]
    for c, (count, partner) in enumerate(best):
        grade = graph.grade(c, partner)
        if grade is not Overlap.GOOD:
            yield Warning(
                "overlap",
                f"{graph.names[c]}: its best tie, to {graph.names[partner]}, rests on {count} spots ({grade.value})",
                "Wave more where both see the spot: 200 make a good tie.",
            )
    centres = cameras.centres_in_world
    if len(centres) >= 3:
        extent = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
        if extent[1] < 0.01 * extent[0]:
            yield Warning(
                "colinear",
                "all camera centres lie on one line",
                "The network is weak against bending about it: add a camera off the line if accuracy matters there.",
            )


def about_holdout(fitted: ErrorSummary, holdout: ErrorSummary, agreeing_share: float) -> Iterator[Warning]:
    """Left-out segments that are predicted worse than the fitted ones."""
    if holdout.n and holdout.median_px > MAX_HOLDOUT_RATIO * fitted.median_px:
        yield Warning(
            "holdout",
            f"left-out segments show {holdout.median_px:.2f} px median error, fitted ones {fitted.median_px:.2f} px",
            "The data do not pin the cameras down everywhere: wave longer, through the whole volume.",
        )
    if agreeing_share < MIN_INLIER_SHARE:
        yield Warning(
            "holdout",
            f"only {100 * agreeing_share:.0f} % of the left-out detections agree with the calibration",
            "The calibration does not carry over to other parts of the recording: look for a camera that moved.",
        )


def about_time(names: Sequence[str], offsets: TimeOffsets) -> Iterator[Warning]:
    """Cameras out of step with the first."""
    for c, name in enumerate(names):
        offset, sigma = offsets.offset_frames[c], offsets.sigma_frames[c]
        if abs(offset) > max(MAX_OFFSET_FRAMES, 5 * sigma):
            word = "later" if offset > 0 else "earlier"
            yield Warning(
                "sync",
                f"{name} exposes {abs(offset):.2f} ± {sigma:.2f} frames {word} than {names[0]}",
                "Its detections pull the calibration askew: mend the trigger, or shift its frames.",
            )


def about_given_intrinsics(setups: Sequence[CameraSetup], free: Cameras) -> Iterator[Warning]:
    """Given intrinsics that the data contradict.

    Args:
        setups: what was given.
        free: cameras estimated with the given intrinsics as priors, not held.
    """
    for c, setup in enumerate(setups):
        if setup.knowledge is Knowledge.UNKNOWN or setup.intrinsics is None:
            continue
        given, found = optics_of(np.asarray(setup.intrinsics)), optics_of(free.intrinsics[c])
        # Distortion terms trade against each other; the focal length and the principal point speak for themselves.
        off = np.abs(found - given)[[0, 2, 3]] / prior_sigma(setup)[[0, 2, 3]]
        worst = int(np.array([0, 2, 3])[np.argmax(off)])
        if off.max() > 1.0:
            held = setup.knowledge is Knowledge.FIXED
            yield Warning(
                "intrinsics",
                f"{setup.name}: the data contradict the given {OPTICS_WORDS[worst]} {given[worst]:.1f} px: "
                f"they want {found[worst]:.1f} px",
                "It was held as asked: let it be a prior (intrinsics = \"initial\") unless it is certain."
                if held
                else "It was taken as a prior only; check the resolution and focus it was calibrated at.",
            )
