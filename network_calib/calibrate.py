"""The calibration of a camera network as a list of steps (Svoboda, Martinec, Pajdla 2005; see the package)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from network_calib import doubts, quality
from network_calib.errors import ConvergenceError, DegenerateError
from network_calib.observations import Observations
from network_calib.optimum import Progress, better_of_twins, explained, optimise
from network_calib.pairs import PairGraph
from network_calib.quality import Holdout, Repeats
from network_calib.refine import Refined, refine
from network_calib.refusals import refuse_bad_input, refuse_unknown_anchor, refuse_unobservable
from network_calib.result import (
    CalibratedCamera,
    Calibration,
    CameraQuality,
    Doubt,
    NetworkQuality,
    Provenance,
)
from network_calib.room_setup import Anchor, CameraSetup, Knowledge, Options, UnitScale
from network_calib.spots import SpotViews
from network_calib.sync import estimate_time_offsets
from network_calib.uncertainty import Uncertainty, uncertainty
from network_calib.world import in_world


def calibrate(
    observations: Observations,
    setups: Sequence[CameraSetup],
    *,
    anchor: Anchor | None = None,
    options: Options | None = None,
    seed: int = 0,
    input_name: str = "",
    input_sha256: str = "",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate a camera network from spot observations.

    Args:
        observations: of all cameras, in the order of the setups.
        setups: what is known of each camera.
        anchor: where metric scale and world frame come from; by default the first camera's frame and unit scale.
        options: how to solve.
        seed: of all random draws; the same input and seed give the same result, bit for bit.
        input_name: stands in the result.
        input_sha256: stands in the result.
        progress: called with the name of each step and the fraction done.

    Raises:
        InputError: input that does not fit together.
        DegenerateError: observations that do not determine the network; says why and where to wave.
        ConvergenceError: no optimum worth reporting.
    """
    anchor, options, report = anchor or UnitScale(), options or Options(), progress or (lambda _step, _part: None)
    views = SpotViews.of(observations)
    refuse_bad_input(observations, setups, views)
    refuse_unknown_anchor(anchor, observations.camera_names)
    try:
        network = optimise(setups, views, anchor=anchor, options=options, seed=seed, progress=report)
    except (DegenerateError, ConvergenceError) as error:
        report("looking for the reason", 0.5)
        raise explained(error, setups, observations, anchor=anchor, options=options, seed=seed) from error

    report("mirrored twin", 0.5)
    refined, twin_ratio = better_of_twins(setups, network.refined, views, options)
    report("world frame and covariance", 0.55)
    world, refined = in_world(refined, views, anchor, options)
    spread = uncertainty(refined, setups, views, anchor)
    refuse_unobservable(setups, refined.cameras.intrinsics[:, 0], spread.focal_sigma_px)

    report("hold-out", 0.65)
    held = quality.hold_out(setups, refined, views, share=options.holdout_share)
    report("repeats", 0.7)
    repeats = _repeat(setups, views, anchor, options, seed, refined)
    report("checks", 0.95)
    qualities = quality.camera_qualities(setups, refined, views, held)
    findings = _Findings(network.graph, twin_ratio, refined, spread, held, qualities, repeats)
    warnings = _doubts(setups, views, options, findings)
    report("done", 1.0)
    return Calibration(
        cameras=_calibrated_cameras(setups, refined, spread, qualities),
        world=world,
        quality=_network_quality(views, refined, spread, held, repeats),
        warnings=warnings,
        provenance=Provenance(
            program_version=program_version(),
            created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
            input_name=input_name,
            input_sha256=input_sha256,
            seed=seed,
            start_method=network.start.method,
            options_json=_canonical_json(options, anchor),
        ),
    )


@dataclass(frozen=True, slots=True)
class _Findings:
    """What the doubts are raised from."""

    graph: PairGraph
    twin_ratio: float
    refined: Refined
    spread: Uncertainty
    held: Holdout
    qualities: tuple[CameraQuality, ...]
    repeats: Repeats


def _calibrated_cameras(
    setups: Sequence[CameraSetup], refined: Refined, spread: Uncertainty, qualities: Sequence[CameraQuality]
) -> tuple[CalibratedCamera, ...]:
    return tuple(
        CalibratedCamera(
            name=setup.name,
            size_px=setup.size_px,
            lens=setup.lens,
            intrinsics=refined.cameras.intrinsics[c],
            cam_from_world=refined.cameras.cam_from_world[c],
            covariance=spread.cameras[c],
            is_intrinsics_fixed=setup.knowledge is Knowledge.FIXED,
            quality=qualities[c],
        )
        for c, setup in enumerate(setups)
    )


def _network_quality(
    views: SpotViews, refined: Refined, spread: Uncertainty, held: Holdout, repeats: Repeats
) -> NetworkQuality:
    rows = np.flatnonzero(refined.is_inlier)
    return NetworkQuality(
        n_points=len(np.unique(views.point[rows])),
        n_observations=len(views.point),
        n_inliers=len(rows),
        fitted=quality.overall_error(refined, views),
        holdout=quality.overall_holdout(held),
        chi2_per_dof=quality.chi2_per_dof(refined, views, ~np.isnan(views.observations.sigma_px)),
        spot_sigma_median=float(np.median(spread.spot_sigma)),
        spot_sigma_p95=float(np.percentile(spread.spot_sigma, 95)),
        repeat_centre_spread=repeats.centre_spread,
        repeat_focal_spread_px=repeats.focal_spread_px,
    )


def _doubts(
    setups: Sequence[CameraSetup], views: SpotViews, options: Options, findings: _Findings
) -> tuple[Doubt, ...]:
    """Everything that a person should know before trusting the result."""
    refined, spread, held = findings.refined, findings.spread, findings.held
    offsets = estimate_time_offsets(refined.problem, refined.state, views, np.flatnonzero(refined.is_inlier))
    fitted, holdout = quality.overall_error(refined, views), quality.overall_holdout(held)
    freed = _freed(setups, refined, views, options)
    return (
        *doubts.about_convergence(refined.has_converged, findings.twin_ratio),
        *doubts.about_repeats(findings.repeats, spread.cameras),
        *doubts.about_cameras(setups, findings.qualities, refined.cameras.intrinsics[:, 0], spread.focal_sigma_px),
        *doubts.about_geometry(findings.graph, refined.cameras),
        *doubts.about_holdout(fitted, holdout, held.agreeing_share),
        *doubts.about_time(findings.graph.names, offsets),
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


def program_version() -> str:
    """The installed version of spotcal."""
    try:
        return version("spotcal")
    except PackageNotFoundError:
        return "unknown"


def _canonical_json(options: Options, anchor: Anchor) -> str:
    def plain(value: object) -> object:
        return value.tolist() if isinstance(value, np.ndarray) else str(value)

    content = {"options": asdict(options), "anchor": {"kind": type(anchor).__name__, **asdict(anchor)}}
    return json.dumps(content, sort_keys=True, default=plain)
