"""The image of a glowing ball: its disc through the distorted lens, along its way during the exposure, blurred.

The ball is a bundle of thin beams: rings over its visible disc times instants of the exposure. Each beam goes through
the lens by itself and becomes a Gaussian (the lens's blur) integrated over whole pixels, so perspective, distortion,
curved smear and partial occlusion need no formula of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from nodes.simulated.rendering.camera_view import CameraView

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
# A Gaussian is cut off here: 6e-7 of its light lies beyond, on both sides alike.
CUT_SIGMAS = 5.0
MAX_RINGS = 8
MAX_INSTANTS = 63
# Half-angle of the cone of probes that measures the lens's scale.
PROBE_SINE = 1e-4
# Beams this many blurs apart add up to a disc that is even to 4 %: a real diffuser is less so.
BEAM_SPACING_SIGMAS = 1.1


class SpotColour(StrEnum):
    """The pointer's light."""

    RED = "red"
    GREEN = "green"
    INFRARED = "infrared"

    @property
    def bgr(self) -> tuple[float, float, float]:
        """How blue, green and red pixels answer, relative to the best; infrared without a blocking filter."""
        return {
            SpotColour.RED: (0.01, 0.05, 1.0),
            SpotColour.GREEN: (0.12, 1.0, 0.09),
            SpotColour.INFRARED: (0.85, 0.85, 1.0),
        }[self]


@dataclass(frozen=True, slots=True)
class Ball:
    """A diffuser ball around the pointer's tip.

    Attributes:
        diameter_m: of the ball.
        radiance: brightness of the middle of its disc, in full scales of the sensor at `sensor.REFERENCE_EXPOSURE_S`
            and 0 dB. As of any surface, it does not fall with distance; the disc shrinks.
        colour: of the light.
        limb_exponent: brightness over the disc is (1 - rho^2)^limb_exponent, rho = 0..1 from middle to rim: 0 for a
            matt shell lit from inside, 0.5 for a cloudy ball, more for one that is brightest in the middle.
    """

    diameter_m: float = 0.03
    radiance: float = 1.5
    colour: SpotColour = SpotColour.RED
    limb_exponent: float = 0.5


@dataclass(frozen=True, slots=True)
class Beams:
    """The ball's light in the image, before blur.

    Attributes:
        px: (B, 2) where each beam falls.
        weight: (B,) its light: level times px^2, so that a wide even disc has the level of the radiance.
        spread_px: blur of each beam that stands for the space between beams; the lens's own comes on top.
    """

    px: FloatArray
    weight: FloatArray
    spread_px: float = 0.0

    @property
    def total(self) -> float:
        """All light."""
        return float(self.weight.sum())

    @property
    def centroid_px(self) -> FloatArray:
        """(2,) centre of all light; NaN without light."""
        return self.weight @ self.px / self.total if self.total > 0 else np.full(2, np.nan)

    @property
    def size_px(self) -> float:
        """Standard deviation of the light about its centre, mean of both axes; light there must be."""
        return float(np.sqrt(self.weight @ ((self.px - self.centroid_px) ** 2).sum(axis=1) / self.total / 2))


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of light to be added to an image: values (h, w) with the top-left pixel at column x, row y."""

    x: int
    y: int
    values: FloatArray


def disc_directions(
    centre_in_world: FloatArray, ball_in_world: FloatArray, radius_m: float, n_rings: int
) -> FloatArray:
    """(D, 3) unit directions over the cone that the ball fills; the first is its axis, then rings of 6, 12, 18, ..."""
    offset = ball_in_world - centre_in_world
    distance_m = float(np.sqrt(offset @ offset))
    axis = offset / distance_m
    # Any direction across will do; these never vanish.
    across = np.array([axis[1], -axis[0], 0.0]) if abs(axis[2]) < 0.9 else np.array([0.0, axis[2], -axis[1]])
    across /= np.sqrt(across @ across)
    up = np.array(
        [
            axis[1] * across[2] - axis[2] * across[1],
            axis[2] * across[0] - axis[0] * across[2],
            axis[0] * across[1] - axis[1] * across[0],
        ]
    )
    rho, turn = ring_places(n_rings)
    sine = rho * min(radius_m / distance_m, 0.9)
    around = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * up
    return np.sqrt(1 - sine * sine)[:, None] * axis + sine[:, None] * around


@cache
def ring_places(n_rings: int) -> tuple[FloatArray, FloatArray]:
    """Radii 0..1 and angles (D,) of evenly spaced places in the unit disc: the middle, rings of 6, 12, 18, ..."""
    counts = _ring_counts(n_rings)
    turn = [2 * np.pi * (np.arange(n) + 0.5 * (ring % 2)) / n for ring, n in enumerate(counts)]
    return np.repeat(np.arange(n_rings + 1) / (n_rings + 0.5), counts), np.concatenate(turn)


@cache
def ring_weights(n_rings: int, limb_exponent: float) -> FloatArray:
    """(D,) integral of (1 - rho^2)^limb_exponent over each place's share of the disc, in disc areas.

    A ring reaches half a step in and out; the integral over an annulus is a difference of powers of 1 - rho^2.
    """
    bounds = np.append(0.0, (np.arange(n_rings + 1) + 0.5) / (n_rings + 0.5))
    outside = np.clip(1 - bounds**2, 0.0, 1.0) ** (limb_exponent + 1) / (limb_exponent + 1)
    counts = _ring_counts(n_rings)
    return np.repeat(-np.diff(outside) / np.array(counts), counts)


def ring_spread(n_rings: int) -> float:
    """Standard deviation per axis of a place's share, in disc radii: what places without size lack.

    The mean of rho^2 over a ring from n - 1/2 to n + 1/2 is n^2 + 1/4, over the middle 1/8; half of it for each axis.
    """
    steps = n_rings + 0.5
    return float(np.sqrt((0.25 - 0.125 * (0.5 / steps) ** 2) / 2) / steps)


def _ring_counts(n_rings: int) -> list[int]:
    return [1, *(6 * ring for ring in range(1, n_rings + 1))]


def beams_of_ball(
    view: CameraView,
    places_in_world: FloatArray,
    ball: Ball,
    *,
    level: float,
    sigma_px: float,
    is_hidden: Callable[[FloatArray], BoolArray],
) -> tuple[Beams, float]:
    """Beams of the ball that stands at each of `places_in_world` for an equal part of the exposure.

    The rings are laid at the middle place and carried along: over an exposure the disc itself does not change.
    Light per solid angle is the same over the image, which is a lens with natural vignetting to first order.

    Args:
        view: the camera.
        places_in_world: (N, 3) centres of the ball, N odd: the middle one is at mid-exposure and in the lens's view.
        ball: what glows.
        level: level of the disc's middle.
        sigma_px: the blur to come; decides how many rings are laid.
        is_hidden: tells of points (D, 3) on the ball's near side, at mid-exposure, which ones the camera cannot see.

    Returns:
        The beams, and the part of the disc's light that is not hidden.
    """
    eye, middle, radius_m = view.centre_in_world, places_in_world[len(places_in_world) // 2], ball.diameter_m / 2
    distance_m = float(np.linalg.norm(middle - eye))
    radius_px = view.focal_px * radius_m / distance_m
    n_rings = int(np.clip(np.ceil(radius_px / (BEAM_SPACING_SIGMAS * sigma_px)), 1, MAX_RINGS))
    directions = disc_directions(eye, middle, radius_m, n_rings)
    probes = disc_directions(eye, middle, PROBE_SINE * distance_m, 1)[1:]
    rays = eye + distance_m * np.concatenate([directions, probes])
    px, is_seen = view.project(np.concatenate([rays, places_in_world]))
    n_disc, n_rays = len(directions), len(rays)
    area_px2 = _cone_area_px2(px[n_disc:n_rays], radius_m / distance_m)
    area_px2 = area_px2 if np.isfinite(area_px2) else np.pi * radius_px**2  # at the rim of what the lens sees

    weight = ring_weights(n_rings, ball.limb_exponent) * (level * area_px2)
    is_open = ~is_hidden(eye + (distance_m - radius_m) * directions)
    visible_part = 1.0 if is_open.all() else float(weight @ is_open / weight.sum())
    disc_px, way_px = px[:n_disc], px[n_rays:]
    carried_px, carried = _carried(disc_px, np.where(is_seen[:n_disc] & is_open, weight, 0.0), way_px)
    # Only a disc too large for MAX_RINGS needs still softer beams; its rim is then softer than the lens makes it.
    enough_px = radius_px / n_rings / BEAM_SPACING_SIGMAS
    spread_px = max(ring_spread(n_rings) * radius_px, np.sqrt(max(enough_px**2 - sigma_px**2, 0.0)))
    return Beams(carried_px, carried, float(spread_px)), visible_part


def _carried(disc_px: FloatArray, weight: FloatArray, way_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A disc (D, 2) with its light (D,), laid at the middle of a way (N, 2), spread over the way: (N D, 2), (N D,).

    Pixels that the lens does not see are NaN and give no light.
    """
    is_lit = np.isfinite(way_px[:, :1]) & np.isfinite(disc_px[:, 0])
    px = disc_px[None] + (way_px - way_px[len(way_px) // 2])[:, None]
    shares = np.where(is_lit, weight / len(way_px), 0.0)
    return np.where(is_lit[..., None], px, 0.0).reshape(-1, 2), shares.reshape(-1)


def n_instants_for(smear_px: float, sigma_px: float) -> int:
    """As many instants (odd) as the smear needs to look smooth under the blur; one where nothing moves."""
    if smear_px < 0.02:
        return 1
    n = int(np.clip(np.ceil(smear_px / (0.6 * sigma_px)), 3, MAX_INSTANTS))
    return n + 1 - n % 2


def _cone_area_px2(probes_px: FloatArray, sine: float) -> float:
    """Area in the image of a cone of this half-angle, by the ellipse of six probes on a tiny cone around its axis."""
    # Six points on an ellipse: its area is 2 pi sqrt(det) of their covariance.
    offset = probes_px - probes_px.mean(axis=0)
    spread = offset.T @ offset / len(offset)
    determinant = spread[0, 0] * spread[1, 1] - spread[0, 1] ** 2
    probe_sine = PROBE_SINE * ring_places(1)[0][1]
    return float(2 * np.pi * np.sqrt(abs(determinant)) * (sine / probe_sine) ** 2)


def patch_of(beams: Beams, *, sigma_px: float, size_px: tuple[int, int]) -> Patch | None:
    """Blur the beams and integrate them over pixels; None where no light falls into the image.

    A Gaussian integrated over a pixel is a difference of two normal distributions, for x and y apart:
    values = Ey^T diag(weight) Ex.
    """
    lit = beams.weight > 0
    if not lit.any():
        return None
    px, weight = beams.px[lit], beams.weight[lit]
    sigma = float(np.hypot(sigma_px, beams.spread_px))
    low = np.floor(px.min(axis=0) - CUT_SIGMAS * sigma).astype(int)
    high = np.ceil(px.max(axis=0) + CUT_SIGMAS * sigma).astype(int) + 1
    low, high = np.clip(low, 0, size_px), np.clip(high, 0, size_px)
    if (high <= low).any():
        return None
    parts = [_over_pixels(px[:, axis], low[axis], high[axis], sigma) for axis in (0, 1)]
    return Patch(int(low[0]), int(low[1]), (parts[1] * weight[:, None]).T @ parts[0])


def _over_pixels(centre_px: FloatArray, low: int, high: int, sigma: float) -> FloatArray:
    """(B, high - low) part of each unit Gaussian's light that falls into each pixel."""
    edges = np.arange(low, high + 1) - 0.5
    return np.diff(ndtr((edges - centre_px[:, None]) / sigma), axis=1)
