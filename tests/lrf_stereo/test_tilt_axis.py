"""Equations 10 to 13 by hand, their errors as the review of the paper measured them, and the general axis."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from lrf_stereo.scanner import TiltingScanner
from lrf_stereo.tilt_axis import axis_from_lrf, cam_from_axis, circumradius, paper_axis, screw_axis
from network_calib.errors import DegenerateError, InputError

SEEDS = st.integers(0, 2**32 - 1)
PAPER_TILTS, FIG_8_TILTS = np.deg2rad([12.1, 23.2, 50.0]), np.deg2rad([2.0, 12.1, 23.2])


def random_motion(rng):
    return RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))


def test_equation_10_by_hand():
    # The circle about a right-angled triangle 3, 4, 5 has half the hypotenuse as radius: 3 * 4 * 5 / (4 * 6).
    assert circumradius(np.array([[1.0, 1, 7], [4, 1, 7], [1, 5, 7]])) == pytest.approx(2.5, abs=1e-15)


def test_equation_11_by_hand():
    expected = [[0, 0, 1, 0.07], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
    assert axis_from_lrf(0.07, np.pi / 2).as_matrix() == pytest.approx(np.array(expected), abs=1e-15)
    expected = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.07], [0, 0, 0, 1]]
    assert axis_from_lrf(0.07, 0.0).as_matrix() == pytest.approx(np.array(expected), abs=1e-15)


def test_equation_13_by_hand():
    # An LRF at (1, 2, 3), unturned, at tilt zero: I is 0.07 below it.
    lrf = RigidTransform.from_translation([1.0, 2.0, 3.0])
    assert cam_from_axis(lrf, 0.07, 0.0).translation == pytest.approx([1, 2, 2.93], abs=1e-15)
    # At a quarter turn down, the LRF's x is I's -z: I is turned the other way, and its z points to the LRF's -x... so
    # the LRF, on I's x axis, is 0.07 along its own z from I.
    turned = cam_from_axis(lrf, 0.07, np.pi / 2)
    assert turned.translation == pytest.approx([1, 2, 2.93], abs=1e-15)
    assert turned.apply([0.07, 0, 0]) == pytest.approx([1, 2, 3], abs=1e-15)


@given(SEEDS)
def test_where_dx_is_zero_the_paper_is_exact(seed):
    rng = np.random.default_rng(seed)
    truth = TiltingScanner.from_paper(random_motion(rng), 0.0, rng.uniform(0.03, 0.2))
    found, tilts = paper_axis(truth.world_from_lrf_at(PAPER_TILTS), PAPER_TILTS), np.deg2rad([-30, 0, 30, 60])
    # The sagitta of 0.03 m over 38 degrees is 1.6 mm: 1e-15 m of rounding becomes 1e-15 * (30 / 1.6)^2 = 4e-13.
    expected = truth.world_from_lrf_at(tilts).as_matrix()
    assert found.world_from_lrf_at(tilts).as_matrix() == pytest.approx(expected, abs=1e-11)


# Millimetres at 10, 20, 38 and 60 degrees from the first tilt; given to two digits, so right to half of the second.
PHASE_ERRORS_MM = {
    (10, 70): (1.7, 3.5, 6.5, 10), (20, 60): (3.5, 7, 13, 20), (40, 60): (7, 15, 27, 42), (60, 40): (12, 24, 44, 68),
    (70, 0): (17, 34, 64, 99),
}  # fmt: skip


@pytest.mark.parametrize(("offset_mm", "error_mm"), PHASE_ERRORS_MM.items())
def test_phase_error_of_equation_11(offset_mm, error_mm):
    dx, dz = np.array(offset_mm) / 1e3
    rng = np.random.default_rng(0)
    truth, away = TiltingScanner.from_paper(random_motion(rng), dx, dz), np.deg2rad([10, 20, 38, 60])
    first = PAPER_TILTS[0]
    found = paper_axis(truth.world_from_lrf_at(PAPER_TILTS), PAPER_TILTS)
    shift = found.world_from_lrf_at(first + away).translation - truth.world_from_lrf_at(first + away).translation
    error = np.linalg.norm(shift, axis=1)
    d = np.hypot(dx, dz)
    closed_form = 2 * np.sin(away / 2) * np.hypot(dx, dz - d)
    # The rounding of the circle, as above.
    assert error == pytest.approx(closed_form, abs=1e-11)
    half_digit = [0.05 if mm < 10 and mm != int(mm) else 0.5 for mm in error_mm]
    assert (np.abs(1e3 * error - error_mm) <= half_digit).all()
    at_first = found.world_from_lrf_at(first).as_matrix()
    assert at_first == pytest.approx(truth.world_from_lrf_at(first).as_matrix(), abs=1e-14)


# (tilts, sigma of each origin) -> median of equation 10 and rms error of the known-angle solution, mm, for d = 70 mm.
RADIUS_ROWS = [
    (PAPER_TILTS, 1, 65, 2.1), (PAPER_TILTS, 5, 33, 10.5), (FIG_8_TILTS, 1, 47, 3.8), (FIG_8_TILTS, 5, 16, 19),
    (np.deg2rad([-45, 0, 45]), 5, 69, 4.8),
]  # fmt: skip


@pytest.mark.parametrize(("tilts", "sigma_mm", "median_mm", "rms_mm"), RADIUS_ROWS)
def test_equation_10_is_biased_where_the_known_angles_are_not(tilts, sigma_mm, median_mm, rms_mm):
    rng, n = np.random.default_rng(1), 600
    truth = TiltingScanner.from_paper(RigidTransform.identity(), 0.0, 0.07)
    exact = truth.world_from_lrf_at(tilts)
    radius, distance = np.empty(n), np.empty(n)
    for k in range(n):
        origins = exact.translation + 1e-3 * sigma_mm * rng.standard_normal((3, 3))
        radius[k] = circumradius(origins)
        distance[k] = screw_axis(RigidTransform.from_components(origins, exact.rotation), tilts).as_paper().d_m
    low, middle, high = np.percentile(radius, [25, 50, 75]) * 1e3
    # A median of n draws has an sd of about (quartile range) / (1.08 sqrt(n)) around a bell; four, and the rounding.
    assert middle == pytest.approx(median_mm, abs=0.5 + 4 * (high - low) / (1.08 * np.sqrt(n)))
    # An rms of n draws has a relative sd of 1 / sqrt(2 n) = 2.9 %; four, and 2.5 % rounding.
    rms = 1e3 * np.sqrt(((distance - 0.07) ** 2).mean())
    assert rms == pytest.approx(rms_mm, rel=0.14)


def any_scanner(rng):
    """Any axis and mount."""
    return TiltingScanner(random_motion(rng), rng.normal(size=3), rng.normal(size=3), reference_tilt_rad=0.2)


@given(SEEDS, st.integers(2, 6))
def test_exact_poses_give_any_axis(seed, n):
    rng = np.random.default_rng(seed)
    truth, tilts = any_scanner(rng), rng.uniform(0, 0.9, n)
    tilts[:2] = 0.1, 0.1 + np.deg2rad(6)  # the least span is just above five degrees
    found, checked = screw_axis(truth.world_from_lrf_at(tilts), tilts), np.linspace(-1, 1, 7)
    # Rounding of 1e-15 on arms of metres, over a span of 0.1 rad, twice.
    expected = truth.world_from_lrf_at(checked).as_matrix()
    assert found.world_from_lrf_at(checked).as_matrix() == pytest.approx(expected, abs=1e-11)
    assert found.axis_direction_in_world == pytest.approx(truth.axis_direction_in_world, abs=1e-11)
    assert found.axis_point_in_world == pytest.approx(truth.axis_point_in_world, abs=1e-10)
    assert found.reference_tilt_rad == pytest.approx(tilts.mean())


@given(SEEDS)
def test_the_axis_moves_with_the_camera(seed):
    rng = np.random.default_rng(seed)
    truth, motion = any_scanner(rng), random_motion(rng)
    exact = truth.world_from_lrf_at(PAPER_TILTS)
    jitter = RigidTransform.from_components(
        0.005 * rng.normal(size=(3, 3)), Rotation.from_rotvec(0.005 * rng.normal(size=(3, 3)))
    )
    noisy = exact * jitter
    for method in (paper_axis, screw_axis):
        here, there = method(noisy, PAPER_TILTS), method(motion * noisy, PAPER_TILTS)
        expected = here.moved_by(motion).world_from_lrf_at(FIG_8_TILTS).as_matrix()
        assert there.world_from_lrf_at(FIG_8_TILTS).as_matrix() == pytest.approx(expected, abs=1e-9)


def test_a_tilt_that_counts_the_other_way_turns_the_axis_around():
    truth = any_scanner(np.random.default_rng(3))
    found = screw_axis(truth.world_from_lrf_at(PAPER_TILTS), -PAPER_TILTS)
    assert found.axis_direction_in_world == pytest.approx(-truth.axis_direction_in_world, abs=1e-12)


@pytest.mark.parametrize("span_deg", [0.0, 3.0, 4.99])
def test_tilts_that_span_less_than_five_degrees_are_refused(span_deg):
    truth, tilts = any_scanner(np.random.default_rng(0)), np.deg2rad([10, 10 + span_deg / 2, 10 + span_deg])
    with pytest.raises(DegenerateError, match=rf"span {span_deg:.1f} degrees: the tilt axis is unobservable"):
        screw_axis(truth.world_from_lrf_at(tilts), tilts)
    wider = np.deg2rad([10, 15.01])
    assert screw_axis(truth.world_from_lrf_at(wider), wider).tilt_gain == 1


def test_wrong_numbers_of_tilts_are_refused():
    truth = any_scanner(np.random.default_rng(0))
    with pytest.raises(DegenerateError, match="2 tilts or more, got 1"):
        screw_axis(truth.world_from_lrf_at(PAPER_TILTS[:1]), PAPER_TILTS[:1])
    with pytest.raises(InputError, match="each pose needs its tilt"):
        screw_axis(truth.world_from_lrf_at(PAPER_TILTS), PAPER_TILTS[:2])
    for tilts in (PAPER_TILTS[:2], np.deg2rad([0, 10, 20, 30])):
        with pytest.raises(InputError, match=f"exactly 3 tilts, got {len(tilts)}"):
            paper_axis(truth.world_from_lrf_at(tilts), tilts)


def test_origins_on_one_line_have_no_circle():
    on_line = RigidTransform.from_translation(np.outer([0.0, 1.0, 3.0], [0.1, 0.2, 0.3]))
    with pytest.raises(DegenerateError, match="no circle"):
        paper_axis(on_line, PAPER_TILTS)
    # An LRF whose mirror lies on the axis does not move at all.
    with pytest.raises(DegenerateError, match="no circle"):
        paper_axis(RigidTransform.from_translation(np.zeros((3, 3))), PAPER_TILTS)
