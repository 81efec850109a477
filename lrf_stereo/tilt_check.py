"""Do the spots agree with the tilt angles that were measured? One more solve in which the angles are as good as free.

Angles that are trusted bend the scanner's axis when they are wrong, and chi-square over all residuals hardly moves.
What the spots alone say of each angle is the sharper question.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from lrf_stereo.held_cameras import CameraSpread
from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.loose_solve import solve_loosely
from lrf_stereo.lrf_block import TILTS
from lrf_stereo.refine import LrfRefined
from lrf_stereo.samples import TiltSettings
from lrf_stereo.scanner_part import TiltPart
from network_calib.observations import FloatArray, IntArray

# As good as free, and still determined where the spots say nothing.
LOOSE_RAD = float(np.radians(5.0))


@dataclass(frozen=True, slots=True)
class TiltCheck:
    """One scanner's tilt angles by the spots, less the measured ones; against its first setting.

    Attributes:
        setting: (n,) settings.
        difference_rad: (n,).
        sigma_rad: (n,) of the difference, the measured angles' own included.
        chi2: of all differences together.
    """

    setting: IntArray
    difference_rad: FloatArray
    sigma_rad: FloatArray
    chi2: float

    def is_surprising(self, sigma: float) -> bool:
        """Whether chance gives as much less often than `sigma` of one dimension is exceeded."""
        return bool(chi2.sf(self.chi2, len(self.setting)) < chi2.sf(sigma**2, 1))


def check_tilts(
    refined: LrfRefined, network: NetworkData, data: LrfData, *, held: CameraSpread | None = None
) -> tuple[TiltCheck, ...]:
    """Compare measured tilt angles with those that the used sightings ask for, for each scanner.

    Args:
        refined: the optimum.
        network: the camera side.
        data: the LRF side.
        held: what held cameras may be wrong by; None where they are exact, or solved along.

    Returns:
        One check for each scanner; none at all where the spots do not determine the angles.
    """
    settings = data.settings
    angles = TiltSettings(settings.scanner, settings.angle_rad, LOOSE_RAD**2 * np.eye(len(settings.angle_rad)))
    loose = replace(data, settings=angles)
    solved = solve_loosely(refined, network, loose, held)
    if solved is None:
        return ()
    state, joint = solved
    tilts = state.parts[TILTS]
    assert isinstance(tilts, TiltPart)
    spread = joint[-tilts.size :, -tilts.size :]
    return tuple(_check(settings, tilts, spread, scanner) for scanner in range(settings.n_scanners))


def _check(settings: TiltSettings, tilts: TiltPart, spread: FloatArray, scanner: int) -> TiltCheck:
    reference = settings.reference_settings()[scanner]
    own = np.flatnonzero((settings.scanner == scanner) & (tilts.columns >= 0))
    difference = tilts.angle_rad[own] - settings.angle_rad[own]
    against = np.zeros((len(own), len(settings.angle_rad)))
    against[np.arange(len(own)), own] = 1.0
    against[:, reference] -= 1.0
    columns = tilts.columns[own]
    total = spread[np.ix_(columns, columns)] + against @ settings.covariance_rad2 @ against.T
    distance = float(difference @ np.linalg.solve(total, difference)) if len(own) else 0.0
    return TiltCheck(own, difference, np.sqrt(np.diag(total)), distance)
