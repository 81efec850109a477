"""The ball's light in the image against integrals that can be done by hand or by brute force."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from network_calib.cameras import Cameras, LensModel, poses_from_centres
from network_calib.synthetic import room
from network_calib.synthetic_rooms import look_at
from nodes.simulated.rendering.camera_view import CameraView
from nodes.simulated.rendering.spot_image import (
    Ball,
    Beams,
    beams_of_ball,
    patch_of,
    ring_places,
    ring_spread,
    ring_weights,
)

SIGMA_PX = 0.75
PINHOLE_PX = 500.0


def pinhole_view():
    """At the origin, looking along world x without distortion: y is left, z is up."""
    centre = np.zeros((1, 3))
    return CameraView.of(
        Cameras(
            ("C0",),
            np.array([[640, 480]]),
            (LensModel.NONE,),
            np.array([[PINHOLE_PX, PINHOLE_PX, 319.5, 239.5, 0, 0, 0, 0]]),
            poses_from_centres(look_at(centre, np.array([[1.0, 0.0, 0.0]])), centre),
        ),
        0,
    )


def nothing_hidden(targets):
    return np.zeros(len(targets), dtype=bool)


def beams_at(view, places, ball, sigma_px=SIGMA_PX, is_hidden=nothing_hidden):
    return beams_of_ball(view, np.atleast_2d(places), ball, level=1.0, sigma_px=sigma_px, is_hidden=is_hidden)


def moments(patch):
    """Total, centre (2,) and variance (2,) of a patch's pixels."""
    y, x = np.mgrid[: patch.values.shape[0], : patch.values.shape[1]]
    total = patch.values.sum()
    places = np.stack([x + patch.x, y + patch.y])
    centre = (places * patch.values).sum(axis=(1, 2)) / total
    return total, centre, ((places - centre[:, None, None]) ** 2 * patch.values).sum(axis=(1, 2)) / total


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.3, 3.0))
def test_pixels_hold_all_of_a_beams_light_around_its_place(shift_x, shift_y, sigma_px):
    px = np.array([[100 + shift_x, 80 + shift_y]])
    total, centre, variance = moments(patch_of(Beams(px, np.array([2.0])), sigma_px=sigma_px, size_px=(640, 480)))
    # Beyond 5 sigma on both axes lie 4 x 2.9e-7 of the light; the cuts on both sides are up to a pixel apart.
    assert total == pytest.approx(2.0, rel=2e-6)
    # Light counts at its pixel's middle: rounding shifts the mean by sin(2 pi s) exp(-2 pi^2 sigma^2) / pi and smaller
    # harmonics, and adds 1/12 to the variance, up to harmonics of (1 / pi^2 + 4 sigma^2) exp(-2 pi^2 sigma^2).
    first, second = (np.exp(-2 * (n * np.pi * sigma_px) ** 2) for n in (1, 2))
    assert centre == pytest.approx(px[0], abs=first / np.pi + second + 1e-5 * sigma_px)
    ripple = (0.2 + 4 * sigma_px**2) * first + 4 * sigma_px**2 * second + 1e-4 * sigma_px**2
    assert variance == pytest.approx(np.full(2, sigma_px**2 + 1 / 12), abs=ripple)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("n_rings", [1, 3, 8])
def test_rings_hold_the_discs_light_and_size(exponent, n_rings):
    rho, turn = ring_places(n_rings)
    weight = ring_weights(n_rings, exponent)
    # Integral of (1 - q)^e over q = rho^2 from 0 to 1.
    assert weight.sum() == pytest.approx(1 / (exponent + 1))
    places = rho[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    assert weight @ places == pytest.approx([0, 0], abs=1e-12)
    # Mean of rho^2 under the profile is 1 / (e + 2). An even disc is exact by the spread. Under a steep one the light
    # of a ring of width w lies farther in, by w^2 / 12 times the profile's slope: 2 e rho / (1 - rho^2), whose mean,
    # times 2 rho, is w^2 / 3 for every e.
    mean = weight @ rho**2 / weight.sum() + 2 * ring_spread(n_rings) ** 2
    assert mean == pytest.approx(1 / (exponent + 2), abs=0.4 / (n_rings + 0.5) ** 2 if exponent else 1e-12)


def test_a_ball_ahead_has_the_light_and_size_of_its_disc():
    ball, distance_m = Ball(diameter_m=0.06, limb_exponent=0.0), 5.0
    beams, visible_part = beams_at(pinhole_view(), [distance_m, 0.0, 0.0], ball)
    radius_px = PINHOLE_PX * 0.03 / distance_m
    total, centre, variance = moments(patch_of(beams, sigma_px=SIGMA_PX, size_px=(640, 480)))
    assert visible_part == 1.0
    assert total == pytest.approx(np.pi * radius_px**2, rel=1e-4)
    assert centre == pytest.approx([319.5, 239.5], abs=1e-5)
    # An even disc's variance per axis is R^2 / 4; the pixels add 1/12.
    assert variance == pytest.approx(np.full(2, radius_px**2 / 4 + SIGMA_PX**2 + 1 / 12), abs=1e-3)


def test_a_wide_disc_is_as_bright_as_its_radiance_wherever_it_is():
    ball = Ball(diameter_m=0.5, limb_exponent=0.0)
    for place in ([10.0, 0.0, 0.0], [5.0, 0.0, 0.0], [8.0, 3.0, 1.0]):
        beams, _ = beams_at(pinhole_view(), place, ball)
        patch = patch_of(beams, sigma_px=SIGMA_PX, size_px=(640, 480))
        assert patch is not None
        assert patch.values.max() == pytest.approx(1.0, abs=0.05)


def test_perspective_and_distortion_shift_the_disc_as_brute_force_says():
    view = CameraView.of(room("smart_room", rng=np.random.default_rng(1), n_frames=2).cameras, 0)
    ray = view.rotation.T @ np.array([0.55, 0.4, 1.0])
    place, radius_m = view.centre_in_world + 1.5 * ray, 0.12
    beams, _ = beams_at(view, place, Ball(diameter_m=2 * radius_m, limb_exponent=0.0))
    # Directions evenly over the cone: a golden spiral of many.
    n = 20_000
    axis, distance_m = (place - view.centre_in_world), np.linalg.norm(place - view.centre_in_world)
    across = np.cross(axis, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(axis / distance_m, across)
    rho, turn = np.sqrt((np.arange(n) + 0.5) / n), np.pi * (3 - np.sqrt(5)) * np.arange(n)
    sine = (rho * radius_m / distance_m)[:, None]
    rays = np.sqrt(1 - sine**2) * axis / distance_m
    rays = rays + sine * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * up)
    px, _ = view.project(view.centre_in_world + rays)
    expected = px.mean(axis=0)
    centre_px, _ = view.project(place)
    shift_px = np.linalg.norm(expected - centre_px)
    assert shift_px > 0.1  # else this test would see nothing
    # Rings have the exact second moment but for their middle, so the shift (quadratic in the size) is right to 1/D^2,
    # and its fourth order to a few percent of radius^2 / distance^2.
    assert np.linalg.norm(beams.centroid_px - expected) < 0.01 * shift_px


def test_even_motion_smears_evenly_around_mid_exposure():
    view, length_px, n = pinhole_view(), 12.0, 31
    part = (np.arange(n) + 0.5) / n - 0.5
    # 5 m ahead a pixel is 1 cm; image x is world -y.
    places = np.array([5.0, 0.004, 0.003]) + part[:, None] * np.array([0.0, -0.01 * length_px, 0.0])
    beams, _ = beams_at(view, places, Ball(diameter_m=0.005, limb_exponent=0.0))
    _, centre, variance = moments(patch_of(beams, sigma_px=SIGMA_PX, size_px=(640, 480)))
    assert centre == pytest.approx([319.5 - 0.4, 239.5 - 0.3], abs=1e-4)
    # n equal steps have the variance L^2 / 12 (1 - 1 / n^2); the ball adds (0.25 px)^2 / 4.
    still = SIGMA_PX**2 + 1 / 12 + 0.25**2 / 4
    assert variance == pytest.approx([still + length_px**2 / 12 * (1 - 1 / n**2), still], abs=2e-3)


def test_what_is_hidden_gives_no_light():
    view, ball, place = pinhole_view(), Ball(diameter_m=0.1, limb_exponent=0.0), np.array([5.0, 0.0, 0.0])
    whole, _ = beams_at(view, place, ball)
    half, visible_part = beams_at(view, place, ball, is_hidden=lambda targets: targets[:, 1] > 1e-9)
    # The rings' places on the edge itself count as open: at most one in each ring and the middle one.
    assert visible_part == pytest.approx(0.5, abs=0.06)
    assert half.total == pytest.approx(visible_part * whole.total)
    # World y > 0 is the left half of the image: the centre of a half disc is 4 R / (3 pi) from its edge.
    radius_px = 5.0
    assert half.centroid_px[0] == pytest.approx(319.5 + 4 * radius_px / (3 * np.pi), abs=0.06 * radius_px)
    nothing, visible_part = beams_at(view, place, ball, is_hidden=lambda targets: np.ones(len(targets), dtype=bool))
    assert visible_part == 0
    assert patch_of(nothing, sigma_px=SIGMA_PX, size_px=(640, 480)) is None


def test_light_beside_the_image_gives_no_patch_and_at_the_rim_only_what_falls_in():
    one = np.array([1.0])
    assert patch_of(Beams(np.array([[-20.0, 50.0]]), one), sigma_px=1.0, size_px=(640, 480)) is None
    # The image begins at -0.5.
    rim = patch_of(Beams(np.array([[-0.5, 50.0]]), one), sigma_px=1.0, size_px=(640, 480))
    assert rim is not None
    assert (rim.x, rim.values.sum()) == (0, pytest.approx(0.5, abs=1e-5))
