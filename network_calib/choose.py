"""Which of several candidates is the spot: the geometry of the cameras decides, where it can.

A reflection may outshine the spot in one camera, but lies off the epipolar lines of the others. So: take the
best-scored of every camera and frame, find the pairwise epipolar geometry of these robustly, choose again by agreement
with the other cameras, the score being no more than a prior (`agreement.py`), and once more with the better geometry.
Where no other camera tells, a candidate that continues the camera's own track is preferred, weakly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from network_calib.agreement import MAX_ENTRIES, Evidence, Rays, believe, pair_scales, prior
from network_calib.candidates import Candidates
from network_calib.observations import BoolArray, FloatArray, IntArray, Observations
from network_calib.pairs import verify_pairs
from network_calib.start import StartProblem

# Which of several candidates is the spot is part of reading a recording: the same choice whatever is asked later.
CHOICE_SEED = 0
# As wide as the start of a calibration judges; an unknown lens bends honest spots by so much.
TOLERANCE_PX = 4.0
N_PASSES = 2
# Evidence of about one agreeing view; then the choice was the geometry's.
DECIDED = 2.0
# A track is extended over so many frames, and a hand moves by about this part of the image from one to the next.
MAX_TRACK_GAP = 5
STEP_SHARE = 0.02
# A track says little: it may follow the wrong light, and hands turn.
TRACK_STRAY_SHARE = 0.2


@dataclass(frozen=True, slots=True)
class Chosen:
    """One candidate of each camera and frame, or none.

    Attributes:
        observations: the chosen rows.
        is_chosen: (K,) which rows of the candidates these are.
        n_several: of how many cameras' frames there were several candidates.
        n_preferred: in how many of these another than the best-scored was taken.
        n_refused: in how many of these none was taken.
    """

    observations: Observations
    is_chosen: BoolArray
    n_several: int
    n_preferred: int
    n_refused: int

    def notes(self, name: str) -> tuple[str, ...]:
        """What to tell of the choice among the candidates of a recording, if there was one."""
        if not self.n_several:
            return ()
        told = (
            f"{name}: of {self.n_several} pictures with several candidates, the other cameras preferred another than "
            f"the best-scored in {self.n_preferred} and refused all in {self.n_refused}"
        )
        return (told,)


def choose(
    candidates: Candidates, *, rng: np.random.Generator, size_px: Mapping[str, tuple[int, int]] | None = None
) -> Chosen:
    """Choose one candidate of each camera and frame.

    Where a camera has one candidate it is kept, whatever the others say: to reject outliers is for the calibration.

    Args:
        candidates: K rows.
        rng: draws the subsamples of the robust search; the same generator state gives the same choice.
        size_px: width and height by camera name; of cameras that are not named the extent of their candidates serves.
    """
    is_best = candidates.is_best
    n_rivals = np.bincount(candidates.group)
    is_contested = n_rivals > 1
    n_several = int(is_contested.sum())
    if not n_several:
        return Chosen(candidates.observations(is_best), is_best, 0, 0, 0)
    rays = _rays(candidates, size_px or {})
    is_chosen = is_best
    for _ in range(N_PASSES):
        log_odds = prior(candidates) + _evidence(candidates, rays, is_chosen, rng)
        is_chosen = _winners(candidates, log_odds, n_rivals)
    n_kept = np.bincount(candidates.group, weights=is_chosen)
    n_refused = int((n_kept == 0).sum())
    n_preferred = int((is_contested[candidates.group] & is_chosen & ~is_best).sum())
    return Chosen(candidates.observations(is_chosen), is_chosen, n_several, n_preferred, n_refused)


def _evidence(candidates: Candidates, rays: Rays, is_chosen: BoolArray, rng: np.random.Generator) -> FloatArray:
    """(K,) what the other cameras, or else the track, say for each candidate, given the choice for the moment."""
    shared = _shared_rows(candidates, is_chosen)
    graph = verify_pairs(_problem(candidates, rays, shared), rng=rng)
    odds, support = prior(candidates), np.zeros(len(candidates))
    if graph.pairs:
        scale = pair_scales(candidates, rays, graph, np.flatnonzero(is_chosen))
        for rows in _batches(candidates):
            part = _rows_of(candidates, rows)
            local = Rays(rays.xy[rows], rays.pixel[rows], rays.reach)
            evidence = Evidence.of(part, local, graph, np.arange(len(part)), scale)
            support[rows] = believe(part, evidence, odds[rows])
    return support + _track(candidates, rays, support, shared[graph.is_inlier])


def _winners(candidates: Candidates, log_odds: FloatArray, n_rivals: IntArray) -> BoolArray:
    """(K,) the first of the largest log-odds in each group; of several that are all less likely than "none", none."""
    group = candidates.group
    order = np.lexsort((np.arange(len(group)), -log_odds, group))
    winner = order[np.concatenate([[True], np.diff(group[order]) != 0])]
    is_winner = np.zeros(len(group), dtype=bool)
    is_winner[winner[(log_odds[winner] > 0) | (n_rivals == 1)]] = True
    return is_winner


def _rays(candidates: Candidates, size_px: Mapping[str, tuple[int, int]]) -> Rays:
    """Rays of nominal cameras: focal length the longer image side, principal point its centre."""
    low, high = np.zeros((candidates.n_cameras, 2)), np.ones((candidates.n_cameras, 2))
    for c, name in enumerate(candidates.camera_names):
        px = candidates.px[candidates.camera == c]
        if name in size_px:
            high[c] = np.array(size_px[name]) - 1.0
        elif len(px):
            low[c], high[c] = px.min(axis=0), px.max(axis=0)
    focal_px = np.maximum((high - low).max(axis=1) + 1, 2.0)
    centre_px = (low + high) / 2
    camera = candidates.camera
    return Rays((candidates.px - centre_px[camera]) / focal_px[camera, None], 1 / focal_px[camera], focal_px / 2)


def _shared_rows(candidates: Candidates, is_chosen: BoolArray) -> IntArray:
    """The chosen rows of frames with two views or more."""
    _, inverse, n_views = np.unique(candidates.frame[is_chosen], return_inverse=True, return_counts=True)
    return np.flatnonzero(is_chosen)[n_views[inverse] >= 2]


def _problem(candidates: Candidates, rays: Rays, rows: IntArray) -> StartProblem:
    """The rows as spots; no focal length is known."""
    _, point = np.unique(candidates.frame[rows], return_inverse=True)
    n = candidates.n_cameras
    return StartProblem(
        camera=candidates.camera[rows],
        point=point,
        ray_xy=rays.xy[rows],
        tolerance=TOLERANCE_PX / (2 * rays.reach),
        is_focal_known=np.zeros(n, dtype=bool),
        names=candidates.camera_names,
    )


def _batches(candidates: Candidates) -> list[IntArray]:
    """Rows of the frames in which a camera has several candidates, so many at once as memory bears."""
    _, frame, n_rows = np.unique(candidates.frame, return_inverse=True, return_counts=True)
    is_open = np.zeros(len(n_rows), dtype=bool)
    is_open[frame[~candidates.is_best]] = True
    n_entries = np.cumsum(np.where(is_open, n_rows.astype(np.int64) ** 2, 0))
    batch = np.where(is_open, n_entries // MAX_ENTRIES, -1)[frame]
    return [np.flatnonzero(batch == number) for number in np.unique(batch) if number >= 0]


def _rows_of(candidates: Candidates, rows: IntArray) -> Candidates:
    return Candidates(
        candidates.camera_names,
        candidates.camera[rows],
        candidates.frame[rows],
        candidates.px[rows],
        candidates.sigma_px[rows],
        candidates.score[rows],
    )


def _track(candidates: Candidates, rays: Rays, support: FloatArray, agreeing: IntArray) -> FloatArray:
    """(K,) evidence by the camera's own track, where no other camera speaks for any candidate of the group.

    Args:
        candidates: all.
        rays: of them.
        support: (K,) what the other cameras say.
        agreeing: rows that agree with other cameras: the places that the track goes through.
    """
    group, camera = candidates.group, candidates.camera
    best = np.full(int(group[-1]) + 1, -np.inf)
    np.maximum.at(best, group, support)
    is_open = best[group] < DECIDED
    out = np.zeros(len(group))
    for c in range(candidates.n_cameras):
        known, asked = agreeing[camera[agreeing] == c], np.flatnonzero(is_open & (camera == c))
        if not len(known) or not len(asked):
            continue
        predicted_px, gap = _predicted(candidates.frame[known], candidates.px[known], candidates.frame[asked])
        width_px = 2 * float(rays.reach[c])
        sigma_px = STEP_SHARE * width_px * gap
        square = ((candidates.px[asked] - predicted_px) ** 2).sum(axis=1) / sigma_px**2
        gain = (1 - TRACK_STRAY_SHARE) * width_px**2 / (2 * np.pi * sigma_px**2)
        log_ratio = np.log(gain * np.exp(-0.5 * np.minimum(square, 900.0)) + TRACK_STRAY_SHARE)
        out[asked] = np.where(gap <= MAX_TRACK_GAP, log_ratio, 0.0)
    return out


def _predicted(known_frame: IntArray, known_px: FloatArray, frame: IntArray) -> tuple[FloatArray, FloatArray]:
    """Place (n, 2) between the known ones before and after, and the frames (n,) to the nearer of the two."""
    predicted = np.stack([np.interp(frame, known_frame, known_px[:, axis]) for axis in (0, 1)], axis=1)
    after = np.clip(np.searchsorted(known_frame, frame), 0, len(known_frame) - 1)
    before = np.maximum(after - 1, 0)
    gap = np.minimum(np.abs(frame - known_frame[before]), np.abs(known_frame[after] - frame))
    return predicted, np.maximum(gap, 1).astype(np.float64)
