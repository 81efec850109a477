"""room.toml: read, and merged with what the recording itself says.

Where both say something of a camera, the configuration wins. Intrinsics that come with a recording are a prior
("initial") unless the configuration, or the user on the command line, has them fixed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from network_calib.cameras import LensModel
from network_calib.errors import InputError
from network_calib.formats.recording import Recording
from network_calib.observations import FloatArray, Observations
from network_calib.room_setup import (
    Anchor,
    CameraSetup,
    Knowledge,
    KnownCentres,
    KnownDistance,
    KnownPoints,
    Options,
    UnitScale,
)
from nodes.config_faults import hint
from nodes.config_file import read_config
from nodes.config_model import (
    AnchorConfig,
    CameraConfig,
    CentresAnchor,
    DistanceAnchor,
    PointsAnchor,
    RoomConfig,
    SigmaConfig,
    StereoAnchor,
)

START_METHODS = ("auto", "factorisation", "anchor")


@dataclass(frozen=True, slots=True)
class Resolved:
    """Everything that `calibrate` asks for.

    Attributes:
        observations: with the camera names of the configuration where the recording has none of its own.
        setups: one for each camera, in the order of the observations.
        anchor: where scale and world frame come from.
        options: how to solve.
        notes: what was assumed.
    """

    observations: Observations
    setups: tuple[CameraSetup, ...]
    anchor: Anchor
    options: Options
    notes: tuple[str, ...]


def load_room(path: Path) -> RoomConfig:
    """Read a room.toml.

    Raises:
        InputError: no TOML, or lists every fault with its path, for example `cameras[2].lens`.
    """
    return read_config(path, RoomConfig)


def resolve(
    recording: Recording, config: RoomConfig | None, *, fix_intrinsics: bool = False, start: str | None = None
) -> Resolved:
    """Merge recording and configuration.

    Args:
        recording: what was read.
        config: None for no room.toml.
        fix_intrinsics: hold all given intrinsics fixed.
        start: overrides the start method of the configuration.

    Raises:
        InputError: the configuration names cameras that the recording does not have, or an image size is missing.
    """
    config = RoomConfig() if config is None else config
    recording, notes = _adopt_names(recording, config)
    names = recording.observations.camera_names
    _refuse_unknown(names, (camera.name for camera in config.cameras), where="cameras")
    recorded = {setup.name: setup for setup in recording.setups}
    configured = {camera.name: camera for camera in config.cameras}
    _refuse_no_size(names, recorded=recorded, configured=configured)
    setups = tuple(_setup(name, recorded.get(name), configured.get(name)) for name in names)
    if fix_intrinsics:
        setups, fixed_notes = _fixed(setups)
        notes = (*notes, *fixed_notes)
    return Resolved(
        observations=recording.observations,
        setups=setups,
        anchor=_anchor(config.anchor, recording),
        options=_options(config, start=start),
        notes=(*recording.notes, *notes),
    )


def _adopt_names(recording: Recording, config: RoomConfig) -> tuple[Recording, tuple[str, ...]]:
    """Name the cameras by the order of the configuration where the recording names none and no name fits."""
    made_up = recording.observations.camera_names
    names = tuple(camera.name for camera in config.cameras)
    if recording.is_named or len(names) != len(made_up) or set(names) & set(made_up):
        return recording, ()
    renamed = replace(
        recording,
        observations=replace(recording.observations, camera_names=names),
        setups=tuple(replace(setup, name=name) for setup, name in zip(recording.setups, names, strict=True)),
        known_centres=recording.known_centres and replace(recording.known_centres, names=names),
    )
    return renamed, (f"cameras are named by the order in the configuration: {', '.join(names)}",)


def _refuse_unknown(known: tuple[str, ...], named: Iterable[str], *, where: str) -> None:
    unknown = [name for name in named if name not in known]
    if unknown:
        told = ", ".join(repr(name) + hint(name, known) for name in unknown)
        raise InputError(f"{where}: the recording has no camera {told}; it has {', '.join(known)}")


def _refuse_no_size(
    names: tuple[str, ...], *, recorded: dict[str, CameraSetup], configured: dict[str, CameraConfig]
) -> None:
    missing = [n for n in names if n not in recorded and (n not in configured or configured[n].size is None)]
    if missing:
        raise InputError(
            f"the image size of {len(missing)} cameras is not known: {', '.join(missing)}",
            advice='Write it into room.toml: [[cameras]] with name = "..." and size = [width, height] for each, and '
            "pass --config room.toml.",
        )


def _setup(name: str, recorded: CameraSetup | None, config: CameraConfig | None) -> CameraSetup:
    if config is None:
        assert recorded is not None  # _refuse_no_size
        return recorded
    size = recorded.size_px if config.size is None and recorded is not None else _size(config)
    setup = CameraSetup(name, size) if recorded is None else replace(recorded, size_px=size)
    setup = replace(setup, group=config.group)
    if config.lens is not None:
        setup = _with_lens(setup, LensModel(config.lens), is_overridden=config.focal is not None)
    if config.focal is not None:
        intrinsics = _intrinsics(setup, config)
        setup = replace(setup, intrinsics=intrinsics, intrinsics_sigma=None)
    if config.intrinsics is not None:
        setup = _with_knowledge(setup, Knowledge(config.intrinsics))
    if config.sigma is not None:
        setup = replace(setup, intrinsics_sigma=_sigma(config.sigma))
    return setup


def _size(config: CameraConfig) -> tuple[int, int]:
    assert config.size is not None
    return config.size[0], config.size[1]


def _with_lens(setup: CameraSetup, lens: LensModel, *, is_overridden: bool) -> CameraSetup:
    given = setup.intrinsics
    if given is not None and not is_overridden:
        extra = given[4 + lens.n_distortion :]
        if (extra != 0).any() or lens.is_fisheye != setup.lens.is_fisheye:
            raise InputError(
                f"cameras: {setup.name!r} has lens {lens.value}, but the intrinsics given by the recording have the "
                f"distortion {given[4:].tolist()}",
                advice='Give focal and distortion for this lens, or set intrinsics = "unknown".',
            )
    return replace(setup, lens=lens)


def _with_knowledge(setup: CameraSetup, knowledge: Knowledge) -> CameraSetup:
    if knowledge is Knowledge.UNKNOWN:
        return replace(setup, knowledge=knowledge, intrinsics=None, intrinsics_sigma=None)
    if setup.intrinsics is None:
        raise InputError(
            f"cameras: {setup.name!r} has intrinsics = {knowledge.value!r}, but neither room.toml nor the recording "
            "gives any",
            advice="Give focal, centre and distortion.",
        )
    return replace(setup, knowledge=knowledge)


def _intrinsics(setup: CameraSetup, config: CameraConfig) -> FloatArray:
    assert config.focal is not None
    nominal = CameraSetup(setup.name, setup.size_px).nominal_intrinsics()
    centre = nominal[2:4].tolist() if config.centre is None else config.centre
    distortion = [*(config.distortion or []), 0, 0, 0, 0][:4]
    return np.array([*config.focal, *centre, *distortion], dtype=np.float64)


def _sigma(config: SigmaConfig) -> FloatArray:
    distortion = 1.0 if config.distortion is None else config.distortion  # a lens without terms has nothing to weigh
    return np.array([config.focal] * 2 + [config.centre] * 2 + [distortion] * 4)


def _fixed(setups: tuple[CameraSetup, ...]) -> tuple[tuple[CameraSetup, ...], tuple[str, ...]]:
    is_given = [setup.intrinsics is not None for setup in setups]
    if not any(is_given):
        raise InputError(
            "--fix-intrinsics: neither the recording nor room.toml gives intrinsics",
            advice="Leave the option out, or give focal, centre and distortion in room.toml.",
        )
    fixed = tuple(
        replace(setup, knowledge=Knowledge.FIXED) if given else setup
        for setup, given in zip(setups, is_given, strict=True)
    )
    free = [setup.name for setup, given in zip(setups, is_given, strict=True) if not given]
    return fixed, (f"--fix-intrinsics: none are given for {', '.join(free)}; these stay free",) if free else ()


def _anchor(config: AnchorConfig, recording: Recording) -> Anchor:
    names = recording.observations.camera_names
    if isinstance(config, StereoAnchor):
        _refuse_unknown(names, config.cameras, where="anchor.cameras")
        return KnownDistance(
            config.cameras[0], config.cameras[1], config.baseline_m, sigma_m=config.sigma_m, is_stereo_pair=True
        )
    if isinstance(config, DistanceAnchor):
        _refuse_unknown(names, config.cameras, where="anchor.cameras")
        return KnownDistance(config.cameras[0], config.cameras[1], config.distance_m, sigma_m=config.sigma_m)
    if isinstance(config, CentresAnchor):
        if config.centres is None:
            if recording.known_centres is None:
                raise InputError("anchor: kind is centres, but neither room.toml nor the recording gives any")
            return recording.known_centres
        _refuse_unknown(names, config.centres, where="anchor.centres")
        return KnownCentres(tuple(config.centres), np.array(list(config.centres.values()), dtype=np.float64))
    if isinstance(config, PointsAnchor):
        places = np.array([point.xyz for point in config.points], dtype=np.float64)
        return KnownPoints(tuple(point.frame for point in config.points), places)
    return UnitScale()


def _options(config: RoomConfig, *, start: str | None) -> Options:
    if start is not None and start not in START_METHODS:
        raise InputError(f"--start {start}: expected one of {', '.join(START_METHODS)}")
    options = Options(floor_frames=tuple(config.world.floor_frames))
    given = config.options
    start = given.start if start is None else start
    return replace(
        options,
        start=options.start if start is None else start,
        rejection=options.rejection if given.rejection is None else given.rejection,
        holdout_share=options.holdout_share if given.holdout_share is None else given.holdout_share,
        n_repeats=options.n_repeats if given.n_repeats is None else given.n_repeats,
    )
