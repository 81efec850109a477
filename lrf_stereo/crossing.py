"""The spot raised and lowered through the scan plane: where and when its centre was in the plane.

Triggering at the first hit, as the paper does, measures a ball whose centre is a radius and half a beam off the plane,
always on the same side; no residual can show that. Here a crossing is a run of scans that hit, from the first to the
last, and its middle is where the centre was in the plane, whichever way the ball went.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lrf_stereo.scan_spot import BALL_DIAMETER_M, BEAM_EDGE_RAD, SURFACE_VARIANCE, SpotCandidates
from lrf_stereo.scanner import ScanSteps
from network_calib.errors import InputError
from network_calib.observations import BoolArray, FloatArray, IntArray

# Half of an URG's beam, 10 mrad in all: how far from the plane the beam still touches a ball.
HALF_BEAM_RAD = 5e-3
# A hand slows down or speeds up by about this part while the ball passes; the middle then is a quarter of it, in
# diameters, off the plane.
SPEED_CHANGE = 0.2
MAX_SPEED_M_S = 1.0
MAX_MISSED_SCANS = 1
# Between the last scan without the ball and the first with it lies one turn, unless scans were lost.
MAX_TURNS = 1.5
# What holds the ball follows it into the plane within so long.
LONELY_S = 0.5


@dataclass(frozen=True, slots=True)
class Crossings:
    """R runs of hits, by their begin.

    Attributes:
        time_s: (R,) when the spot's centre was in the plane; of a one-sided run the first hit, as in the paper.
        begin_s: (R,) when the run began, half a scan before its first hit.
        end_s: (R,) when it ended.
        n_scans: (R,) scans that hit.
        range_m: (R,) range of the centre.
        bearing_rad: (R,) bearing of the centre.
        sigma_range_m: (R,) standard deviations, here and below.
        sigma_bearing_rad: (R,).
        sigma_out_of_plane_m: (R,) of the centre's height over the plane at `time_s`.
        bias_bound_m: (R,) zero for a two-sided run; otherwise how far the centre may have been from the plane, always
            on the side it came from.
        direction: (R,) +1 upward through the plane, -1 downward, 0 unknown.
        pair: (R,) number of the rising and falling pair that the run belongs to, -1 for none. An error of the clock
            moves the two to opposite sides, and their mean not at all.
        score: (R,) mean score of the candidates.
    """

    time_s: FloatArray
    begin_s: FloatArray
    end_s: FloatArray
    n_scans: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    sigma_range_m: FloatArray
    sigma_bearing_rad: FloatArray
    sigma_out_of_plane_m: FloatArray
    bias_bound_m: FloatArray
    direction: IntArray
    pair: IntArray
    score: FloatArray

    def __len__(self) -> int:
        return len(self.time_s)

    def select(self, is_kept: BoolArray) -> Crossings:
        """The runs where `is_kept` (R,) holds."""
        return replace(self, **{name: getattr(self, name)[is_kept] for name in self.__slots__})

    @property
    def is_two_sided(self) -> BoolArray:
        """(R,) whether the ball is known to have passed the plane."""
        return np.asarray(self.bias_bound_m == 0)


def crossings(
    candidates: SpotCandidates,
    stamp_s: FloatArray,
    *,
    steps: ScanSteps,
    upward: FloatArray | None = None,
    ball_diameter_m: float = BALL_DIAMETER_M,
    max_pair_gap_s: float = 5.0,
    max_pair_distance_m: float = 0.15,
    is_held_from_below: bool = False,
) -> Crossings:
    """Runs of hits in a series of scans, and what each says of the spot's position.

    A run counts as two-sided when scans without a hit lie on both sides of it and the ball is known to have passed:
    either the cameras saw it go on (`upward`), or a second run at the same place shows that it came back. Anything else
    is reported as one-sided, with the bound of its bias.

    Args:
        candidates: of T scans.
        stamp_s: (T,) times of step 0 of the scans, growing.
        steps: of the scanner; a beam's own time within the scan counts.
        upward: (T,) any number that grows as the spot rises, such as minus its row in a camera; NaN where unknown.
        ball_diameter_m: of the spot.
        max_pair_gap_s: longest time from a rising to a falling run.
        max_pair_distance_m: how far apart in the plane they may be.
        is_held_from_below: the ball is the top of what is held: it enters the plane before the rod, hand and arm below
            it, and leaves it after them. Only runs that come first may then be rising ones, only runs that come last
            falling ones, and runs of a single scan neither.

    Raises:
        InputError: a candidate's scan has no stamp, or stamps do not grow.
    """
    if len(candidates) and candidates.scan.max() >= len(stamp_s):
        raise InputError(f"candidates of scan {candidates.scan.max()}, but only {len(stamp_s)} stamps")
    if (np.diff(stamp_s) <= 0).any():
        raise InputError("stamps of scans must grow")
    runs = [_Run.of(candidates, rows, stamp_s, steps, upward) for rows in _linked(candidates, stamp_s)]
    may_rise, may_fall = _ends(runs) if is_held_from_below else (np.ones(len(runs), dtype=bool),) * 2
    pair, direction = _pairs(
        runs, may_rise, may_fall, max_pair_gap_s, max_pair_distance_m, is_direction_known=upward is not None
    )
    is_passed = np.array([run.is_closed and d != 0 for run, d in zip(runs, direction, strict=True)], dtype=bool)
    n_scans = np.array([run.n_scans for run in runs], dtype=np.int64)
    middle = np.array([(run.begin_s + run.end_s) / 2 for run in runs])
    range_m = np.array([run.range_m for run in runs])
    bound = ball_diameter_m / 2 + HALF_BEAM_RAD * range_m
    return Crossings(
        time_s=np.where(is_passed, middle, np.array([run.first_s for run in runs])),
        begin_s=np.array([run.begin_s for run in runs]),
        end_s=np.array([run.end_s for run in runs]),
        n_scans=n_scans,
        range_m=range_m,
        bearing_rad=np.array([run.bearing_rad for run in runs]),
        sigma_range_m=np.array([run.sigma_range_m(ball_diameter_m) for run in runs]),
        sigma_bearing_rad=np.array([run.sigma_bearing_rad for run in runs]),
        sigma_out_of_plane_m=np.where(
            is_passed, _sigma_of_middle(n_scans, range_m, ball_diameter_m), bound / np.sqrt(3)
        ),
        bias_bound_m=np.where(is_passed, 0.0, bound),
        direction=direction,
        pair=pair,
        score=np.array([run.score for run in runs]),
    )


def _sigma_of_middle(n_scans: IntArray, range_m: FloatArray, diameter_m: float) -> FloatArray:
    """(R,) standard deviation of the height at the middle of a run of n scans.

    Each end is known to within one scan, uniformly, so the middle has a standard deviation of 1/sqrt(24) scans; n scans
    span the height in which the beam sees the ball. A change of speed adds its own.
    """
    height = diameter_m + 2 * BEAM_EDGE_RAD * range_m
    return np.hypot(height / np.maximum(n_scans, 1) / np.sqrt(24), SPEED_CHANGE * height / 4)


@dataclass(frozen=True, slots=True)
class _Run:
    """Hits in consecutive scans at one place; `rise` is how far `upward` went on, over how far it went at all."""

    begin_s: float
    end_s: float
    first_s: float
    n_scans: int
    is_closed: bool
    range_m: float
    bearing_rad: float
    sigma_beams_m: float
    sigma_bearing_rad: float
    score: float
    rise: float

    @classmethod
    def of(
        cls,
        candidates: SpotCandidates,
        rows: IntArray,
        stamp_s: FloatArray,
        steps: ScanSteps,
        upward: FloatArray | None,
    ) -> _Run:
        hits = candidates.select(rows)
        delay = float(np.mean(steps.time_s(steps.step(hits.bearing_rad))))
        first, last = int(hits.scan[0]), int(hits.scan[-1])
        before, after = max(first - 1, 0), min(last + 1, len(stamp_s) - 1)
        rise = 0.0
        if upward is not None:
            way = upward[before : after + 1]
            way = way[np.isfinite(way)]
            travel = float(np.abs(np.diff(way)).sum())
            rise = float(way[-1] - way[0]) / travel if travel > 0 else 0.0
        # Scans that were lost at an end leave it open when that was.
        gaps_s = max(float(stamp_s[first] - stamp_s[before]), float(stamp_s[after] - stamp_s[last]))
        n = len(rows)
        return cls(
            begin_s=float(stamp_s[before] + stamp_s[first]) / 2 + delay,
            end_s=float(stamp_s[last] + stamp_s[after]) / 2 + delay,
            first_s=float(stamp_s[first]) + delay,
            n_scans=last - first + 1,
            is_closed=before < first and after > last and gaps_s <= MAX_TURNS * steps.turn_s,
            range_m=float(np.median(hits.range_m)),
            bearing_rad=float(np.median(hits.bearing_rad)),
            sigma_beams_m=float(np.sqrt((hits.sigma_range_m**2).sum()) / n),
            # The grid of steps stays while the ball passes: its error is shared, and n scans tell little more than two.
            sigma_bearing_rad=float(np.sqrt((hits.sigma_bearing_rad**2).mean() / min(n, 2))),
            score=float(hits.score.mean()),
            rise=rise,
        )

    def sigma_range_m(self, diameter_m: float) -> float:
        """Noise of the beams and of the surface they meet; the surface is not known better than one height shows it."""
        return float(np.hypot(self.sigma_beams_m, np.sqrt(SURFACE_VARIANCE) * diameter_m / 2))

    def distance_to(self, other: _Run) -> float:
        """Distance in the scan plane, m."""
        turn = self.bearing_rad - other.bearing_rad
        across_m = 2 * np.sqrt(self.range_m * other.range_m) * np.sin(turn / 2)
        return float(np.hypot(self.range_m - other.range_m, across_m))


def _linked(candidates: SpotCandidates, stamp_s: FloatArray) -> list[IntArray]:
    """Candidates that are one body in consecutive scans, as rows; the nearest first, each once, sorted by begin."""
    x = candidates.range_m * np.cos(candidates.bearing_rad)
    y = candidates.range_m * np.sin(candidates.bearing_rad)
    done: list[list[int]] = []
    open_runs: list[list[int]] = []
    for scan in np.unique(candidates.scan):
        is_lost = [scan - candidates.scan[run[-1]] > MAX_MISSED_SCANS + 1 for run in open_runs]
        done += [run for run, lost in zip(open_runs, is_lost, strict=True) if lost]
        open_runs = [run for run, lost in zip(open_runs, is_lost, strict=True) if not lost]
        rows = np.flatnonzero(candidates.scan == scan)
        ways = [
            (float(np.hypot(x[row] - x[run[-1]], y[row] - y[run[-1]])), int(row), k)
            for row in rows
            for k, run in enumerate(open_runs)
        ]
        used_rows, used_runs = set(), set()
        for distance, row, k in sorted(ways):
            last = open_runs[k][-1]
            elapsed = float(stamp_s[scan] - stamp_s[candidates.scan[last]])
            gate = MAX_SPEED_M_S * elapsed + 3 * float(candidates.sigma_range_m[row] + candidates.sigma_range_m[last])
            if row in used_rows or k in used_runs or distance > gate:
                continue
            open_runs[k].append(row)
            used_rows.add(row)
            used_runs.add(k)
        open_runs += [[int(row)] for row in rows if int(row) not in used_rows]
    return [np.array(run) for run in sorted(done + open_runs, key=lambda run: (candidates.scan[run[0]], run[0]))]


def _ends(runs: list[_Run]) -> tuple[BoolArray, BoolArray]:
    """(R,) which runs of several scans have none shortly before them, and which none shortly after."""
    begin = np.array([run.begin_s for run in runs])
    end = np.array([run.end_s for run in runs])
    is_long = np.array([run.n_scans > 1 for run in runs], dtype=bool)
    reaches = is_long[:, None] & is_long & ~np.eye(len(runs), dtype=bool)
    # Rows: the run in question; columns: one that is in the plane just before it begins, or just after it ends.
    is_before = reaches & (begin < begin[:, None]) & (end > begin[:, None] - LONELY_S)
    is_after = reaches & (end > end[:, None]) & (begin < end[:, None] + LONELY_S)
    return is_long & ~is_before.any(axis=1), is_long & ~is_after.any(axis=1)


def _pairs(
    runs: list[_Run],
    may_rise: BoolArray,
    may_fall: BoolArray,
    max_gap_s: float,
    max_distance_m: float,
    *,
    is_direction_known: bool,
) -> tuple[IntArray, IntArray]:
    """(R,) pair numbers, and (R,) directions: +1 up, -1 down, 0 unknown.

    With a known direction a run has one when the spot went on for at least half of its way; without, the first of two
    runs at one place counts as rising and the second as falling.
    """
    direction = np.array([int(np.sign(run.rise)) if abs(run.rise) >= 0.5 else 0 for run in runs], dtype=np.int64)
    pair = np.full(len(runs), -1)
    n_pairs = 0
    for i, rising in enumerate(runs):
        if pair[i] >= 0 or not (rising.is_closed and may_rise[i]) or (is_direction_known and direction[i] != 1):
            continue
        for j in range(i + 1, len(runs)):
            falling = runs[j]
            is_back = direction[j] == -1 if is_direction_known else True
            is_later = 0 < falling.begin_s - rising.end_s <= max_gap_s
            if (
                pair[j] < 0
                and may_fall[j]
                and is_back
                and is_later
                and falling.is_closed
                and rising.distance_to(falling) < max_distance_m
            ):
                pair[[i, j]] = n_pairs
                direction[i], direction[j] = 1, -1
                n_pairs += 1
                break
    return pair, direction
