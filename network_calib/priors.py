"""Prior knowledge of lenses as a residual block: given intrinsics, or what every real lens keeps to.

Self-calibration leaves some numbers weakly determined (the principal point above all). A wide prior costs nothing where
the data speak and keeps a plausible lens where they do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from network_calib.blocks import Parts
from network_calib.camera_block import cameras_of
from network_calib.camera_parameters import N_POSE, CameraParameters
from network_calib.observations import FloatArray, IntArray
from network_calib.room_setup import CameraSetup, Knowledge


@dataclass(frozen=True, slots=True)
class LensPrior:
    """(value - expected) / sigma for M optics entries.

    Attributes:
        camera: (M,) camera index.
        entry: (M,) index into the row of optics.
        expected: (M,) mean.
        sigma: (M,) standard deviation.
        columns: (M, 1) global tangent columns.
    """

    camera: IntArray
    entry: IntArray
    expected: FloatArray
    sigma: FloatArray
    columns: IntArray

    def linearise(self, parts: Parts) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (M,) and Jacobian (M, 1)."""
        optics = cameras_of(parts).optics[self.camera, self.entry]
        return (optics - self.expected) / self.sigma, (1 / self.sigma)[:, None]


def lens_prior(setups: Sequence[CameraSetup], parameters: CameraParameters) -> LensPrior:
    """The prior on every free entry of the optics that has one; shared intrinsics are counted once."""
    columns = parameters.columns[:, N_POSE:]
    expected = np.stack([optics_of(setup.nominal_intrinsics()) for setup in setups])
    sigma = np.stack([prior_sigma(setup) for setup in setups])
    camera, entry = np.nonzero((columns >= 0) & np.isfinite(sigma))
    column, first = np.unique(columns[camera, entry], return_index=True)
    camera, entry = camera[first], entry[first]
    return LensPrior(camera, entry, expected[camera, entry], sigma[camera, entry], column[:, None])


def optics_of(intrinsics: FloatArray) -> FloatArray:
    """(8,) focal_px, aspect, centre, distortion of intrinsics (8,) as in `cameras`."""
    optics = intrinsics.copy()
    optics[1] = intrinsics[1] / intrinsics[0]
    return optics


def prior_sigma(setup: CameraSetup) -> FloatArray:
    """(8,) standard deviations over the optics row; infinite where nothing is assumed.

    Unknown cameras: the principal point lies within some 5 % of the longer side of the image centre, and distortion has
    the size that lenses on the market have (a wide-angle board calibration gives k1 = -0.3, k2 = 0.1, p = 0.001).
    Given intrinsics without sigma: focal length 3 %, principal point 2 % of the longer side.
    """
    if setup.intrinsics_sigma is not None:
        sigma = np.asarray(setup.intrinsics_sigma, dtype=np.float64).copy()
        if setup.intrinsics is not None:
            sigma[1] = np.hypot(sigma[0], sigma[1]) / setup.intrinsics[0]
        return sigma
    side = float(max(setup.size_px))
    if setup.knowledge is Knowledge.UNKNOWN or setup.intrinsics is None:
        distortion = [0.1] * 4 if setup.lens.is_fisheye else [0.5, 0.5, 0.005, 0.005]
        return np.array([np.inf, 0.01, 0.05 * side, 0.05 * side, *distortion])
    distortion = [0.05] * 4 if setup.lens.is_fisheye else [0.1, 0.1, 0.003, 0.003]
    return np.array([0.03 * setup.intrinsics[0], 0.01, 0.02 * side, 0.02 * side, *distortion])
