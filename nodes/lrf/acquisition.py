"""The paper's acquisition, section IV, as a state machine: what an LRF node does at one tilt after the other.

    MOVING      the tilt unit goes to the next angle, or somebody tilts the LRF by hand
    RESTING     the platform comes to rest; the IMU learns its bias
    BACKGROUND  scans without the spot are learnt
    COLLECTING  the spot is raised and lowered through the scan plane until there are enough crossings
    DONE

It knows no device, no clock and no bus: scans and commands go in and out, time is that of the scans.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from lrf_stereo.crossing import Crossings, crossings
from lrf_stereo.scan_spot import Background, SpotCandidates, find_spots, ranges_m
from lrf_stereo.scanner import ScanSteps
from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray

# Crossings are looked for anew after so many scans.
SCANS_BETWEEN_LOOKS = 10
# Less is not told apart from the ball itself.
EDGE_M = 0.1


class Phase(StrEnum):
    """Where the acquisition stands."""

    MOVING = "moving"
    RESTING = "resting"
    BACKGROUND = "background"
    COLLECTING = "collecting"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class AcquisitionOptions:
    """What to acquire.

    Attributes:
        tilts_rad: tilt angles, one after the other.
        n_crossings: two-sided crossings at every tilt, at least; the paper's N.
        sigma_m: and so many more that the scan plane is known to this, anywhere in reach of the crossings; see
            `plane_sigma_m`.
        max_crossings: enough, whatever the sigma.
        rest_s: time at rest before the background is learnt.
        n_background: scans of the empty room.
        ball_diameter_m: of the spot.
    """

    tilts_rad: tuple[float, ...]
    n_crossings: int = 6
    sigma_m: float = 0.004
    max_crossings: int = 60
    rest_s: float = 3.0
    n_background: int = 20
    ball_diameter_m: float = 0.04

    def __post_init__(self) -> None:
        if not self.tilts_rad:
            raise InputError("an acquisition needs tilt angles")
        if not 1 <= self.n_crossings <= self.max_crossings:
            raise InputError(f"{self.n_crossings} crossings a tilt of at most {self.max_crossings}, expected 1 or more")


@dataclass(frozen=True, slots=True)
class SettingData:
    """What was acquired at one tilt.

    Attributes:
        crossings: of the spot, all two-sided.
        rest_begin_s: when the platform had come to rest.
        rest_end_s: until when it surely rested.
    """

    crossings: Crossings
    rest_begin_s: float
    rest_end_s: float


@dataclass(frozen=True, slots=True)
class Progress:
    """For the person in the room.

    Attributes:
        phase: what happens now.
        setting: number of the tilt, from 0.
        n_settings: how many there are.
        n_crossings: two-sided crossings so far at this tilt.
        sigma_m: how well they hold the scan plane; infinite before the third.
        message: what to do.
    """

    phase: Phase
    setting: int
    n_settings: int
    n_crossings: int
    sigma_m: float
    message: str


@dataclass(slots=True)
class _Setting:
    """What is being collected at one tilt."""

    rest_begin_s: float
    empty: list[FloatArray] = field(default_factory=list)
    background: Background | None = None
    candidates: list[SpotCandidates] = field(default_factory=list)
    collecting_stamps: list[float] = field(default_factory=list)
    found: Crossings | None = None


class Acquisition:
    """The state machine.

    Args:
        options: what to acquire.
        steps: of the scanner.
    """

    def __init__(self, options: AcquisitionOptions, *, steps: ScanSteps) -> None:
        self._options, self._steps = options, steps
        self._setting: _Setting | None = None
        self._done: list[SettingData] = []

    @property
    def phase(self) -> Phase:
        """Where it stands."""
        if len(self._done) == len(self._options.tilts_rad):
            return Phase.DONE
        setting = self._setting
        if setting is None:
            return Phase.MOVING
        if setting.background is not None:
            return Phase.COLLECTING
        return Phase.BACKGROUND if setting.empty else Phase.RESTING

    @property
    def next_tilt_rad(self) -> float:
        """Where to move while MOVING."""
        return self._options.tilts_rad[len(self._done)]

    @property
    def settings(self) -> tuple[SettingData, ...]:
        """What was acquired so far, by tilt."""
        return tuple(self._done)

    def moved(self, now_s: float) -> None:
        """The platform has arrived at `next_tilt_rad`."""
        self._setting = _Setting(rest_begin_s=now_s)

    def left_rest(self, left_s: float) -> None:
        """The platform stood still at its last tilt for longer than crossings were looked for: until then."""
        if self._done:
            last = self._done[-1]
            self._done[-1] = replace(last, rest_end_s=max(last.rest_end_s, left_s))

    def begin_anew(self) -> None:
        """The platform does not stand where it stood: what was acquired at this tilt is of two, and is dropped."""
        self._setting = None

    def scan(self, stamp_s: float, readings_mm: IntArray) -> None:
        """A scan: its stamp at step 0, and its readings (B,). While nothing rests, scans pass unheeded."""
        setting = self._setting
        if setting is None or stamp_s < setting.rest_begin_s + self._options.rest_s:
            return
        range_m = ranges_m(readings_mm, steps=self._steps)
        if setting.background is None:
            setting.empty.append(range_m)
            if len(setting.empty) >= self._options.n_background:
                setting.background = Background.learn(np.stack(setting.empty))
            return
        found = find_spots(
            range_m[None], setting.background, steps=self._steps, ball_diameter_m=self._options.ball_diameter_m
        )
        setting.candidates.append(found.select(~_is_edge(found)))
        setting.collecting_stamps.append(stamp_s)
        if len(setting.collecting_stamps) % SCANS_BETWEEN_LOOKS == 0:
            self._look(setting)

    def finish_setting(self, now_s: float) -> None:
        """Take what there is at this tilt as enough, such as when the operator says so.

        Raises:
            InputError: nothing is being collected.
        """
        if self.phase is not Phase.COLLECTING or self._setting is None:
            raise InputError(f"nothing to finish while {self.phase}")
        self._look(self._setting)
        if self._setting is not None:
            self._end(self._setting, now_s)

    def progress(self) -> Progress:
        """For the person in the room."""
        phase, setting, options = self.phase, self._setting, self._options
        number = min(len(self._done), len(options.tilts_rad) - 1)
        n = 0 if setting is None or setting.found is None else len(setting.found)
        sigma_m = np.inf if n == 0 or setting is None or setting.found is None else plane_sigma_m(setting.found)
        tilt_deg = np.degrees(options.tilts_rad[number])
        messages = {
            Phase.MOVING: f"tilting to {tilt_deg:.1f} deg: stay out of the scan plane",
            Phase.RESTING: "resting: stay out of the scan plane",
            Phase.BACKGROUND: "learning the empty room: stay out of the scan plane",
            Phase.COLLECTING: f"raise and lower the spot through the scan plane, here and there: {n} of "
            f"{options.n_crossings} crossings",
            Phase.DONE: "done",
        }
        return Progress(phase, number, len(options.tilts_rad), n, float(sigma_m), messages[phase])

    def _look(self, setting: _Setting) -> None:
        found = crossings(
            _joined(setting.candidates),
            np.array(setting.collecting_stamps),
            steps=self._steps,
            ball_diameter_m=self._options.ball_diameter_m,
            is_held_from_below=True,
        )
        found = found.select(found.pair >= 0)
        setting.found = found.select(_is_short(found))
        n, options = len(setting.found), self._options
        is_enough = n >= options.n_crossings and plane_sigma_m(setting.found) <= options.sigma_m
        if is_enough or n >= options.max_crossings:
            self._end(setting, setting.collecting_stamps[-1])

    def _end(self, setting: _Setting, now_s: float) -> None:
        assert setting.found is not None
        self._done.append(SettingData(setting.found, setting.rest_begin_s, now_s))
        self._setting = None


def plane_sigma_m(found: Crossings) -> float:
    """How well crossings alone hold the scanner to points that are known: the worst of their own places.

    The covariance of a pose that is fitted to points at (range, bearing, height 0) with the crossings' sigmas; then the
    standard deviation of where that pose puts each of the points. Infinite for fewer than three crossings, or all on a
    line with the scanner.
    """
    range_m, bearing, n = found.range_m, found.bearing_rad, len(found)
    if n < 3:
        return float("inf")
    radial = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(n)], axis=1)
    tangential = np.stack([-radial[:, 1], radial[:, 0], radial[:, 2]], axis=1)
    normal = np.tile([0.0, 0.0, 1.0], (n, 1))
    points = range_m[:, None] * radial
    axes = np.stack([radial, tangential, normal], axis=1)
    sigma = np.stack([found.sigma_range_m, range_m * found.sigma_bearing_rad, found.sigma_out_of_plane_m], axis=1)
    # A point moves by dt + dw x p; along a unit axis a that is a . dt + (p x a) . dw.
    jacobian = np.concatenate([axes, np.cross(points[:, None], axes)], axis=2)
    white = (jacobian / sigma[..., None]).reshape(-1, 6)
    information = white.T @ white
    if np.linalg.cond(information) > 1e12:
        return float("inf")
    covariance = np.linalg.inv(information)
    spread = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return float(np.sqrt(np.linalg.eigvalsh(spread)[:, -1].max()))


def _is_edge(found: SpotCandidates) -> BoolArray:
    """(K,) candidates of one scan that lie right beside a nearer one: beams that its edge cuts in two.

    Such a beam reads something between the ball and what is behind it, and does so before the ball is hit in full and
    after it: it would take the ball's place as what comes first and leaves last.
    """
    first, end = found.first_beam, found.first_beam + found.n_hits
    # A beam between the two may have given no range.
    is_beside = (first[:, None] <= end + 1) & (first <= end[:, None] + 1)
    is_farther = found.range_m[:, None] > found.range_m + EDGE_M
    return np.asarray((is_beside & is_farther).any(axis=1))


def _is_short(found: Crossings) -> BoolArray:
    """(R,) runs whose pair does not last twice as long as most.

    A longer one is the spot together with what holds it: its middle is not where the spot crossed the plane.
    """
    too_long = found.pair[found.n_scans > 2 * np.median(found.n_scans)] if len(found) else found.pair
    return ~np.isin(found.pair, too_long)


def _joined(parts: list[SpotCandidates]) -> SpotCandidates:
    """Candidates of single scans, one after the other, as those of a series."""
    scan = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in SpotCandidates.__slots__
        if name != "scan"
    }
    return SpotCandidates(scan=scan, **columns)
