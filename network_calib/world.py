"""Step 7: from the solve's own frame into the world that the user asked for: scale and frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from network_calib.cameras import Cameras
from network_calib.errors import DegenerateError, InputError
from network_calib.gauge import Similarity, fit_similarity, into_camera, level_to_floor
from network_calib.observations import FloatArray
from network_calib.refine import Refined
from network_calib.result import WorldFrame
from network_calib.room_setup import Anchor, KnownCentres, KnownDistance, KnownPoints, Options, UnitScale
from network_calib.spots import SpotViews


def in_world(refined: Refined, views: SpotViews, anchor: Anchor, options: Options) -> tuple[WorldFrame, Refined]:
    """Move a solution into the world frame of the anchor.

    Raises:
        InputError: the anchor names an unknown camera or frame.
        DegenerateError: known positions that fix no frame, or frames that were not located.
    """
    frame, motion = _anchored(refined, views, anchor)
    moved = _moved(refined, motion)
    if options.floor_frames:
        floor = level_to_floor(_located(moved, views, options.floor_frames), moved.cameras)
        moved, frame = _moved(moved, floor), replace(frame, name="floor")
    return frame, moved


def _anchored(refined: Refined, views: SpotViews, anchor: Anchor) -> tuple[WorldFrame, Similarity]:
    cameras = refined.cameras
    if isinstance(anchor, KnownCentres):
        index = [_camera_index(cameras, name) for name in anchor.names]
        motion = fit_similarity(cameras.centres_in_world[index], anchor.centres_in_world_m)
        error = motion.apply(cameras.centres_in_world[index]) - anchor.centres_in_world_m
        words = f"{len(index)} given camera centres, met within {_rms(error):.4g} m RMS"
        return WorldFrame("given centres", "m", words, _relative_rms(error, anchor.centres_in_world_m)), motion
    if isinstance(anchor, KnownPoints):
        spots = _located(refined, views, anchor.frames)
        motion = fit_similarity(spots, anchor.points_in_world_m)
        error = motion.apply(spots) - anchor.points_in_world_m
        words = f"{len(spots)} given points, met within {_rms(error):.4g} m RMS"
        return WorldFrame("given points", "m", words, _relative_rms(error, anchor.points_in_world_m)), motion
    a, b = scale_ends(cameras, anchor)
    distance = float(np.linalg.norm(cameras.centres_in_world[b] - cameras.centres_in_world[a]))
    name = cameras.names[0]
    if isinstance(anchor, KnownDistance):
        kind = "baseline" if anchor.is_stereo_pair else "distance"
        words = f"{kind} {anchor.camera_a}-{anchor.camera_b} = {anchor.distance_m:g} m"
        frame = WorldFrame(name, "m", words, anchor.sigma_m / anchor.distance_m)
        return frame, into_camera(cameras, 0, anchor.distance_m / distance)
    words = f"none: the distance {cameras.names[a]}-{cameras.names[b]} is one unit"
    return WorldFrame(name, "unit", words, 0.0), into_camera(cameras, 0, 1 / distance)


def _moved(refined: Refined, motion: Similarity) -> Refined:
    return replace(refined, cameras=motion.apply_to_cameras(refined.cameras), points=motion.apply(refined.points))


def scale_ends(cameras: Cameras, anchor: Anchor) -> tuple[int, int]:
    """The two cameras whose distance names the scale."""
    if isinstance(anchor, KnownDistance):
        return _camera_index(cameras, anchor.camera_a), _camera_index(cameras, anchor.camera_b)
    assert isinstance(anchor, UnitScale)
    return 0, 1


def _camera_index(cameras: Cameras, name: str) -> int:
    if name not in cameras.names:
        raise InputError(f"the anchor names camera {name!r}; the room has {', '.join(cameras.names)}")
    return cameras.names.index(name)


def _located(refined: Refined, views: SpotViews, frames: Sequence[int]) -> FloatArray:
    """(n, 3) spots of given frames."""
    index = np.searchsorted(views.frames, frames)
    found = (index < len(views.frames)) & (views.frames[np.minimum(index, len(views.frames) - 1)] == np.array(frames))
    is_located = found & np.isfinite(refined.points[np.where(found, index, 0)]).all(axis=1)
    if not is_located.all():
        missing = [frame for frame, ok in zip(frames, is_located, strict=True) if not ok]
        raise DegenerateError(
            f"the spot was not located in the named frames {missing}: fewer than two cameras agree on it there",
            advice="Name frames in which the spot rests in view of two cameras or more.",
        )
    return refined.points[index]


def _rms(error: FloatArray) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def _relative_rms(error: FloatArray, target: FloatArray) -> float:
    """Relative scale uncertainty of a fitted similarity: residual over spread, per degree of freedom."""
    spread = float(np.sqrt(((target - target.mean(axis=0)) ** 2).sum()))
    dof = max(error.size - 7, 1)
    return float(np.sqrt((error**2).sum() / dof)) / spread
