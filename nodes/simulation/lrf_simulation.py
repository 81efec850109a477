"""Simulated sessions with a laser range finder on disk: the paper's set-up, and a room of five cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tomli_w

from lrf_stereo.lrf_result import paper_numbers
from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.session import LrfSession
from lrf_stereo.synthetic import BoxRoom, LrfSamples, LrfScene, SampleNoise, paper_scene, sample
from network_calib.cameras import Cameras
from network_calib.formats.calibration_json import save
from network_calib.formats.svoboda import write_svoboda_recording
from network_calib.formats.table import write_npz
from network_calib.observations import FloatArray
from network_calib.result import LRF_PARAMETER_NAMES, CalibratedLrf
from network_calib.synthetic import Room, Sighting, observe
from nodes.lrf.session import write_lrf_session
from nodes.simulation.spots_simulation import room_toml, truth_calibration

LRF_NAME = "L0"
FRAME_RATE_HZ = 25.0
# A step of the tilt unit is 0.0514 degrees; its rounding leaves this standard deviation.
TILT_SIGMA_RAD = float(np.radians(0.0514 / np.sqrt(12)))


@dataclass(frozen=True, slots=True)
class LrfPlan:
    """What a named session is made of.

    Attributes:
        n_room_cameras: beside the stereo pair.
        is_given: the intrinsics are known; two cameras alone do not determine theirs.
        n_waved: spots that the cameras alone see, all over the room.
        n_spots_per_tilt: crossings of the scan plane; of those that two cameras alone could see, half may go missing.
    """

    n_room_cameras: int
    is_given: bool
    n_waved: int
    n_spots_per_tilt: int = 22


LRF_PLANS = {
    "paper_setup": LrfPlan(n_room_cameras=0, is_given=True, n_waved=600, n_spots_per_tilt=40),
    "lrf_room": LrfPlan(n_room_cameras=3, is_given=False, n_waved=900),
    "lrf_room_given": LrfPlan(n_room_cameras=3, is_given=True, n_waved=400),
}


@dataclass(frozen=True, slots=True)
class LrfRoom:
    """A simulated session and its truth.

    Attributes:
        room: cameras and the way of the spot: waved first, then crossing the scan planes; the world is C0's frame.
        scene: the truth of the LRF.
        samples: what the LRF reports of the crossings.
        is_given: the intrinsics are known to the user.
    """

    room: Room
    scene: LrfScene
    samples: LrfSamples
    is_given: bool

    @property
    def session(self) -> LrfSession:
        """The LRF's part as a session holds it."""
        n_waved = len(self.room.trajectory) - len(self.samples.spots)
        spots = replace(self.samples.spots, frame=self.samples.spots.frame + n_waved)
        return LrfSession((LRF_NAME,), spots, self.samples.settings)


def lrf_room(name: str, *, rng: np.random.Generator, n_frames: int | None = None) -> LrfRoom:
    """Build a named session.

    Args:
        name: one of LRF_PLANS.
        rng: draws spots, lenses and the LRF's noise.
        n_frames: waved spots, beside those in the scan planes; None for the session's own number.
    """
    plan = LRF_PLANS[name]
    scene = paper_scene(
        rng=rng, n_spots_per_tilt=plan.n_spots_per_tilt, n_room_cameras=plan.n_room_cameras, mount_deg=(1.0, -0.5)
    )
    n_waved = plan.n_waved if n_frames is None else n_frames
    return room_of(name, scene, SampleNoise(), rng=rng, n_waved=n_waved, is_given=plan.is_given)


def room_of(
    name: str, scene: LrfScene, noise: SampleNoise, *, rng: np.random.Generator, n_waved: int, is_given: bool
) -> LrfRoom:
    """The session of a scene: spots waved all over its room, then the crossings, at tilts of a tilt unit's sigma."""
    samples = sample(scene, rng=rng, noise=replace(noise, lrf=replace(noise.lrf, tilt_rad=TILT_SIGMA_RAD)))
    waved = _waved(scene.cameras, scene.room, n_waved, rng)
    trajectory = np.concatenate([waved, samples.spots_in_world])
    return LrfRoom(Room(name, scene.cameras, trajectory, FRAME_RATE_HZ), scene, samples, is_given)


def simulate_lrf_room(
    name: str, folder: Path, *, seed: int, n_frames: int | None, noise_px: float, missing: float, false: float
) -> Sighting:
    """Write a named session, see `write_lrf_room`."""
    rng = np.random.default_rng(seed)
    built = lrf_room(name, rng=rng, n_frames=n_frames)
    sighting = observe(built.room, rng=rng, sigma_px=noise_px, missing=missing, false_detections=false)
    write_lrf_room(built, sighting, folder, noise_px=noise_px, seed=seed)
    return sighting


def write_lrf_room(built: LrfRoom, sighting: Sighting, folder: Path, *, noise_px: float, seed: int) -> None:
    """Write the cameras' spots, lrf.csv, tilts.csv, room.toml, and truth.json with the LRF."""
    folder.mkdir(parents=True, exist_ok=True)
    write_svoboda_recording(sighting.observations, size_px=built.room.cameras.size_px, folder=folder)
    write_npz(sighting.observations, folder / "table.npz")
    write_lrf_session(built.session, folder)
    text = given_room_toml(built.room) if built.is_given else room_toml(built.room)
    (folder / "room.toml").write_text(text, encoding="utf-8")
    truth = truth_calibration(built.room, sighting, noise_px=noise_px, seed=seed)
    save(replace(truth, lrfs=(true_lrf(built.scene.scanner, built.scene.tilts_rad),)), folder / "truth.json")


def given_room_toml(room: Room) -> str:
    """What the user of calibrated cameras would know: their intrinsics, which are held, and the baseline."""
    cameras = room.cameras
    entries = [
        {
            "name": name,
            "size": [int(side) for side in cameras.size_px[c]],
            "lens": cameras.lenses[c].value,
            "intrinsics": "fixed",
            "focal": cameras.intrinsics[c, :2].tolist(),
            "centre": cameras.intrinsics[c, 2:4].tolist(),
            "distortion": cameras.intrinsics[c, 4 : 4 + cameras.lenses[c].n_distortion].tolist(),
        }
        for c, name in enumerate(cameras.names)
    ]
    anchor = {"kind": "stereo", "cameras": list(cameras.names[:2]), "baseline_m": room.baseline_m}
    return tomli_w.dumps({"anchor": anchor, "cameras": entries, "lrfs": [{"name": LRF_NAME}]})


def true_lrf(scanner: TiltingScanner, tilts_rad: FloatArray) -> CalibratedLrf:
    """The true LRF as it would stand in a result without errors; its pose is stated at the first tilt."""
    dx_m, dz_m, roll, yaw = paper_numbers(scanner).tolist()
    n = len(LRF_PARAMETER_NAMES)
    return CalibratedLrf(
        name=LRF_NAME,
        world_from_lrf=scanner.world_from_lrf_at(float(tilts_rad[0])),
        reference_tilt_rad=float(tilts_rad[0]),
        axis_direction_in_world=scanner.axis_direction_in_world,
        axis_point_in_world=scanner.axis_point_in_world,
        instrument=scanner.instrument,
        covariance=np.zeros((n, n)),
        dx_m=dx_m,
        dz_m=dz_m,
        mount_roll_rad=roll,
        mount_yaw_rad=yaw,
        paper_sigma=np.zeros(4),
        tilt_rad=tilts_rad,
        tilt_sigma_rad=np.zeros(len(tilts_rad)),
        n_sightings=0,
        n_inliers=0,
        range_rms_m=float("nan"),
        bearing_rms_rad=float("nan"),
        out_of_plane_rms_m=float("nan"),
        held=LRF_PARAMETER_NAMES,
    )


def _waved(cameras: Cameras, room: BoxRoom, n: int, rng: np.random.Generator) -> FloatArray:
    """(n, 3) spots all over the room that two cameras or more have in view."""
    found = np.empty((0, 3))
    while len(found) < n:
        points = room.world_from_room.apply(rng.uniform(room.low_m + 0.2, room.high_m - 0.2, (4 * n, 3)))
        n_views = np.zeros(len(points), dtype=np.int64)
        for camera in range(len(cameras)):
            index = np.full(len(points), camera)
            px, is_valid = cameras.img_from_world(index, points)
            n_views += is_valid & cameras.is_in_image(index, px)
        found = np.concatenate([found, points[n_views >= 2]])
    return found[:n]
