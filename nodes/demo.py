"""The demonstration: a smart room with known truth, calibrated from bad detections, compared and drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from network_calib.cameras import Cameras
from network_calib.evaluate import evaluate
from network_calib.formats.aniposelib import write_aniposelib
from network_calib.formats.calibration_json import save
from network_calib.formats.recording import digest
from network_calib.observations import BoolArray, FloatArray
from network_calib.result import PARAMETER_NAMES, Calibration
from network_calib.room_setup import CameraSetup, KnownDistance, Options
from network_calib.spots import SpotViews, locate
from network_calib.synthetic import CameraErrors, Room, Sighting, compare, observe, room
from nodes.camera.pictures import draw_errors, draw_residuals
from nodes.config import Resolved
from nodes.report.network_picture import draw_network
from nodes.report.show import calibration_view
from nodes.report.tables import plain_table
from nodes.simulation.spots_simulation import write_simulation
from nodes.solve import solve

ROOM_NAME = "smart_room"
N_FRAMES, NOISE_PX, MISSING, FALSE = 1500, 0.2, 0.3, 0.1
# A vector error of this many of its own standard deviations: chance under one in 10^5 for a centre (3 dof). Beyond it
# the predicted sigma is wrong, not the luck bad.
MAX_SIGMA = 5.0
# m or px: what a few products of numbers up to 1e3 leave of a value that is exact by definition.
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Comparison:
    """The estimate against the truth, in the first camera's frame, where the covariances are stated.

    Attributes:
        errors: differences of each camera.
        centre_sigma_m: (C,) predicted, root of the sum over the axes.
        focal_sigma_px: (C,) predicted.
        mask_share: share of the detections that were rightly taken as spot or as false.
    """

    errors: CameraErrors
    centre_sigma_m: FloatArray
    focal_sigma_px: FloatArray
    mask_share: float

    @property
    def centre_in_sigma(self) -> FloatArray:
        """(C,) error over sigma; 0 for the camera that holds the frame."""
        return _ratio(self.errors.centre_m, self.centre_sigma_m)

    @property
    def focal_in_sigma(self) -> FloatArray:
        """(C,) error over sigma."""
        return _ratio(np.abs(self.errors.focal_px), self.focal_sigma_px)

    @property
    def is_as_predicted(self) -> bool:
        """No error exceeds MAX_SIGMA."""
        return bool(max(self.centre_in_sigma.max(), self.focal_in_sigma.max()) <= MAX_SIGMA)


def run_demo(out: Path, *, seed: int, console: Console, progress_console: Console) -> bool:
    """Simulate, calibrate, compare, write and draw into a folder.

    Returns:
        Whether every error is as large as its sigma allows.
    """
    rng = np.random.default_rng(seed)
    built = room(ROOM_NAME, rng=rng, n_frames=N_FRAMES)
    sighting = observe(built, rng=rng, sigma_px=NOISE_PX, missing=MISSING, false_detections=FALSE)
    write_simulation(built, sighting, out / "recording", noise_px=NOISE_PX, seed=seed)
    observations = sighting.observations
    console.print(
        f"{ROOM_NAME}: {len(built.cameras)} cameras, {N_FRAMES} frames, {len(observations)} detections; noise "
        f"{NOISE_PX} px, {MISSING:.0%} missing, {FALSE:.0%} false",
        highlight=False,
    )
    calibration = solve(
        _known(built, sighting),
        seed=seed,
        input_name=ROOM_NAME,
        input_sha256=digest(observations),
        console=progress_console,
    )
    comparison = compare_with_truth(calibration, built, sighting)
    save(calibration, out / "calibration.json")
    write_aniposelib(calibration, out / "aniposelib.toml")
    _draw(calibration, sighting, out)
    console.print(calibration_view(calibration))
    console.print(truth_table(comparison))
    console.print(_verdict(comparison), f"Written to {out}", sep="\n", soft_wrap=True, highlight=False)
    return comparison.is_as_predicted


def compare_with_truth(calibration: Calibration, built: Room, sighting: Sighting) -> Comparison:
    """Errors in the frame of the first camera, without any alignment: this frame and its scale are the claim."""
    sigma = np.array([camera.sigma for camera in calibration.cameras])
    focal = PARAMETER_NAMES.index("focal_px")
    evaluation = evaluate(calibration, sighting.observations)
    is_evaluated = sighting.observations.n_views() >= 2
    return Comparison(
        errors=compare(calibration.as_cameras(), _in_first_frame(built.cameras), align="none"),
        centre_sigma_m=np.linalg.norm(sigma[:, 3:6], axis=1),
        focal_sigma_px=sigma[:, focal],
        mask_share=float((evaluation.is_inlier == sighting.is_usable[is_evaluated]).mean()),
    )


def truth_table(comparison: Comparison) -> Table:
    """Errors beside the standard deviations that the calibration predicts for them."""
    heads = ("rotation, °", "centre, mm", "its σ", "focal, px", "its σ", "errors / σ")
    table = plain_table("Errors against the truth", "camera", *heads)
    errors = comparison.errors
    for k, name in enumerate(errors.names):
        centre_sigma = comparison.centre_sigma_m[k]
        table.add_row(
            Text(name),
            f"{errors.rotation_deg[k]:.4f}",
            f"{1e3 * errors.centre_m[k]:.2f}",
            f"{1e3 * centre_sigma:.2f}" if centre_sigma > ROUNDING else "–",
            f"{errors.focal_px[k]:+.2f}",
            f"{comparison.focal_sigma_px[k]:.2f}",
            f"{comparison.centre_in_sigma[k]:.1f}, {comparison.focal_in_sigma[k]:.1f}",
        )
    return table


def _ratio(error: FloatArray, sigma: FloatArray) -> FloatArray:
    """error / sigma; where sigma is rounding the value is held, and any error beyond rounding is infinitely wrong."""
    is_free = sigma > ROUNDING
    held = np.where(error > ROUNDING, np.inf, 0.0)
    return np.where(is_free, error / np.where(is_free, sigma, 1.0), held)


def _in_first_frame(cameras: Cameras) -> Cameras:
    poses = cameras.cam_from_world
    return replace(cameras, cam_from_world=poses * poses[0].inv())


def _known(built: Room, sighting: Sighting) -> Resolved:
    """What the user of the room knows: image sizes, lens models, the baseline of the stereo pair; no intrinsics."""
    cameras = built.cameras
    setups = tuple(
        CameraSetup(name, (int(width), int(height)), lens=lens)
        for name, (width, height), lens in zip(cameras.names, cameras.size_px, cameras.lenses, strict=True)
    )
    anchor = KnownDistance(cameras.names[0], cameras.names[1], built.baseline_m, is_stereo_pair=True)
    return Resolved(sighting.observations, setups, anchor, Options(), ())


def _verdict(comparison: Comparison) -> Text:
    mask = f"Spot or false detection: {100 * comparison.mask_share:.2f} % told apart rightly. "
    if comparison.is_as_predicted:
        return Text(f"{mask}Every error is within {MAX_SIGMA:g} of its predicted σ.", style="green")
    return Text(f"{mask}Errors exceed {MAX_SIGMA:g} of their predicted σ: the uncertainty is wrong.", style="bold red")


def _draw(calibration: Calibration, sighting: Sighting, out: Path) -> None:
    views = SpotViews.of(sighting.observations)
    points, is_inlier = located(calibration, views)
    draw_network(calibration, points, out / "network.png")
    draw_residuals(calibration, views, points, is_inlier, out / "residuals.png")
    draw_errors(calibration, out / "errors.png")


def located(calibration: Calibration, views: SpotViews) -> tuple[FloatArray, BoolArray]:
    """Spots (F, 3) and inliers (K,) at five of each camera's sigma."""
    noise = np.array([camera.quality.noise_sigma_px for camera in calibration.cameras])
    return locate(calibration.as_cameras(), views, 5 * noise[views.camera])
