"""Crossings that an LRF node acquired, joined to the frames in which the cameras saw the spot at nearly that time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from lrf_stereo.samples import LrfSpots, TiltSettings
from network_calib.errors import InputError
from network_calib.observations import FloatArray, IntArray
from nodes.lrf_node import Acquired

# Of a frame's period: a crossing farther from any frame fell into a gap of the cameras' recording.
MAX_PERIODS = 1.0


@dataclass(frozen=True, slots=True)
class TimedSightings:
    """M sightings by one LRF that have a time and no frame yet; columns as of `LrfSpots`, settings counted from 0."""

    time_s: FloatArray
    setting: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    sigma_range_m: FloatArray
    sigma_bearing_rad: FloatArray
    sigma_out_of_plane_m: FloatArray
    bias_bound_m: FloatArray

    def __len__(self) -> int:
        return len(self.time_s)

    @classmethod
    def of(cls, acquired: Acquired) -> TimedSightings:
        """The crossings of an acquisition."""
        parts = [setting.crossings for setting in acquired.settings]
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__ if name != "setting"
        }
        return cls(setting=np.repeat(np.arange(len(parts)), [len(part) for part in parts]), **columns)


def lrf_spots(acquired: Acquired, frames: IntArray, stamps_s: FloatArray, *, first_setting: int = 0) -> LrfSpots:
    """The crossings of an acquisition as `with_frames` gives them."""
    return with_frames(TimedSightings.of(acquired), frames, stamps_s, first_setting=first_setting)


def with_frames(
    sightings: TimedSightings, frames: IntArray, stamps_s: FloatArray, *, first_setting: int = 0
) -> LrfSpots:
    """The sightings with the number of the nearest frame, and their delay from it; those far from any are left out.

    Args:
        sightings: of one LRF.
        frames: (F,) numbers of the cameras' frames.
        stamps_s: (F,) their times on the clock of the LRF node, growing.
        first_setting: number of this LRF's first tilt among all LRFs' settings.

    Raises:
        InputError: fewer than two frames, stamps that do not grow, or no crossing near a frame.
    """
    if len(frames) < 2 or (np.diff(stamps_s) <= 0).any():
        raise InputError(f"{len(frames)} camera frames with stamps, expected two or more that grow")
    time_s = sightings.time_s
    after = np.clip(np.searchsorted(stamps_s, time_s), 1, len(stamps_s) - 1)
    nearest = np.where(time_s - stamps_s[after - 1] < stamps_s[after] - time_s, after - 1, after)
    delay_s = time_s - stamps_s[nearest]
    is_near = np.abs(delay_s) <= MAX_PERIODS * float(np.median(np.diff(stamps_s)))
    if not is_near.any():
        raise InputError(
            "no crossing lies near a frame of the cameras in time",
            advice="Do the clocks of the LRF node and of the cameras agree? Synchronise them, and record again.",
        )
    found = LrfSpots(
        frame=frames[nearest],
        setting=sightings.setting + first_setting,
        range_m=sightings.range_m,
        bearing_rad=sightings.bearing_rad,
        out_of_plane_m=np.zeros(len(time_s)),
        sigma_range_m=sightings.sigma_range_m,
        sigma_bearing_rad=sightings.sigma_bearing_rad,
        sigma_out_of_plane_m=sightings.sigma_out_of_plane_m,
        bias_bound_m=sightings.bias_bound_m,
        delay_s=np.where(is_near, delay_s, 0.0),
    )
    return found.select(is_near & _is_first(found))


def _is_first(spots: LrfSpots) -> np.ndarray:
    """(M,) of sightings in one frame at one tilt only the first: the solve takes one."""
    _, first = np.unique(np.stack([spots.frame, spots.setting]), axis=1, return_index=True)
    out = np.zeros(len(spots), dtype=bool)
    out[first] = True
    return out


def tilt_settings(acquired: Sequence[Acquired]) -> TiltSettings:
    """The tilts of one or more LRFs; see `joined_settings`."""
    tilts = [one.tilts.tilts for one in acquired]
    return joined_settings([one.angle_rad for one in tilts], [one.covariance_rad2 for one in tilts])


def joined_settings(angle_rad: Sequence[FloatArray], covariance_rad2: Sequence[FloatArray]) -> TiltSettings:
    """The tilts of one LRF after the other; those of different LRFs are independent.

    Args:
        angle_rad: (T,) of each LRF.
        covariance_rad2: (T, T) of each.
    """
    sizes = [len(angles) for angles in angle_rad]
    return TiltSettings(
        scanner=np.repeat(np.arange(len(sizes)), sizes),
        angle_rad=np.concatenate(angle_rad),
        covariance_rad2=np.asarray(block_diag(*covariance_rad2), dtype=np.float64),
    )
