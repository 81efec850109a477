"""The schema of calibration.json, field by field: from checked JSON nodes to the result."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from network_calib.cameras import LensModel
from network_calib.formats.lrf_json import read_lrf
from network_calib.formats.shared_json import DIGITS, check_sigma, json_word, read_covariance, read_pose
from network_calib.formats.strict_json import Node
from network_calib.observations import FloatArray
from network_calib.result import (
    PARAMETER_NAMES,
    CalibratedCamera,
    CalibratedLrf,
    Calibration,
    CameraQuality,
    Doubt,
    ErrorSummary,
    NetworkQuality,
    Provenance,
    WorldFrame,
)

MAX_IMAGE_SIDE_PX = 100_000


def read_calibration(root: Node, *, schema: str) -> Calibration:
    """Build the result. Faults stay in `root.faults`; the value counts only when there are none."""
    fields = root.fields("schema", "world", "cameras", "quality", "warnings", "provenance", optional=("lrfs",))
    if fields["schema"].text() != schema:
        fields["schema"].fail(json_word(schema))
    world = _world(fields["world"])
    cameras = tuple(_camera(node, world=world.name) for node in fields["cameras"].items())
    names = [camera.name for camera in cameras]
    if not names or len(set(names)) != len(names):
        fields["cameras"].faults.append(f"{fields['cameras'].path}: camera names {names}, expected one or more, unique")
    return Calibration(
        cameras=cameras,
        world=world,
        quality=_network_quality(fields["quality"]),
        warnings=tuple(_warning(node) for node in fields["warnings"].items()),
        provenance=_provenance(fields["provenance"]),
        lrfs=_lrfs(fields["lrfs"], world) if "lrfs" in fields else (),
    )


def _lrfs(node: Node, world: WorldFrame) -> tuple[CalibratedLrf, ...]:
    lrfs = tuple(read_lrf(item, world=world.name) for item in node.items())
    names = [lrf.name for lrf in lrfs]
    if not names or len(set(names)) != len(names):
        node.faults.append(f"{node.path}: LRF names {names}, expected one or more, unique")
    if world.unit != "m":
        node.faults.append(f"{node.path}: in a world of unit {world.unit}, expected m: ranges are metric")
    return lrfs


def _world(node: Node) -> WorldFrame:
    fields = node.fields("name", "unit", "scale_source", "scale_sigma")
    return WorldFrame(
        name=fields["name"].text(),
        unit=fields["unit"].text("m", "unit"),
        scale_source=fields["scale_source"].text(),
        scale_sigma=fields["scale_sigma"].number_or_nan(0.0),
    )


def _camera(node: Node, *, world: str) -> CalibratedCamera:
    fields = node.fields(
        *("name", "size_px", "lens", "intrinsics", "is_intrinsics_fixed", "cam_from_world", "centre_in_world"),
        *("sigma", "covariance", "quality"),
    )
    name = fields["name"].text()
    width, height = (item.whole(1) for item in fields["size_px"].items(2))
    if max(width, height) > MAX_IMAGE_SIDE_PX:
        fields["size_px"].fail(f"at most {MAX_IMAGE_SIDE_PX} px")
    lens = LensModel(fields["lens"].text(*(model.value for model in LensModel)))
    covariance = read_covariance(fields["covariance"], PARAMETER_NAMES)
    pose = read_pose(fields["cam_from_world"], target=name, source=f"world {world}")
    # Derived figures are compared only with a sound original: one mistake is one fault.
    if covariance is not None:
        check_sigma(fields["sigma"], covariance, PARAMETER_NAMES)
    if pose is not None:
        _check_centre(fields["centre_in_world"], pose)
    return CalibratedCamera(
        name=name,
        size_px=(width, height),
        lens=lens,
        intrinsics=_intrinsics(fields["intrinsics"], lens),
        cam_from_world=RigidTransform.identity() if pose is None else pose,
        covariance=np.zeros((len(PARAMETER_NAMES),) * 2) if covariance is None else covariance,
        is_intrinsics_fixed=fields["is_intrinsics_fixed"].flag(),
        quality=_camera_quality(fields["quality"]),
    )


def _intrinsics(node: Node, lens: LensModel) -> FloatArray:
    fields = node.fields("focal_x_px", "focal_y_px", "centre_x_px", "centre_y_px", "distortion")
    focal = [fields[name].number(1e-3, 1e9) for name in ("focal_x_px", "focal_y_px")]
    centre = [fields[name].number() for name in ("centre_x_px", "centre_y_px")]
    names = ("k1", "k2", "k3", "k4") if lens.is_fisheye else ("k1", "k2", "p1", "p2")
    terms = fields["distortion"].fields(*names)
    distortion = [terms[name].number() for name in names]
    for name in names[lens.n_distortion :]:
        if terms[name].value not in (0, None):
            terms[name].fail(f"0, because the lens model is {lens.value}")
    return np.array([*focal, *centre, *distortion])


def _check_centre(node: Node, pose: RigidTransform) -> None:
    centre = np.array(node.numbers(3))
    expected = pose.inv().translation
    if not np.allclose(centre, expected, rtol=DIGITS, atol=DIGITS * (1 + np.abs(expected).max())):
        node.fail(f"{expected.tolist()}, which the pose says")


def _errors(node: Node) -> ErrorSummary:
    fields = node.fields("n", "mean_px", "rms_px", "median_px", "p95_px")
    return ErrorSummary(
        n=fields["n"].whole(),
        mean_px=fields["mean_px"].number_or_nan(0.0),
        rms_px=fields["rms_px"].number_or_nan(0.0),
        median_px=fields["median_px"].number_or_nan(0.0),
        p95_px=fields["p95_px"].number_or_nan(0.0),
    )


def _camera_quality(node: Node) -> CameraQuality:
    fields = node.fields("n_observations", "fitted", "holdout", "noise_sigma_px", "coverage")
    return CameraQuality(
        n_observations=fields["n_observations"].whole(),
        fitted=_errors(fields["fitted"]),
        holdout=_errors(fields["holdout"]),
        noise_sigma_px=fields["noise_sigma_px"].number_or_nan(0.0),
        coverage=fields["coverage"].number(0.0, 1.0),
    )


def _network_quality(node: Node) -> NetworkQuality:
    fields = node.fields(
        *("n_points", "n_observations", "n_inliers", "fitted", "holdout", "chi2_per_dof"),
        *("spot_sigma_median", "spot_sigma_p95", "repeat_centre_spread", "repeat_focal_spread_px"),
    )
    return NetworkQuality(
        n_points=fields["n_points"].whole(),
        n_observations=fields["n_observations"].whole(),
        n_inliers=fields["n_inliers"].whole(),
        fitted=_errors(fields["fitted"]),
        holdout=_errors(fields["holdout"]),
        chi2_per_dof=fields["chi2_per_dof"].number_or_nan(0.0),
        spot_sigma_median=fields["spot_sigma_median"].number_or_nan(0.0),
        spot_sigma_p95=fields["spot_sigma_p95"].number_or_nan(0.0),
        repeat_centre_spread=fields["repeat_centre_spread"].number_or_nan(0.0),
        repeat_focal_spread_px=fields["repeat_focal_spread_px"].number_or_nan(0.0),
    )


def _warning(node: Node) -> Doubt:
    fields = node.fields("code", "message", "advice")
    return Doubt(fields["code"].text(), fields["message"].text(), fields["advice"].text())


def _provenance(node: Node) -> Provenance:
    fields = node.fields(
        *("program_version", "created_utc", "input_name", "input_sha256", "seed", "start_method", "options_json")
    )
    return Provenance(
        program_version=fields["program_version"].text(),
        created_utc=fields["created_utc"].text(),
        input_name=fields["input_name"].text(),
        input_sha256=fields["input_sha256"].text(),
        seed=fields["seed"].whole(),
        start_method=fields["start_method"].text(),
        options_json=fields["options_json"].text(),
    )
