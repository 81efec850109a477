"""What cannot be calibrated: refused with the reason and with where to wave next."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from network_calib.errors import DegenerateError, FlatError, InputError
from network_calib.observations import BoolArray, FloatArray, Observations
from network_calib.pairs import PairGraph
from network_calib.room_setup import Anchor, CameraSetup, Knowledge, KnownCentres, KnownDistance
from network_calib.spots import SpotViews

# A camera has up to 13 unknowns and each of its observations gives little more than one equation of its own.
MIN_OBSERVATIONS = 30
# Departure from a plane or a line over the extent in the image; a plane held by hand keeps to about 1 %.
MIN_PLANE_DEPARTURE, MIN_LINE_DEPARTURE = 0.03, 0.05
# Pairs looked at for each camera: enough for a median in a network of hundreds.
MAX_PARTNERS = 6
MAX_RELATIVE_FOCAL_SIGMA = 0.1
MIN_INLIER_SHARE = 0.5
# A detector's noise is some tenths of a pixel; a camera ten times as noisy as the rest and beyond this is in error, and
# so is a network whose cameras are all noisy.
MAX_NOISE_PX, MAX_NOISE_RATIO, MAX_TYPICAL_NOISE_PX = 5.0, 10.0, 3.0


def refuse_bad_input(observations: Observations, setups: Sequence[CameraSetup], views: SpotViews) -> None:
    """Too little to start with.

    Raises:
        InputError: the setups do not describe the observed cameras.
        DegenerateError: one camera alone, or a camera with too few observations that another shares.
    """
    names = tuple(setup.name for setup in setups)
    if names != observations.camera_names:
        raise InputError(f"setups describe cameras {names}, the observations are of {observations.camera_names}")
    if len(setups) < 2:
        raise DegenerateError(
            f"a network needs two cameras or more, got {len(setups)}", advice="Add the recordings of the other cameras."
        )
    own = np.bincount(observations.camera, minlength=len(setups))
    shared = np.bincount(views.camera, minlength=len(setups))
    poor = np.flatnonzero(shared < MIN_OBSERVATIONS)
    if len(poor):
        lines = [f"{names[c]}: {own[c]} detections, {shared[c]} in frames that another camera saw too" for c in poor]
        raise DegenerateError(
            f"too few points, at least {MIN_OBSERVATIONS} shared detections per camera are needed:\n  "
            + "\n  ".join(lines),
            advice="Wave where these cameras and a neighbour both see the spot, or leave them out of the room.",
        )


def refuse_unknown_anchor(anchor: Anchor, names: Sequence[str]) -> None:
    """Anchors that name a camera which is not there.

    Raises:
        InputError: says which.
    """
    named: tuple[str, ...] = ()
    if isinstance(anchor, KnownDistance):
        named = (anchor.camera_a, anchor.camera_b)
    if isinstance(anchor, KnownCentres):
        named = anchor.names
    unknown = [name for name in named if name not in names]
    if unknown:
        raise InputError(f"the anchor names camera {unknown[0]!r}; the room has {', '.join(names)}")


def refuse_islands(graph: PairGraph) -> None:
    """Cameras that nothing ties together.

    Raises:
        DegenerateError: names the islands and the pair to bridge.
    """
    islands = graph.islands()
    bridge = graph.bridge()
    if len(islands) < 2 or bridge is None:
        return
    a, b = bridge
    groups = " | ".join(", ".join(graph.names[c] for c in group) for group in islands)
    disagreeing = "".join(f"\n{suspect.reason}" for suspect in graph.disagreeing_cameras())
    raise DegenerateError(
        f"the cameras fall into {len(islands)} unconnected groups: {groups}{disagreeing}",
        advice=(
            f"Wave where {graph.names[a]} and {graph.names[b]} both see the spot: "
            f"they share {graph.shared[a, b]} spots now, of which {graph.inliers[a, b]} agree; 200 make a good tie."
        ),
    )


def refuse_flat(
    setups: Sequence[CameraSetup], views: SpotViews, ray_xy: FloatArray, is_used: BoolArray, *, slack: float = 1.0
) -> None:
    """Waving in a plane or along a line.

    Judged in the images, where a wrong world cannot hide it: when the spots of two views are one homography apart, they
    lie in a plane (or the cameras in one place).

    Args:
        setups: what is known of each camera.
        views: K observations.
        ray_xy: (K, 2) undistorted rays.
        is_used: (K,) honest observations.
        slack: factor on the limits, for rays that may still be bent.

    Raises:
        FlatError: the spots are flat and some intrinsics are unknown, or lie on a line.
    """
    departures = np.array(_departures_from_plane(views, ray_xy, is_used))
    if not len(departures):
        return
    from_line, from_plane = np.median(departures, axis=0)
    if from_line < slack * MIN_LINE_DEPARTURE:
        raise FlatError(
            f"the spot moved along a line (its images depart from one by {100 * from_line:.1f} % of their length): "
            "any number of wrong worlds fit such data perfectly",
            advice="Wave through the whole volume: near and far, high and low.",
        )
    is_lens_unknown = any(setup.knowledge is Knowledge.UNKNOWN for setup in setups)
    if from_plane < slack * MIN_PLANE_DEPARTURE and is_lens_unknown:
        raise FlatError(
            f"the spot moved in a plane (views depart from a homography by {100 * from_plane:.1f} % of their extent): "
            "wrong worlds fit such data too, however small the reprojection error",
            advice="Wave through the whole volume: near and far, high and low; or give all cameras' intrinsics.",
        )


def _departures_from_plane(views: SpotViews, ray_xy: FloatArray, is_used: BoolArray) -> list[tuple[float, float]]:
    """For each pair: departure of the spots from a line and from a homography, over their extent in the image."""
    by_camera = []
    for c in range(views.n_cameras):
        rows = np.flatnonzero((views.camera == c) & is_used)
        by_camera.append((views.point[rows], ray_xy[rows]))
    out = []
    for a in range(views.n_cameras):
        for b in range(a + 1, min(views.n_cameras, a + 1 + MAX_PARTNERS)):
            _, at_a, at_b = np.intersect1d(by_camera[a][0], by_camera[b][0], return_indices=True)
            if len(at_a) < MIN_OBSERVATIONS:
                continue
            ray_a, ray_b = by_camera[a][1][at_a], by_camera[b][1][at_b]
            extent = np.linalg.svd(ray_b - ray_b.mean(axis=0), compute_uv=False)
            homography, _ = cv2.findHomography(ray_a, ray_b, 0)
            if homography is None:
                continue
            mapped = cv2.perspectiveTransform(ray_a[:, None], homography)[:, 0]
            departure = np.median(np.linalg.norm(mapped - ray_b, axis=1)) * np.sqrt(len(ray_b)) / extent[0]
            out.append((float(extent[1] / extent[0]), float(departure)))
    return out


def refuse_unobservable(setups: Sequence[CameraSetup], focal_px: FloatArray, focal_sigma_px: FloatArray) -> None:
    """Focal lengths that the data leave open.

    Raises:
        DegenerateError: names the cameras.
    """
    relative = focal_sigma_px / focal_px
    weak = np.flatnonzero(relative > MAX_RELATIVE_FOCAL_SIGMA)
    if len(weak):
        listed = ", ".join(f"{setups[c].name} ({focal_px[c]:.0f} ± {focal_sigma_px[c]:.0f} px)" for c in weak.tolist())
        raise DegenerateError(
            f"the focal length cannot be determined from these data: {listed}",
            advice="Wave nearer to and farther from these cameras, in view of cameras beside them, or give intrinsics.",
        )


def refuse_disagreement(names: Sequence[str], inlier_share: FloatArray, noise_px: FloatArray) -> None:
    """Cameras that the solution does not explain: few inliers, or noise that no detector has.

    Args:
        names: C camera names.
        inlier_share: (C,) share of each camera's observations that are inliers.
        noise_px: (C,) estimated detection noise.

    Raises:
        DegenerateError: names the cameras.
    """
    typical_px = np.median(noise_px)
    is_wild = (noise_px > MAX_NOISE_PX) & (noise_px > MAX_NOISE_RATIO * typical_px)
    is_wild |= (typical_px > MAX_TYPICAL_NOISE_PX) & (noise_px >= typical_px)
    poor = np.flatnonzero((inlier_share < MIN_INLIER_SHARE) | is_wild)
    if len(poor):
        listed = ", ".join(
            f"{names[c]} ({100 * inlier_share[c]:.0f} % within {noise_px[c]:.1f} px)" for c in poor.tolist()
        )
        raise DegenerateError(
            f"the detections of these cameras do not agree with the rest: {listed}",
            advice=(
                "Look at what they detected: another light, a mirrored image, or frames that were not taken at the "
                "same instant as the others'."
            ),
        )
