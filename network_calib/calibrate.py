"""The calibration of a camera network as a list of steps (Svoboda, Martinec, Pajdla 2005; see the package)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from network_calib.assess import Assessed, Optimum, assess
from network_calib.errors import ConvergenceError, DegenerateError
from network_calib.observations import Observations
from network_calib.optimum import Progress, better_of_twins, explained, optimise
from network_calib.refusals import refuse_bad_input, refuse_unknown_anchor
from network_calib.result import Calibration, Provenance
from network_calib.room_setup import Anchor, CameraSetup, Options, UnitScale
from network_calib.spots import SpotViews


@dataclass(frozen=True, slots=True)
class InputId:
    """What a result was made from: a name for a person, and a digest."""

    name: str = ""
    sha256: str = ""


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
    found = find_optimum(observations, setups, anchor=anchor, options=options, seed=seed, progress=report)
    assessed = assess(found, anchor=anchor, options=options, seed=seed, progress=report)
    report("done", 1.0)
    source = InputId(input_name, input_sha256)
    return calibration_of(assessed, provenance_of(found, source, anchor=anchor, options=options, seed=seed))


def find_optimum(
    observations: Observations,
    setups: Sequence[CameraSetup],
    *,
    anchor: Anchor,
    options: Options,
    seed: int,
    progress: Progress,
) -> Optimum:
    """Steps 1 to 6: the joint optimum, or the reason why there is none; errors as in `calibrate`."""
    views = SpotViews.of(observations)
    refuse_bad_input(observations, setups, views)
    refuse_unknown_anchor(anchor, observations.camera_names)
    try:
        network = optimise(setups, views, anchor=anchor, options=options, seed=seed, progress=progress)
    except (DegenerateError, ConvergenceError) as error:
        progress("looking for the reason", 0.5)
        raise explained(error, setups, observations, anchor=anchor, options=options, seed=seed) from error
    progress("mirrored twin", 0.5)
    refined, twin_ratio = better_of_twins(setups, network.refined, views, options)
    return Optimum(setups, views, network, refined, twin_ratio)


def calibration_of(assessed: Assessed, provenance: Provenance) -> Calibration:
    """The result."""
    return Calibration(
        cameras=assessed.calibrated_cameras(),
        world=assessed.world,
        quality=assessed.network_quality(),
        warnings=assessed.warnings,
        provenance=provenance,
    )


def provenance_of(found: Optimum, source: InputId, *, anchor: Anchor, options: Options, seed: int) -> Provenance:
    """Where a result comes from, at this moment."""
    return Provenance(
        program_version=program_version(),
        created_utc=now_utc(),
        input_name=source.name,
        input_sha256=source.sha256,
        seed=seed,
        start_method=found.network.start.method,
        options_json=_canonical_json(options, anchor),
    )


def now_utc() -> str:
    """ISO 8601, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


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
