"""Prior knowledge in the joint solve: measured tilt differences, what an instrument can be wrong by, the baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lrf_stereo.lrf_block import SCANNERS, TILTS
from lrf_stereo.samples import TiltSettings
from lrf_stereo.scanner_part import N_GEOMETRY, ScannerPart, TiltPart
from network_calib.blocks import Parts
from network_calib.camera_block import cameras_of
from network_calib.errors import InputError
from network_calib.observations import FloatArray, IntArray

# Tilt gain, range bias, range scale, bearing zero, clock offset of a perfect instrument.
NOMINAL = np.array([1.0, 0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class InstrumentSigma:
    """What an instrument may be wrong by; zero holds a number at its nominal value.

    Attributes:
        tilt_gain: relative; the tilt unit's gear ratio is exact, an integrated gyroscope's scale is not.
        range_bias_m: a phase-shift scanner's systematic error, some millimetres to a centimetre.
        range_scale: relative; observable only against a metric baseline.
        bearing_zero_rad: of the scan's front step; barely observable beside the mount.
        clock_offset_s: of the scanner's stamps against the cameras'; observable where the spot moves, in several
            directions and with a known velocity.
    """

    tilt_gain: float = 0.0
    range_bias_m: float = 0.0
    range_scale: float = 0.0
    bearing_zero_rad: float = 0.0
    clock_offset_s: float = 0.0

    def as_array(self) -> FloatArray:
        """(5,) in the order of the scanner's tangent."""
        return np.array(
            [self.tilt_gain, self.range_bias_m, self.range_scale, self.bearing_zero_rad, self.clock_offset_s]
        )


# What scanners may be wrong by: one for all of them, or one for each.
Instruments = InstrumentSigma | tuple[InstrumentSigma, ...]


def each_instrument(instruments: Instruments | None, n_scanners: int) -> tuple[InstrumentSigma, ...]:
    """One for each scanner; what is given as one holds for all, and nothing given for exact instruments.

    Raises:
        InputError: another number of them than of scanners.
    """
    if instruments is None or isinstance(instruments, InstrumentSigma):
        return (instruments or InstrumentSigma(),) * n_scanners
    if len(instruments) != n_scanners:
        raise InputError(f"what instruments may be wrong by is given for {len(instruments)} of {n_scanners} LRFs")
    return instruments


@dataclass(frozen=True, slots=True)
class TiltPrior:
    """Measured differences of tilt angles against each scanner's reference setting, whitened by their covariance.

    Attributes:
        setting: (n,) settings that are free.
        measured_rad: (n,) measured angle.
        whitening: (n, n) inverse Cholesky factor of the covariance of the differences.
        columns: (n, n) global columns: every whitened row touches all angles.
    """

    setting: IntArray
    measured_rad: FloatArray
    whitening: FloatArray
    columns: IntArray

    @classmethod
    def of(cls, settings: TiltSettings, free: IntArray, columns: IntArray) -> TiltPrior:
        """From settings; `free` (n,) are those that may move, `columns` (n,) their global columns."""
        reference = settings.reference_settings()[settings.scanner[free]]
        difference = np.zeros((len(free), len(settings.angle_rad)))
        difference[np.arange(len(free)), free] += 1.0
        difference[np.arange(len(free)), reference] -= 1.0
        spread = difference @ settings.covariance_rad2 @ difference.T
        whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(spread)), dtype=np.float64)
        return cls(free, settings.angle_rad[free], whitening, np.tile(columns, (len(free), 1)))

    def linearise(self, parts: Parts) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (n,) and Jacobian (n, n)."""
        tilts = parts[TILTS]
        assert isinstance(tilts, TiltPart)
        return self.whitening @ (tilts.angle_rad[self.setting] - self.measured_rad), self.whitening


@dataclass(frozen=True, slots=True)
class InstrumentPrior:
    """(value - nominal) / sigma of the instrument numbers that are free.

    Attributes:
        scanner: (n,) scanner index.
        entry: (n,) index into the instrument's five numbers.
        nominal: (n,) mean.
        sigma: (n,) standard deviation.
        columns: (n, 1) global columns.
    """

    scanner: IntArray
    entry: IntArray
    nominal: FloatArray
    sigma: FloatArray
    columns: IntArray

    @classmethod
    def of(cls, part: ScannerPart, sigma: Sequence[InstrumentSigma], first_column: int) -> InstrumentPrior:
        """For every free instrument number of every scanner; `sigma` has one for each."""
        own = part.columns[:, N_GEOMETRY:]
        scanner, entry = np.nonzero(own >= 0)
        columns = own[scanner, entry] + first_column
        sigmas = np.stack([one.as_array() for one in sigma])
        return cls(scanner, entry, NOMINAL[entry], sigmas[scanner, entry], columns[:, None])

    def linearise(self, parts: Parts) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (n,) and Jacobian (n, 1)."""
        scanners = parts[SCANNERS]
        assert isinstance(scanners, ScannerPart)
        value = scanners.instrument[self.scanner, self.entry]
        return (value - self.nominal) / self.sigma, (1 / self.sigma)[:, None]


@dataclass(frozen=True, slots=True)
class DistancePrior:
    """A measured distance between two camera centres: the metric scale when LRF ranges speak too.

    Attributes:
        camera_a: index.
        camera_b: index.
        distance_m: as measured.
        sigma_m: its standard deviation.
        columns: (1, 6) global columns of both centres.
    """

    camera_a: int
    camera_b: int
    distance_m: float
    sigma_m: float
    columns: IntArray

    def linearise(self, parts: Parts) -> tuple[FloatArray, FloatArray]:
        """Whitened residual (1,) and Jacobian (1, 6)."""
        centres = cameras_of(parts).centres
        offset = centres[self.camera_b] - centres[self.camera_a]
        distance = float(np.linalg.norm(offset))
        direction = offset / distance
        residual = np.array([(distance - self.distance_m) / self.sigma_m])
        return residual, np.concatenate([-direction, direction])[None] / self.sigma_m
