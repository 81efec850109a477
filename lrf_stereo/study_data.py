"""From simulated samples of the paper's set-up to what the calibrations take."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrf_stereo.refine import NetworkData
from lrf_stereo.samples import LrfSpots, TiltSettings
from lrf_stereo.synthetic import LrfSamples, LrfScene, SampleNoise, sample
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
        samples: what was reported of it.
        network: cameras as they are, held, with their spots.
        spots: LRF sightings.
        settings: reported tilts; trusted where their sigma is zero.
    """

    scene: LrfScene
    samples: LrfSamples
    network: NetworkData
    spots: LrfSpots
    settings: TiltSettings

    @classmethod
    def of(cls, scene: LrfScene, samples: LrfSamples) -> StudyData:
        """Triangulate the spots and take the columns over."""
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
        spots = LrfSpots(
            frame=samples.point,
            setting=samples.tilt,
            range_m=samples.range_m,
            bearing_rad=samples.bearing_rad,
            out_of_plane_m=np.zeros(len(samples.point)),
            sigma_range_m=samples.sigma_range_m,
            sigma_bearing_rad=samples.sigma_bearing_rad,
            sigma_out_of_plane_m=samples.sigma_out_of_plane_m,
        )
        one_scanner = np.zeros(len(samples.tilt_rad), dtype=np.int64)
        settings = TiltSettings(one_scanner, samples.tilt_rad, np.diag(samples.sigma_tilt_rad**2))
        return cls(scene, samples, network, spots, settings)

    def keep(self, is_kept: BoolArray) -> StudyData:
        """The same session with the sightings where `is_kept` (M,) holds."""
        return replace(self, spots=self.spots.select(is_kept))


def exact_samples(scene: LrfScene) -> LrfSamples:
    """Samples without any error, not even that of whole scan steps; the stated sigmas are those of a real session."""
    rng = np.random.default_rng(0)  # every number drawn is multiplied by a sigma of zero or replaced
    stated = sample(scene, rng=rng)
    exact = sample(scene, rng=rng, noise=SampleNoise(sigma_px=0.0, out_of_plane_m=0.0))
    range_m, bearing_rad, _ = scene.scanner.measure(scene.spots_in_world, scene.tilts_rad[scene.spot_tilt])
    return replace(
        stated,
        observations=exact.observations,
        range_m=range_m,
        bearing_rad=bearing_rad,
        spots_in_world=scene.spots_in_world,
    )
