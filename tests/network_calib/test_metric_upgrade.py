"""Euclidean upgrade: undoes any projective transformation, never mirrors, refuses what no real camera is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib import metric_upgrade
from network_calib.errors import DegenerateError
from network_calib.metric_upgrade import upgrade_to_metric
from network_calib.synthetic_rooms import look_at

NAMES = ("A", "B", "C", "D", "E", "F", "G", "H")


def around(n_cameras=6, *, ratio, principal=0.0, seed=0):
    """Rotations, centres, projection matrices and spots of cameras around a box; targets and heights vary."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(n_cameras) / n_cameras
    centres = np.stack([4 * np.cos(angle), 4 * np.sin(angle), rng.uniform(0.5, 3.5, n_cameras)], axis=1)
    rotations = np.stack([look_at(c, np.array([0.0, 0.0, 1.0]) + 0.5 * rng.standard_normal(3)) for c in centres])
    calibration = np.zeros((n_cameras, 3, 3))
    calibration[:, 0, 0] = calibration[:, 1, 1] = ratio
    calibration[:, :2, 2] = principal * rng.choice([-1, 1], (n_cameras, 2))
    calibration[:, 2, 2] = 1.0
    matrices = calibration @ np.concatenate([rotations, -(rotations @ centres[:, :, None])], axis=2)
    spots = np.column_stack([rng.uniform([-1.5, -1.5, 0], [1.5, 1.5, 2], (100, 3)), np.ones(100)])
    return rotations, centres, matrices, spots


def transformed(matrices, spots, *, seed, mirrored=False):
    """The same depths and rays in another projective frame; cameras and spots with positive factors of their own."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.standard_normal((4, 4)))
    frame = q * rng.uniform(0.5, 2.0, 4)
    if (np.linalg.det(frame) < 0) != mirrored:
        frame[:, 0] *= -1
    matrices = matrices @ np.linalg.inv(frame) * rng.uniform(0.2, 5.0, (len(matrices), 1, 1))
    return matrices, spots @ frame.T * rng.uniform(0.2, 5.0, (len(spots), 1))


def differences(room, rotations, centres):
    """Largest angle (rad) and distance (of the room's size) after the rotation and scale that fit best."""
    found, found_centres = room.cam_from_world.rotation.as_matrix(), room.cam_from_world.inv().translation
    u, _, vt = np.linalg.svd(np.einsum("cij,cik->jk", rotations, found))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    angle = np.linalg.norm(rotations @ turn - found, axis=(1, 2)) / np.sqrt(2)
    centred = centres - centres.mean(axis=0)
    centred = centred / np.sqrt((centred**2).sum(axis=1).mean())
    return angle.max(), np.linalg.norm(found_centres @ turn.T - centred, axis=1).max()


@given(st.integers(0, 10**6), st.booleans())
def test_known_cameras_are_recovered_from_any_projective_frame_and_never_mirrored(seed, mirrored):
    rotations, centres, matrices, spots = around(ratio=1.0, seed=seed)
    matrices, spots = transformed(matrices, spots, seed=seed, mirrored=mirrored)
    room = upgrade_to_metric(matrices, spots, is_focal_known=np.ones(6, dtype=bool), names=NAMES[:6])
    assert np.linalg.det(room.cam_from_world.rotation.as_matrix()) == pytest.approx(np.ones(6))
    # All expectations hold exactly, so the descent ends where its cost no longer falls: at the rounding of squares.
    # It stops after a step that lowers the cost by less than 1e-4 of itself; quadratic convergence brings 1e-6 before.
    assert max(differences(room, rotations, centres)) < 1e-5
    assert (room.focal_ratio == 1.0).all()


@given(st.integers(0, 10**6))
def test_unknown_focal_ratios_are_found(seed):
    ratio = np.random.default_rng(seed).uniform(0.5, 2.5, 6)
    rotations, centres, matrices, spots = around(ratio=ratio, seed=seed)
    matrices, spots = transformed(matrices, spots, seed=seed)
    room = upgrade_to_metric(matrices, spots, is_focal_known=np.zeros(6, dtype=bool), names=NAMES[:6])
    # The expectation of ratios near one (sigma log 3) pulls against square pixels (2 %) and principal points (0.1) of
    # six cameras: what is known ten times better gives way by a hundredth.
    np.testing.assert_allclose(room.focal_ratio, ratio, rtol=0.05)
    assert max(differences(room, rotations, centres)) < 0.05


@pytest.mark.parametrize("seed", range(30))
def test_three_cameras_from_wide_to_telephoto_do_not_end_in_a_local_minimum(seed):
    ratio = np.random.default_rng(seed).uniform(0.3, 4.0, 3)
    _, _, matrices, spots = around(3, ratio=ratio, principal=0.03, seed=seed)
    matrices, spots = transformed(matrices, spots, seed=seed)
    room = upgrade_to_metric(matrices, spots, is_focal_known=np.zeros(3, dtype=bool), names=NAMES[:3])
    # What the joint engine is promised. From a single start, 6 of these 30 end in another minimum.
    np.testing.assert_allclose(room.focal_ratio, ratio, rtol=0.2)


def test_one_known_camera_sharpens_the_others():
    ratio = np.array([1.0, 0.7, 1.3, 0.8])
    _, _, matrices, spots = around(4, ratio=ratio, seed=3)
    matrices, spots = transformed(matrices, spots, seed=3)
    known = np.array([True, False, False, False])
    room = upgrade_to_metric(matrices, spots, is_focal_known=known, names=NAMES[:4])
    assert room.focal_ratio[0] == 1.0
    # As above, and one camera is held to 2 %.
    np.testing.assert_allclose(room.focal_ratio, ratio, rtol=0.03)


def test_a_principal_point_off_the_centre_goes_into_the_rotation():
    ratio, off = 1.0, 0.04  # 26 px of 640
    rotations, _, matrices, spots = around(ratio=np.full(6, ratio), principal=off)
    matrices, spots = transformed(matrices, spots, seed=1)
    room = upgrade_to_metric(matrices, spots, is_focal_known=np.zeros(6, dtype=bool), names=NAMES[:6])
    # Off on both axes, the axis through the image centre turns by sqrt(2) off / ratio; half as much again for what the
    # focal lengths, bent by the wrong principal points, add.
    assert differences(room, rotations, np.eye(6, 3))[0] < 1.5 * np.sqrt(2) * off / ratio


def test_centres_are_centred_and_of_unit_size():
    _, _, matrices, spots = around(ratio=1.0)
    room = upgrade_to_metric(matrices, spots, is_focal_known=np.ones(6, dtype=bool), names=NAMES[:6])
    centres = room.cam_from_world.inv().translation
    np.testing.assert_allclose(centres.mean(axis=0), 0, atol=1e-12)
    assert np.sqrt((centres**2).sum(axis=1).mean()) == pytest.approx(1)


def test_cameras_without_square_pixels_are_refused():
    _, _, matrices, spots = around(ratio=1.0)
    matrices[:, 0] *= np.array([1.0, 2.0, 0.5, 2.0, 1.0, 0.5])[:, None]
    with pytest.raises(DegenerateError, match="no metric frame"):
        upgrade_to_metric(matrices, spots, is_focal_known=np.zeros(6, dtype=bool), names=NAMES[:6])


def test_a_focal_ratio_out_of_range_names_the_camera():
    _, _, matrices, spots = around(ratio=np.array([1.0, 0.8, 1.2, 1.0, 9.0, 1.0]))
    with pytest.raises(DegenerateError, match=r"out of 0\.2\.\.5\.0: E "):
        upgrade_to_metric(matrices, spots, is_focal_known=np.zeros(6, dtype=bool), names=NAMES[:6])


def test_an_inside_out_room_is_refused():
    _, _, matrices, spots = around(ratio=1.0)
    spots[::2] *= -1  # half of the spots behind all cameras
    with pytest.raises(DegenerateError, match="wrong side"):
        upgrade_to_metric(matrices, spots, is_focal_known=np.ones(6, dtype=bool), names=NAMES[:6])
    _, _, matrices, spots = around(ratio=1.0)
    matrices[:3] *= -1  # all spots behind half of the cameras
    with pytest.raises(DegenerateError, match="wrong side"):
        upgrade_to_metric(matrices, spots, is_focal_known=np.ones(6, dtype=bool), names=NAMES[:6])


def test_jacobian_of_the_deviations_against_differences():
    rng = np.random.default_rng(0)
    _, _, matrices, _ = around(ratio=np.linspace(0.6, 1.6, 6), principal=0.05)
    expected = metric_upgrade._Expected.of(np.array([True, False] * 3))
    frames = np.eye(4, 3) + 0.1 * rng.standard_normal((2, 4, 3))
    _, jacobian = metric_upgrade._deviations(frames, matrices, expected)
    step = 1e-6
    for k in range(12):
        change = (step * (np.arange(12) == k)).reshape(4, 3)
        above, _ = metric_upgrade._deviations(frames + change, matrices, expected)
        below, _ = metric_upgrade._deviations(frames - change, matrices, expected)
        # Deviations reach some 1e3, so differences carry 1e3 * 1e-16 / 1e-6 of rounding: 1e-7 of slopes near 1e3.
        np.testing.assert_allclose(jacobian[..., k], (above - below) / (2 * step), rtol=1e-5, atol=1e-3)
