"""What a joint solve of cameras and LRFs is given: the network with its spots, and the sightings of the LRFs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lrf_stereo.lrf_priors import Instruments, InstrumentSigma, each_instrument
from lrf_stereo.samples import LrfSpots, TiltSettings
from network_calib.cameras import Cameras
from network_calib.observations import BoolArray, FloatArray, IntArray
from network_calib.room_setup import CameraSetup, KnownDistance
from network_calib.spots import SpotViews


@dataclass(frozen=True, slots=True)
class NetworkData:
    """The camera side of a joint solve.

    Attributes:
        setups: what is known of each camera.
        cameras: C cameras, metric.
        views: K camera observations of F spots.
        points: (F, 3) spots in the cameras' world, NaN where not located.
        is_inlier: (K,) observations that count.
        noise: (C,) noise factors.
        is_held: the cameras are known and stay as they are.
        baseline: the metric anchor of cameras that are not held; None leaves the scale to the LRFs' ranges.
        frame_period_s: time from one frame number to the next, for observations without stamps; None where unknown.
    """

    setups: Sequence[CameraSetup]
    cameras: Cameras
    views: SpotViews
    points: FloatArray
    is_inlier: BoolArray
    noise: FloatArray
    is_held: bool
    baseline: KnownDistance | None
    frame_period_s: float | None = None


@dataclass(frozen=True, slots=True)
class LrfData:
    """The LRF side of a joint solve.

    Attributes:
        spots: M sightings.
        settings: T tilt settings as measured. A covariance of zero trusts the angles as they are.
        point: (M,) point index of each sighting's frame in the cameras' views, -1 where they have none.
        instrument: what each of the S scanners may be wrong by.
    """

    spots: LrfSpots
    settings: TiltSettings
    point: IntArray
    instrument: tuple[InstrumentSigma, ...]

    @classmethod
    def of(
        cls, spots: LrfSpots, settings: TiltSettings, views: SpotViews, instrument: Instruments | None = None
    ) -> LrfData:
        """Find the sightings' points in the cameras' views.

        Raises:
            InputError: what instruments may be wrong by is given for another number of scanners.
        """
        point = np.full(len(spots), -1)
        if views.n_points:
            at = np.minimum(np.searchsorted(views.frames, spots.frame), views.n_points - 1)
            point = np.where(views.frames[at] == spots.frame, at, -1)
        return cls(spots, settings, point, each_instrument(instrument, settings.n_scanners))

    @property
    def measured(self) -> FloatArray:
        """(3, M) range, bearing, height over the scan plane."""
        return np.stack([self.spots.range_m, self.spots.bearing_rad, self.spots.out_of_plane_m])

    @property
    def sigma(self) -> FloatArray:
        """(3, M) standard deviations of `measured`."""
        return np.stack([self.spots.sigma_range_m, self.spots.sigma_bearing_rad, self.spots.sigma_out_of_plane_m])

    @property
    def scanner(self) -> IntArray:
        """(M,) scanner of each sighting."""
        return self.settings.scanner[self.spots.setting]

    @property
    def sigma_clock_s(self) -> FloatArray:
        """(M,) prior standard deviation of the clock offset of each sighting's scanner."""
        return np.array([sigma.clock_offset_s for sigma in self.instrument])[self.scanner]
