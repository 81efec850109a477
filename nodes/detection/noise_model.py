"""How far a sample strays from its mean: the variance of a pixel as a function of the light on it."""

from __future__ import annotations

from dataclasses import dataclass

from nodes.detection.spots import FloatArray

QUANTISATION_VARIANCE = 1 / 12  # of rounding to whole counts, counts²
# Measured on a handful of scenes, not derived: it makes the stated errors of spots true within 30 % after H.264 of
# 2 to 8 Mbit/s, and in red that was interpolated from a mosaic (`benchmarks/spot_profile.py`).
PROCESSED_CORRELATION_PX2 = 4.0


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of one channel, in counts of the image it describes.

    Attributes:
        read_variance: counts² of a sample that the spot does not light: the sensor's read noise and the photon noise of
            the background, without rounding; one number, or (h, w) as the learner of the background measured it.
        gain: counts² of variance that each count of the spot's own light adds: counts per photo-electron. None where
            nobody knows: then the spot's own residuals tell it.
        correlation_px2: area over which samples err together, the sum of the correlations of a sample with all others:
            1 where each errs alone, as in raw pictures. A fit cannot tell it: what neighbours have in common looks like
            a spot elsewhere. PROCESSED_CORRELATION_PX2 holds after a codec or a demosaicing.
    """

    read_variance: float | FloatArray
    gain: float | None = None
    correlation_px2: float = 1.0

    @property
    def background_variance(self) -> float | FloatArray:
        """Of a sample that the spot does not light, rounding included, counts²."""
        return self.read_variance + QUANTISATION_VARIANCE
