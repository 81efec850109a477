"""A synthetic room on disk: the recording in two formats, what a user would know of it, and the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tomli_w

from network_calib.formats.calibration_json import save
from network_calib.formats.recording import digest
from network_calib.formats.svoboda import write_svoboda_recording
from network_calib.formats.table import write_npz
from network_calib.result import (
    PARAMETER_NAMES,
    CalibratedCamera,
    Calibration,
    CameraQuality,
    ErrorSummary,
    NetworkQuality,
    Provenance,
    WorldFrame,
)
from network_calib.synthetic import Room, Sighting

NO_ERRORS = ErrorSummary.of(np.zeros(0))


def write_simulation(room: Room, sighting: Sighting, folder: Path, *, noise_px: float, seed: int) -> None:
    """Write points.dat and its companions, table.npz, room.toml and truth.json (a calibration without sigma)."""
    folder.mkdir(parents=True, exist_ok=True)
    write_svoboda_recording(sighting.observations, size_px=room.cameras.size_px, folder=folder)
    write_npz(sighting.observations, folder / "table.npz")
    (folder / "room.toml").write_text(room_toml(room), encoding="utf-8")
    save(truth_calibration(room, sighting, noise_px=noise_px, seed=seed), folder / "truth.json")


def room_toml(room: Room) -> str:
    """What a user would know: names, image sizes, lens models, and the baseline of the stereo pair."""
    cameras = room.cameras
    entries = [
        {"name": name, "size": [int(side) for side in size], "lens": lens.value, "intrinsics": "unknown"}
        for name, size, lens in zip(cameras.names, cameras.size_px, cameras.lenses, strict=True)
    ]
    anchor = {"kind": "stereo", "cameras": list(cameras.names[:2]), "baseline_m": room.baseline_m}
    return tomli_w.dumps({"anchor": anchor, "cameras": entries})


def truth_calibration(room: Room, sighting: Sighting, *, noise_px: float, seed: int) -> Calibration:
    """The true cameras as a calibration: zero covariance, no errors, the room's own frame."""
    observations, cameras = sighting.observations, room.cameras
    n_seen = np.bincount(observations.camera[observations.n_views() >= 2], minlength=len(cameras))
    true_cameras = tuple(
        CalibratedCamera(
            name=cameras.names[k],
            size_px=(int(cameras.size_px[k, 0]), int(cameras.size_px[k, 1])),
            lens=cameras.lenses[k],
            intrinsics=cameras.intrinsics[k],
            cam_from_world=cameras.cam_from_world[k],
            covariance=np.zeros((len(PARAMETER_NAMES), len(PARAMETER_NAMES))),
            is_intrinsics_fixed=True,
            quality=CameraQuality(int(n_seen[k]), NO_ERRORS, NO_ERRORS, noise_px, 0.0),
        )
        for k in range(len(cameras))
    )
    return Calibration(
        cameras=true_cameras,
        world=WorldFrame(name="room", unit="m", scale_source="truth", scale_sigma=0.0),
        quality=NetworkQuality(
            n_points=len(np.unique(sighting.point[sighting.is_usable])),
            n_observations=int(n_seen.sum()),
            n_inliers=int(sighting.is_usable.sum()),
            fitted=NO_ERRORS,
            holdout=NO_ERRORS,
            chi2_per_dof=np.nan,
            spot_sigma_median=np.nan,
            spot_sigma_p95=np.nan,
            repeat_centre_spread=np.nan,
            repeat_focal_spread_px=np.nan,
        ),
        warnings=(),
        provenance=Provenance(
            program_version="synthetic",
            created_utc="",
            input_name=room.name,
            input_sha256=digest(observations),
            seed=seed,
            start_method="truth",
            options_json="{}",
        ),
    )
