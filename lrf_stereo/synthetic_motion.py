"""A waved spot with known truth: it crosses the scan plane while the cameras run, and the LRF's clock is off.

Every sighting is of the beam that met the spot, at its own time within the sweep; the cameras expose on a grid of their
own, so that the spot has moved between the nearest frame and the beam.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrf_stereo.scanner import ScanSteps
from lrf_stereo.synthetic import LrfSamples, LrfScene, SampleNoise, detect, sightings, tilt_settings
from network_calib.observations import FloatArray, IntArray, Observations

# Crossings follow each other after this time, so that the frames around them never meet.
CROSSING_EVERY_S = 4.0


@dataclass(frozen=True, slots=True)
class Waving:
    """How the spot moves, and how its time is told.

    Attributes:
        speed_m_s: standard deviation of the velocity in the scan plane's crossing, on each axis.
        drift_m_s: (3,) velocity in world that all crossings share.
        turn_rate_rad_s: how fast the velocity turns.
        frame_rate_hz: of the cameras.
        n_frames: frames before and after the one that is nearest to a crossing.
        clock_offset_s: what the LRF's stamps lack to the cameras'.
    """

    speed_m_s: float = 0.3
    drift_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_rate_rad_s: float = 3.0
    frame_rate_hz: float = 30.0
    n_frames: int = 3
    clock_offset_s: float = 0.0


def sample_moving(
    scene: LrfScene, waving: Waving, *, rng: np.random.Generator, noise: SampleNoise | None = None
) -> LrfSamples:
    """Report the spots of a scene as `sample` does, but moving: each crosses its scan plane where it stands there.

    `frame` of a sighting is the one nearest to the stated time of its beam; the observations have stamps.
    """
    noise = SampleNoise() if noise is None else noise
    n = len(scene.spots_in_world)
    tilts = scene.tilts_rad[scene.spot_tilt]
    normals = scene.scanner.world_from_lrf_at(tilts).rotation.as_matrix()[:, :, 2]
    height = noise.out_of_plane_bias_m + noise.scale * noise.out_of_plane_m * rng.standard_normal(n)
    crossing = scene.spots_in_world + height[:, None] * normals
    beam_s = CROSSING_EVERY_S * (1 + np.arange(n)) + rng.random(n)
    frame = np.round((beam_s - waving.clock_offset_s) * waving.frame_rate_hz).astype(np.int64)
    frames = frame[:, None] + np.arange(-waving.n_frames, waving.n_frames + 1)
    points = _way(waving, crossing, frames / waving.frame_rate_hz - beam_s[:, None], rng)
    range_m, bearing, _ = scene.scanner.measure(crossing, tilts)
    spots = sightings(scene, range_m, bearing, noise=noise, rng=rng)
    steps = ScanSteps()
    # The bearing that tells the beam's time is itself rounded to a step.
    stated_s = beam_s - waving.clock_offset_s + steps.beam_time_s(spots.bearing_rad) - steps.beam_time_s(bearing)
    return LrfSamples(
        observations=_observed(scene, points.reshape(-1, 3), frames.ravel(), waving.frame_rate_hz, noise, rng),
        spots=replace(spots, frame=frame, delay_s=stated_s - frame / waving.frame_rate_hz),
        settings=tilt_settings(scene, noise=noise, rng=rng),
        is_true=np.ones(n, dtype=bool),
        spots_in_world=crossing,
    )


def _way(waving: Waving, crossing: FloatArray, since_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n, k, 3) positions at times (n, k) after the crossings (n, 3): ellipses, along which the velocity turns."""
    rate, shape = waving.turn_rate_rad_s, crossing.shape
    velocity = waving.speed_m_s * rng.standard_normal(shape) + np.array(waving.drift_m_s)
    aside = waving.speed_m_s * rng.standard_normal(shape)
    along, across = np.sin(rate * since_s) / rate, (1 - np.cos(rate * since_s)) / rate
    return crossing[:, None] + along[..., None] * velocity[:, None] + across[..., None] * aside[:, None]


def _observed(
    scene: LrfScene,
    points: FloatArray,
    frames: IntArray,
    frame_rate_hz: float,
    noise: SampleNoise,
    rng: np.random.Generator,
) -> Observations:
    """Detections of points (P, 3) in their frames (P,), with stamps."""
    seen = detect(scene.cameras, points, noise=noise, rng=rng)
    frame = frames[seen.point]
    return Observations.from_columns(
        scene.cameras.names,
        camera=seen.camera,
        frame=frame,
        px=seen.px,
        sigma_px=seen.sigma_px,
        stamp_ns=np.round(frame * (1e9 / frame_rate_hz)).astype(np.int64),
    )
