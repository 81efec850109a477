"""From simulated samples of the paper's set-up to what the calibrations take."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrf_stereo.joint_problem import NetworkData
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.synthetic import LrfSamples, LrfScene
from network_calib.observations import BoolArray
from network_calib.room_setup import CameraSetup, Knowledge
from network_calib.spots import SpotViews, locate

# Largest reprojection error of a detection, in its sigma: the simulated detections are all honest.
TOLERANCE_SIGMA = 6.0


@dataclass(frozen=True, slots=True)
class StudyData:
    """One simulated session, as the calibrations take it.

    Attributes:
        scene: the truth.
        network: the true cameras, held, with the spots that they triangulate.
        spots: LRF sightings.
        settings: reported tilts; trusted where their covariance is zero.
    """

    scene: LrfScene
    network: NetworkData
    spots: LrfSpots
    settings: TiltSettings

    @classmethod
    def of(cls, scene: LrfScene, samples: LrfSamples) -> StudyData:
        """Triangulate the spots."""
        cameras = scene.cameras
        views = SpotViews.of(samples.observations)
        points, is_inlier = locate(cameras, views, TOLERANCE_SIGMA * views.sigma_px)
        setups = tuple(
            CameraSetup(name, (int(size[0]), int(size[1])), lens, Knowledge.FIXED, intrinsics)
            for name, size, lens, intrinsics in zip(
                cameras.names, cameras.size_px, cameras.lenses, cameras.intrinsics, strict=True
            )
        )
        noise = np.ones(len(cameras))
        network = NetworkData(setups, cameras, views, points, is_inlier, noise, is_held=True, baseline=None)
        return cls(scene, network, samples.spots, samples.settings)

    def keep(self, is_kept: BoolArray) -> StudyData:
        """The same session with the sightings where `is_kept` (M,) holds."""
        return replace(self, spots=self.spots.select(is_kept))
