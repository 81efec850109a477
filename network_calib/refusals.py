"""What cannot be calibrated: refused with the reason and with where to wave next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from network_calib.errors import DegenerateError, InputError
from network_calib.observations import FloatArray, Observations
from network_calib.pairs import PairGraph
from network_calib.room_setup import CameraSetup, Knowledge
from network_calib.spots import SpotViews

# A camera has up to 13 unknowns and each of its observations gives little more than one equation of its own.
MIN_OBSERVATIONS = 30
# Third against first principal extent of the waved volume: a plane held by hand keeps to about 1 %.
PLANE_EXTENT, LINE_EXTENT = 0.01, 0.01
MAX_RELATIVE_FOCAL_SIGMA = 0.1
MIN_INLIER_SHARE = 0.5


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


def refuse_flat(setups: Sequence[CameraSetup], points: FloatArray) -> None:
    """Waving in a plane or along a line. A plane stays a plane in a wrong world too, so the check holds there.

    Raises:
        DegenerateError: the located spots are flat and some intrinsics are unknown, or lie on a line.
    """
    located = points[np.isfinite(points).all(axis=1)]
    # A few spots with a bad triangulation must not make a volume of a plane.
    near = located - np.median(located, axis=0)
    size = np.linalg.norm(near, axis=1)
    near = near[size <= np.quantile(size, 0.98)]
    extent = np.linalg.svd(near, compute_uv=False)
    if extent[1] < LINE_EXTENT * extent[0]:
        raise DegenerateError(
            f"the spot moved along a line (second extent {100 * extent[1] / extent[0]:.2f} % of the first): "
            "any number of wrong worlds fit such data perfectly",
            advice="Wave through the whole volume: near and far, high and low.",
        )
    if extent[2] < PLANE_EXTENT * extent[0] and any(s.knowledge is Knowledge.UNKNOWN for s in setups):
        raise DegenerateError(
            f"the spot moved in a plane (third extent {100 * extent[2] / extent[0]:.2f} % of the first): "
            "focal lengths and positions cannot be told from such data, however small the reprojection error",
            advice="Wave through the whole volume: near and far, high and low; or give all cameras' intrinsics.",
        )


def refuse_unobservable(setups: Sequence[CameraSetup], focal_px: FloatArray, focal_sigma_px: FloatArray) -> None:
    """Focal lengths that the data leave open.

    Raises:
        DegenerateError: names the cameras.
    """
    relative = focal_sigma_px / focal_px
    weak = np.flatnonzero(relative > MAX_RELATIVE_FOCAL_SIGMA)
    if len(weak):
        listed = ", ".join(f"{setups[c].name} ({focal_px[c]:.0f} ± {focal_sigma_px[c]:.0f} px)" for c in weak)
        raise DegenerateError(
            f"the focal length cannot be determined from these data: {listed}",
            advice="Wave nearer to and farther from these cameras, in view of cameras beside them, or give intrinsics.",
        )


def refuse_disagreement(graph: PairGraph, inlier_share: FloatArray) -> None:
    """A network in which too little agrees.

    Args:
        graph: the overlap graph.
        inlier_share: (C,) share of each camera's observations that the solution explains.

    Raises:
        DegenerateError: names the cameras that agree least.
    """
    poor = np.flatnonzero(inlier_share < MIN_INLIER_SHARE)
    if len(poor):
        listed = ", ".join(f"{graph.names[c]} ({100 * inlier_share[c]:.0f} %)" for c in poor)
        reasons = "".join(f"\n{suspect.reason}" for suspect in graph.disagreeing_cameras())
        raise DegenerateError(
            f"less than half of the detections agree with the best solution: {listed}{reasons}",
            advice=(
                "Look at what these cameras detected: another light, a mirrored image, or frames that were not taken "
                "at the same instant as the others'."
            ),
        )
