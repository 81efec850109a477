"""What a person should know before trusting a calibration: each doubt with its numbers and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from network_calib.cameras import Cameras
from network_calib.observations import FloatArray
from network_calib.pairs import Overlap, PairGraph
from network_calib.priors import optics_of, prior_sigma
from network_calib.quality import Repeats
from network_calib.result import CameraQuality, Doubt, ErrorSummary
from network_calib.room_setup import CameraSetup, Knowledge
from network_calib.sync import TimeOffsets

MIN_COVERAGE = 0.25
MIN_INLIER_SHARE = 0.8
MAX_RELATIVE_FOCAL_SIGMA = 0.01
MAX_NOISE_RATIO = 4.0
MAX_HOLDOUT_RATIO = 1.5
MAX_OFFSET_FRAMES = 0.1
MIN_TWIN_RATIO = 1.5
MAX_HELD_NOISE_RATIO = 1.2
OPTICS_WORDS = ("focal length", "aspect", "centre x", "centre y", "d0", "d1", "d2", "d3")


def about_convergence(has_converged: bool, twin_cost_ratio: float) -> Iterator[Doubt]:
    """A solve that did not settle, or a mirrored twin that fits nearly as well."""
    if not has_converged:
        yield Doubt(
            "convergence", "the joint solve stopped before it settled", "Wave longer, through the whole volume."
        )
    if twin_cost_ratio < MIN_TWIN_RATIO:
        yield Doubt(
            "twin",
            f"a mirrored world fits nearly as well ({twin_cost_ratio:.2f} x the cost)",
            "Through long lenses depth can turn inside out: wave nearer to the cameras, or add one at a wide angle.",
        )


def about_repeats(repeats: Repeats, camera_covariance: FloatArray) -> Iterator[Doubt]:
    """Other seeds that lead elsewhere, or nowhere.

    Args:
        repeats: what other seeds gave.
        camera_covariance: (C, 14, 14); the centres' part says how far apart two honest answers may lie.
    """
    if repeats.n_failed:
        yield Doubt(
            "repeat",
            f"with {repeats.n_failed} of {repeats.n_repeats} other seeds the calibration fails",
            "The start is close to failing: wave longer, and where several cameras see the spot at once.",
        )
    allowed = float(np.sqrt(np.trace(camera_covariance[:, 3:6, 3:6], axis1=1, axis2=2).max()))
    if repeats.centre_spread > allowed:
        yield Doubt(
            "repeat",
            f"another seed moves a camera centre by {repeats.centre_spread:.3g}, its predicted sigma is {allowed:.3g}",
            "The data allow more than one answer: wave longer, through the whole volume.",
        )


def about_cameras(
    setups: Sequence[CameraSetup], qualities: Sequence[CameraQuality], focal_px: FloatArray, focal_sigma_px: FloatArray
) -> Iterator[Doubt]:
    """Thin coverage, many outliers, weak focal lengths, one camera much noisier than the rest."""
    typical_noise = float(np.median([quality.noise_sigma_px for quality in qualities]))
    for c, (setup, quality) in enumerate(zip(setups, qualities, strict=True)):
        name = setup.name
        if quality.coverage < MIN_COVERAGE:
            yield Doubt(
                "coverage",
                f"{name}: spots cover {100 * quality.coverage:.0f} % of the image",
                "Distortion is a guess where no spot was seen: wave into this camera's corners.",
            )
        share = quality.fitted.n / max(quality.n_observations, 1)
        if share < MIN_INLIER_SHARE:
            yield Doubt(
                "outliers",
                f"{name}: only {100 * share:.0f} % of {quality.n_observations} detections agree with the others",
                "Look for lamps, reflections or screens in its view.",
            )
        if focal_sigma_px[c] > MAX_RELATIVE_FOCAL_SIGMA * focal_px[c]:
            yield Doubt(
                "focal",
                f"{name}: focal length {focal_px[c]:.0f} px is uncertain by {focal_sigma_px[c]:.0f} px",
                "Wave nearer to and farther from it, or give its intrinsics.",
            )
        if quality.noise_sigma_px > MAX_NOISE_RATIO * typical_noise:
            yield Doubt(
                "noise",
                f"{name}: detection noise {quality.noise_sigma_px:.2f} px, the others' is {typical_noise:.2f} px",
                "Check its focus, exposure and frame timing.",
            )


def about_geometry(graph: PairGraph, cameras: Cameras) -> Iterator[Doubt]:
    """Weak ties and camera centres on one line."""
    best = [max((graph.inliers[c, d], d) for d in range(len(graph.names)) if d != c) for c in range(len(graph.names))]
    for c, (count, partner) in enumerate(best):
        grade = graph.grade(c, partner)
        if grade is not Overlap.GOOD:
            yield Doubt(
                "overlap",
                f"{graph.names[c]}: its best tie, to {graph.names[partner]}, rests on {count} spots ({grade.value})",
                "Wave more where both see the spot: 200 make a good tie.",
            )
    centres = cameras.centres_in_world
    if len(centres) >= 3:
        extent = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
        if extent[1] < 0.01 * extent[0]:
            yield Doubt(
                "colinear",
                "all camera centres lie on one line",
                "The network is weak against bending about it: add a camera off the line if accuracy matters there.",
            )


def about_holdout(fitted: ErrorSummary, holdout: ErrorSummary, agreeing_share: float) -> Iterator[Doubt]:
    """Left-out segments that are predicted worse than the fitted ones."""
    if holdout.n and holdout.median_px > MAX_HOLDOUT_RATIO * fitted.median_px:
        yield Doubt(
            "holdout",
            f"left-out segments show {holdout.median_px:.2f} px median error, fitted ones {fitted.median_px:.2f} px",
            "The data do not pin the cameras down everywhere: wave longer, through the whole volume.",
        )
    if agreeing_share < MIN_INLIER_SHARE:
        yield Doubt(
            "holdout",
            f"only {100 * agreeing_share:.0f} % of the left-out detections agree with the calibration",
            "The calibration does not carry over to other parts of the recording: look for a camera that moved.",
        )


def about_time(names: Sequence[str], offsets: TimeOffsets) -> Iterator[Doubt]:
    """Cameras out of step with the others: with their median, so that the odd one is named, not all but it."""
    n = len(names)
    typical = float(np.median(offsets.offset_frames)) if n > 2 else 0.0
    relative = offsets.offset_frames - typical
    sigma = offsets.sigma_frames.copy()
    if typical != 0.0:
        sigma[offsets.reference] = float(np.median(np.delete(sigma, offsets.reference)))
    for c, name in enumerate(names):
        if abs(relative[c]) > max(MAX_OFFSET_FRAMES, 5 * sigma[c]):
            word = "later" if relative[c] > 0 else "earlier"
            yield Doubt(
                "sync",
                f"{name} exposes {abs(relative[c]):.2f} ± {sigma[c]:.2f} frames {word} than "
                f"{'the others' if n > 2 else names[offsets.reference]}",
                "Its detections pull the calibration askew: mend the trigger, or shift its frames.",
            )


def about_given_intrinsics(setups: Sequence[CameraSetup], free: Cameras, noise_ratio: FloatArray) -> Iterator[Doubt]:
    """Given intrinsics that the data contradict.

    Args:
        setups: what was given.
        free: cameras estimated with the given intrinsics as priors, not held.
        noise_ratio: (C,) noise with held intrinsics over that without.
    """
    for c, setup in enumerate(setups):
        if setup.knowledge is Knowledge.UNKNOWN or setup.intrinsics is None:
            continue
        given, found = optics_of(np.asarray(setup.intrinsics)), optics_of(free.intrinsics[c])
        # Distortion terms trade against each other; the focal length and the principal point speak for themselves.
        off = np.abs(found - given)[[0, 2, 3]] / prior_sigma(setup)[[0, 2, 3]]
        worst = int(np.array([0, 2, 3])[np.argmax(off)])
        held = setup.knowledge is Knowledge.FIXED
        if off.max() > 1.0 or (held and noise_ratio[c] > MAX_HELD_NOISE_RATIO):
            yield Doubt(
                "intrinsics",
                f"{setup.name}: the data contradict the given {OPTICS_WORDS[worst]} {given[worst]:.1f} px: "
                f"they want {found[worst]:.1f} px",
                'It was held as asked: let it be a prior (intrinsics = "initial") unless it is certain.'
                if held
                else "It was taken as a prior only; check the resolution and focus it was calibrated at.",
            )
