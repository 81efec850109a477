"""The joint least-squares problem of cameras, LRFs and tilt angles: its blocks and its gauge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lrf_stereo.joint_data import LrfData, NetworkData
from lrf_stereo.lrf_block import SCANNERS, TILTS
from lrf_stereo.lrf_priors import DistancePrior, InstrumentPrior, InstrumentSigma, TiltPrior
from lrf_stereo.samples import TiltSettings
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.scanner_part import N_GEOMETRY, ScannerPart, TiltPart
from lrf_stereo.sighting_block import sighting_block
from network_calib.blocks import Gauge, Problem, SharedBlock, State
from network_calib.camera_block import PART, CameraBlock, cameras_of
from network_calib.camera_parameters import CameraParameters, free_columns
from network_calib.gauge import similarity_directions
from network_calib.observations import BoolArray, IntArray
from network_calib.priors import lens_prior
from network_calib.refine import intrinsics_groups
from network_calib.robust_loss import Loss, SquaredLoss
from network_calib.room_setup import Knowledge, KnownDistance

# A given baseline without sigma is held to a millionth: exact, as far as anything here can tell.
MIN_RELATIVE_SIGMA = 1e-6


def build_joint_problem(
    network: NetworkData,
    scanners: tuple[TiltingScanner, ...],
    data: LrfData,
    is_inlier: BoolArray,
    is_used: BoolArray,
    loss: Loss,
) -> tuple[Problem, State]:
    """The joint problem over the points `is_used` (F,) and the sightings `is_inlier` (M,), and its start."""
    number = np.cumsum(is_used) - 1
    camera_columns = _camera_columns(network)
    cameras = CameraParameters.from_cameras(network.cameras, camera_columns)
    part = ScannerPart.from_scanners(scanners, _scanner_columns(data.instrument))
    tilts = TiltPart(data.settings.angle_rad, _tilt_columns(data.settings))
    tilt_columns = shifted(tilts.columns, cameras.size + part.size)
    rows = np.flatnonzero(network.is_inlier & is_used[network.views.point])
    camera_block = CameraBlock(
        group=network.views.camera[rows],
        point=number[network.views.point[rows]],
        px=np.ascontiguousarray(network.views.px[rows].T),
        inverse_sigma=1 / (network.noise[network.views.camera[rows]] * network.views.sigma_px[rows]),
        columns=camera_columns,
        loss=SquaredLoss(),
    )
    kept = np.flatnonzero(is_inlier)
    lrf_block = sighting_block(
        network, scanners, data, kept,
        tilt_rad=tilts.angle_rad,
        point=number[data.point[kept]],
        columns=np.column_stack([shifted(part.columns, cameras.size)[data.settings.scanner], tilt_columns]),
        loss=loss,
    )  # fmt: skip
    priors: list[SharedBlock] = [
        lens_prior(network.setups, cameras),
        InstrumentPrior.of(part, data.instrument, cameras.size),
    ]
    free = np.flatnonzero(tilts.columns >= 0)
    if len(free):
        priors.append(TiltPrior.of(data.settings, free, tilt_columns[free]))
    if network.baseline is not None and not network.is_held:
        priors.append(_distance_prior(network, network.baseline, camera_columns))
    state = State({PART: cameras, SCANNERS: part, TILTS: tilts}, np.ascontiguousarray(network.points[is_used].T))
    return Problem([camera_block, lrf_block], priors, None if network.is_held else _first_camera_gauge), state


def _camera_columns(network: NetworkData) -> IntArray:
    n = len(network.cameras)
    is_fixed = np.array([network.is_held or setup.knowledge is Knowledge.FIXED for setup in network.setups])
    return free_columns(
        tuple(setup.lens for setup in network.setups),
        is_pose_fixed=np.full(n, network.is_held),
        is_intrinsics_fixed=is_fixed,
        groups=intrinsics_groups(network.setups),
    )


def _scanner_columns(instrument: Sequence[InstrumentSigma]) -> IntArray:
    sigmas = np.stack([sigma.as_array() for sigma in instrument])
    is_free = np.concatenate([np.ones((len(sigmas), N_GEOMETRY), dtype=bool), sigmas > 0], axis=1)
    return np.where(is_free, np.cumsum(is_free).reshape(is_free.shape) - 1, -1)


def _tilt_columns(settings: TiltSettings) -> IntArray:
    """Reference settings stay; so do angles that are trusted (no variance of their difference)."""
    reference = settings.reference_settings()[settings.scanner]
    spread = settings.covariance_rad2
    own = np.arange(len(settings.angle_rad))
    variance = spread[own, own] + spread[reference, reference] - 2 * spread[own, reference]
    is_free = (own != reference) & (variance > 0)
    return np.where(is_free, np.cumsum(is_free) - 1, -1)


def _distance_prior(network: NetworkData, known: KnownDistance, camera_columns: IntArray) -> DistancePrior:
    a, b = network.cameras.names.index(known.camera_a), network.cameras.names.index(known.camera_b)
    sigma_m = max(known.sigma_m, MIN_RELATIVE_SIGMA * known.distance_m)
    columns = np.concatenate([camera_columns[a, 3:6], camera_columns[b, 3:6]])[None]
    return DistancePrior(a, b, known.distance_m, sigma_m, columns)


def _first_camera_gauge(state: State) -> Gauge:
    """The first camera's pose stays; ranges or the baseline determine the scale."""
    cameras, part = cameras_of(state.parts), state.parts[SCANNERS]
    assert isinstance(part, ScannerPart)
    constraints = np.zeros((6, state.n_shared))
    constraints[np.arange(6), cameras.columns[0, :6]] = 1.0
    null = np.zeros((state.n_shared, 6))
    null[: cameras.size] = similarity_directions(cameras)[:, :6]
    null[cameras.size : cameras.size + part.size] = part.rigid_directions()
    return Gauge(constraints, null)


def shifted(columns: IntArray, first: int) -> IntArray:
    """A part's columns as global ones, when the part begins at column `first`; -1 stays."""
    return np.where(columns >= 0, columns + first, -1)
