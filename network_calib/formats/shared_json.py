"""What cameras and LRFs share in calibration.json: poses and covariances."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from network_calib.formats.strict_json import Node
from network_calib.observations import FloatArray

# The digits of a hand-written file: sums of rounded numbers agree to this.
DIGITS = 1e-9


def json_word(text: str) -> str:
    """A string as it stands in JSON."""
    return f'"{text}"'


def read_pose(node: Node, *, target: str, source: str) -> RigidTransform | None:
    """The pose target_from_source; None after a fault."""
    n_faults = len(node.faults)
    fields = node.fields("target", "source", "rotation_quat_xyzw", "translation")
    for name, expected in (("target", target), ("source", source)):
        if fields[name].text() != expected:
            fields[name].fail(json_word(expected))
    quaternion, translation = fields["rotation_quat_xyzw"].numbers(4), fields["translation"].numbers(3)
    if len(node.faults) > n_faults:
        return None
    if abs(math.hypot(*quaternion) - 1) > DIGITS:
        fields["rotation_quat_xyzw"].fail("a unit quaternion")
        return None
    return RigidTransform.from_components(translation, Rotation.from_quat(quaternion))


def read_covariance(node: Node, names: tuple[str, ...]) -> FloatArray | None:
    """(n, n) covariance of named parameters; None after a fault."""
    n_faults, n = len(node.faults), len(names)
    fields = node.fields("covariance_parameters", "lower_triangle")
    if fields["covariance_parameters"].value != list(names):
        fields["covariance_parameters"].fail(", ".join(names))
    covariance = np.zeros((n, n))
    for k, row in enumerate(fields["lower_triangle"].items(n)):
        covariance[k, : k + 1] = covariance[: k + 1, k] = row.numbers(k + 1)
    if len(node.faults) > n_faults:
        return None
    variance = np.diag(covariance)
    if (variance < 0).any():
        fields["lower_triangle"].fail(f"variances >= 0, found {variance.min():g}")
        return None
    # As correlations, so that pixels and radians weigh the same; rounding leaves eigenvalues a little below zero.
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    smallest = float(np.linalg.eigvalsh(covariance / scale[:, None] / scale).min())
    if smallest < -1e-6:
        fields["lower_triangle"].fail(f"a positive semidefinite matrix, its least eigenvalue is {smallest:.3g}")
        return None
    return covariance


def check_sigma(node: Node, covariance: FloatArray, names: tuple[str, ...]) -> None:
    """Compare standard deviations that stand beside a covariance with it."""
    fields = node.fields(*names)
    for k, name in enumerate(names):
        expected = math.sqrt(covariance[k, k])
        if not math.isclose(fields[name].number(0.0), expected, rel_tol=DIGITS):
            fields[name].fail(f"{expected!r}, which the covariance says")


def canonical_quaternion(rotation: Rotation) -> FloatArray:
    """(4,) the quaternion xyzw, w >= 0, whose file is the same after any number of loads and saves.

    A pose is held as a matrix, so a quaternion is rounded on its way in and on its way out: q -> f(q) may differ in the
    last bit, and repeating f ends in a cycle. The least element of the cycle depends on the cycle only, hence loading
    it and saving again, which starts at f of it, finds the same one.
    """
    # In order of time; a mapping, because a cycle may be found late.
    seen: dict[tuple[float, ...], int] = {}
    quaternion = _on_grid(rotation)
    while quaternion not in seen:
        seen[quaternion] = len(seen)
        quaternion = _on_grid(RigidTransform.from_components((0, 0, 0), Rotation.from_quat(quaternion)).rotation)
    return np.array(min(list(seen)[seen[quaternion] :]))


def _on_grid(rotation: Rotation) -> tuple[float, ...]:
    """Quaternion in steps of 2^-59 (1.7e-18), below the last bit of the components that tell an angle.

    Without it a small turn wanders: where rounding leaves the length of the quaternion a hair below one, and w, beside
    1, cannot take up the difference, the others grow by a bit with every load, for up to 10^9 loads. With it, the
    worst of a thousand small turns takes some thousand.
    """
    return tuple((np.round(rotation.as_quat(canonical=True) * 2.0**59) / 2.0**59).tolist())


def canonical_pose(pose: RigidTransform) -> RigidTransform:
    """The pose as it will be loaded: its quaternion rounded to the one that stays."""
    return RigidTransform.from_components(pose.translation, Rotation.from_quat(canonical_quaternion(pose.rotation)))


def pose_document(pose: RigidTransform, *, target: str, source: str) -> dict[str, object]:
    """target_from_source as JSON values."""
    return {
        "target": target,
        "source": source,
        "rotation_quat_xyzw": canonical_quaternion(pose.rotation).tolist(),
        "translation": pose.translation.tolist(),
    }


def covariance_document(covariance: FloatArray, names: tuple[str, ...]) -> dict[str, object]:
    """(n, n) covariance as JSON values."""
    return {
        "covariance_parameters": list(names),
        "lower_triangle": [row[: k + 1] for k, row in enumerate(np.asarray(covariance).tolist())],
    }
