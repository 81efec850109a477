"""Steps 7 and on: the optimum in the world frame with its covariance, hold-out, repeats, and what to doubt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from network_calib import doubts, quality
from network_calib.errors import ConvergenceError, DegenerateError
from network_calib.optimum import Network, Progress, optimise
from network_calib.quality import Holdout, Repeats
from network_calib.refine import Refined, refine
from network_calib.refusals import refuse_unobservable
from network_calib.result import CalibratedCamera, CameraQuality, Doubt, NetworkQuality, WorldFrame
from network_calib.room_setup import Anchor, CameraSetup, Knowledge, Options
from network_calib.spots import SpotViews
from network_calib.sync import estimate_time_offsets
from network_calib.uncertainty import Uncertainty, uncertainty
from network_calib.world import in_world


@dataclass(frozen=True, slots=True)
class Optimum:
    """The joint optimum in its own frame, and what it was found from.

    Attributes:
        setups: what is known of each camera.
        views: the spots of two views or more.
        network: verified pairs, start, and optimum of the start's side of the mirror.
        refined: the optimum that is reported: this or its mirrored twin.
        twin_ratio: the other side's cost over this one's.
    """

    setups: Sequence[CameraSetup]
    views: SpotViews
    network: Network
    refined: Refined
    twin_ratio: float


@dataclass(frozen=True, slots=True)
class Assessed:
    """A calibrated network with everything that its result says.

    Attributes:
        optimum: as found.
        world: the frame that was asked for.
        refined: the optimum in this frame.
        spread: covariances.
        held: errors of what was left out of one extra fit.
        repeats: other seeds.
        warnings: what a person should know.
    """

    optimum: Optimum
    world: WorldFrame
    refined: Refined
    spread: Uncertainty
    held: Holdout
    repeats: Repeats
    warnings: tuple[Doubt, ...]

    @property
    def setups(self) -> Sequence[CameraSetup]:
        return self.optimum.setups

    @property
    def views(self) -> SpotViews:
        return self.optimum.views

    def camera_qualities(self) -> tuple[CameraQuality, ...]:
        """Figures of each camera."""
        return quality.camera_qualities(self.setups, self.refined, self.views, self.held)

    def calibrated_cameras(self) -> tuple[CalibratedCamera, ...]:
        """The cameras as they stand in the result."""
        qualities, refined = self.camera_qualities(), self.refined
        return tuple(
            CalibratedCamera(
                name=setup.name,
                size_px=setup.size_px,
                lens=setup.lens,
                intrinsics=refined.cameras.intrinsics[c],
                cam_from_world=refined.cameras.cam_from_world[c],
                covariance=self.spread.cameras[c],
                is_intrinsics_fixed=setup.knowledge is Knowledge.FIXED,
                quality=qualities[c],
            )
            for c, setup in enumerate(self.setups)
        )

    def network_quality(self) -> NetworkQuality:
        """Figures of the whole network."""
        refined, views = self.refined, self.views
        rows = np.flatnonzero(refined.is_inlier)
        return NetworkQuality(
            n_points=len(np.unique(views.point[rows])),
            n_observations=len(views.point),
            n_inliers=len(rows),
            fitted=quality.overall_error(refined, views),
            holdout=quality.overall_holdout(self.held),
            chi2_per_dof=quality.chi2_per_dof(refined, views, ~np.isnan(views.observations.sigma_px)),
            spot_sigma_median=float(np.median(self.spread.spot_sigma)),
            spot_sigma_p95=float(np.percentile(self.spread.spot_sigma, 95)),
            repeat_centre_spread=self.repeats.centre_spread,
            repeat_focal_spread_px=self.repeats.focal_spread_px,
        )


def assess(optimum: Optimum, *, anchor: Anchor, options: Options, seed: int, progress: Progress) -> Assessed:
    """Pose an optimum in the world frame and find out how good it is.

    Raises:
        InputError: the anchor names an unknown camera or frame.
        DegenerateError: observations that leave something free; says why and where to wave.
    """
    setups, views = optimum.setups, optimum.views
    progress("world frame and covariance", 0.55)
    world, refined = in_world(optimum.refined, views, anchor, options)
    spread = uncertainty(refined, setups, views, anchor)
    refuse_unobservable(setups, refined.cameras.intrinsics[:, 0], spread.focal_sigma_px)
    progress("hold-out", 0.65)
    held = quality.hold_out(setups, refined, views, share=options.holdout_share)
    progress("repeats", 0.7)
    repeats = _repeat(setups, views, anchor, options, seed, refined)
    progress("checks", 0.95)
    assessed = Assessed(optimum, world, refined, spread, held, repeats, ())
    return replace(assessed, warnings=_doubts(assessed, options))


def _doubts(assessed: Assessed, options: Options) -> tuple[Doubt, ...]:
    """Everything that a person should know before trusting the result."""
    setups, views, graph = assessed.setups, assessed.views, assessed.optimum.network.graph
    refined, spread, held = assessed.refined, assessed.spread, assessed.held
    offsets = estimate_time_offsets(refined.problem, refined.state, views, np.flatnonzero(refined.is_inlier))
    fitted, holdout = quality.overall_error(refined, views), quality.overall_holdout(held)
    freed = _freed(setups, refined, views, options)
    return (
        *doubts.about_convergence(refined.has_converged, assessed.optimum.twin_ratio),
        *doubts.about_repeats(assessed.repeats, spread.cameras),
        *doubts.about_cameras(
            setups, assessed.camera_qualities(), refined.cameras.intrinsics[:, 0], spread.focal_sigma_px
        ),
        *doubts.about_geometry(graph, refined.cameras),
        *doubts.about_holdout(fitted, holdout, held.agreeing_share),
        *doubts.about_time(graph.names, offsets),
        *doubts.about_given_intrinsics(setups, freed.cameras, refined.noise / freed.noise),
    )


def _repeat(
    setups: Sequence[CameraSetup], views: SpotViews, anchor: Anchor, options: Options, seed: int, refined: Refined
) -> Repeats:
    """The same calibration with the next seeds, compared in the world frame."""
    centre, focal_px, n_failed = [], [], 0
    for other_seed in range(seed + 1, seed + options.n_repeats):
        try:
            network = optimise(setups, views, anchor=anchor, options=options, seed=other_seed)
        except (DegenerateError, ConvergenceError):
            n_failed += 1
            continue
        _, other = in_world(network.refined, views, anchor, options)
        offset = other.cameras.centres_in_world - refined.cameras.centres_in_world
        centre.append(float(np.linalg.norm(offset, axis=1).max()))
        focal_px.append(float(np.abs(other.cameras.intrinsics[:, 0] - refined.cameras.intrinsics[:, 0]).max()))
    none = float("nan")
    return Repeats(max(centre, default=none), max(focal_px, default=none), n_failed, options.n_repeats - 1)


def _freed(setups: Sequence[CameraSetup], refined: Refined, views: SpotViews, options: Options) -> Refined:
    """The optimum with held intrinsics let go (as priors), to see what the data want."""
    if not any(setup.knowledge is Knowledge.FIXED for setup in setups):
        return refined
    freed = [replace(s, knowledge=Knowledge.INITIAL) if s.knowledge is Knowledge.FIXED else s for s in setups]
    return refine(freed, refined.cameras, views, rejection=options.rejection)
