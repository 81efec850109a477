"""Tilt angles: each source by hand, the fusion against Monte Carlo, and what is refused."""

import numpy as np
import pytest

from lrf_stereo.tilt import ImuNoise, Tilts, Turns, fuse_tilts, gravity_tilts, gyro_turns, step_tilts
from network_calib.errors import InputError

PERIOD_S = 0.02
NOISE = ImuNoise()


def timeline(rest_s, move_s, n_settings):
    """Times, and the setting of each sample."""
    rest, move = round(rest_s / PERIOD_S), round(move_s / PERIOD_S)
    parts = [part for k in range(n_settings) for part in (np.full(move - 1, -1), np.full(rest, k))][1:]
    setting = np.concatenate(parts)
    return np.arange(len(setting), dtype=np.float64) * PERIOD_S, setting


def test_positions_of_the_paper_tilts():
    # 235, 451, 972 positions up of 185.1428 arcsec are 12.086, 23.194, 49.989 degrees up: tilts below zero.
    tilts = step_tilts([235, 451, 972])
    assert np.rad2deg(tilts.angle_rad) == pytest.approx([-12.086, -23.194, -49.989], abs=5e-4)
    # 0.0514 deg / sqrt(12).
    assert np.rad2deg(tilts.sigma_rad) == pytest.approx([0.014846] * 3, abs=1e-6)
    down = step_tilts([100, 110], arcsec_per_step=3600, zero_count=100, tilt_sign=1)
    assert np.rad2deg(down.angle_rad) == pytest.approx([0, 10])


@pytest.mark.parametrize("change", [{"tilt_sign": 0}, {"arcsec_per_step": 0.0}, {"arcsec_per_step": np.nan}])
def test_impossible_tilt_units_are_refused(change):
    with pytest.raises(InputError, match="tilt sign"):
        step_tilts([0, 1], **change)


def test_gravity_by_hand():
    # Nose down by a: up, seen from the sensor, leans back: (-sin a, 0, cos a) g; a roll of the base does not matter.
    angle = np.deg2rad([0, 30, -20])
    roll = 0.1
    up = 9.81 * np.stack([-np.sin(angle) * np.cos(roll), np.full(3, np.sin(roll)), np.cos(angle) * np.cos(roll)], 1)
    stamp, setting = timeline(1.0, 0.1, 3)
    samples = np.where(setting[:, None] >= 0, up[setting], [3.0, 3.0, 3.0])
    tilts = gravity_tilts(samples, stamp, setting)
    assert tilts.angle_rad == pytest.approx(angle, abs=1e-12)
    # 0.2 deg and 0.12 m/s/sqrt(h) = 0.002 m/s2/sqrt(Hz) over 1 s, on 9.81 cos(roll).
    expected = np.hypot(np.deg2rad(0.2), 0.002 / (9.81 * np.cos(roll)))
    assert tilts.sigma_rad == pytest.approx([expected] * 3, rel=1e-12)


def test_gravity_is_refused_in_motion_and_about_a_vertical_axis():
    stamp, setting = timeline(1.0, 0.1, 2)
    still = np.tile([0.0, 0.0, 9.81], (len(stamp), 1))
    with pytest.raises(InputError, match=r"setting 1 is 11\.00 m/s2: the sensor was not at rest"):
        gravity_tilts(np.where(setting[:, None] == 1, [0, 0, 11.0], still), stamp, setting)
    with pytest.raises(InputError, match="within 10 degrees of the vertical"):
        gravity_tilts(still, stamp, setting, axis_in_imu=np.array([0.1, 0, 1.0]))


def test_gyroscope_integrates_turns_and_learns_its_bias():
    stamp, setting = timeline(5.0, 10.0, 3)
    # 499 samples of motion between two at rest: the trapezoid rule gives 499 periods of the rate.
    rate = np.deg2rad(np.where(setting < 0, 11.0 / (499 * PERIOD_S), 0.0) + 1.0)
    turns = gyro_turns(stamp, rate, setting)
    assert np.rad2deg(turns.turn_rad) == pytest.approx([11.0, 11.0], abs=1e-10)
    # 0.05^2 (10 + 100 / (2 * 5)) deg2 = (0.224 deg)^2; neighbours subtract one rest's bias: 0.05^2 * 100 / (4 * 5).
    # The ends of a move, 0.02 s, have half weights and are samples of the rests too: 0.05 off the 20.
    degrees = np.rad2deg(np.rad2deg(turns.covariance_rad2))
    assert degrees == pytest.approx(0.0025 * np.array([[20.0, 5.0], [5.0, 20.0]]), abs=0.0025 * 0.06)


def test_a_bias_that_drifts_linearly_cancels():
    stamp, setting = timeline(5.0, 10.0, 2)
    drift = np.deg2rad(1.0) + np.deg2rad(0.1) * stamp
    # A constant bias of the first rest alone would leave 0.1 deg/s2 * 7.5 s * 10 s = 7.5 degrees.
    assert gyro_turns(stamp, drift, setting).turn_rad == pytest.approx([0], abs=1e-12)


def test_gyroscope_covariance_is_that_of_monte_carlo():
    stamp, setting = timeline(3.0, 4.0, 3)
    rng, n = np.random.default_rng(5), 2000
    sigma = NOISE.gyro_rad_s_sqrt_hz / np.sqrt(PERIOD_S)
    runs = [gyro_turns(stamp, 0.02 + sigma * rng.standard_normal(len(stamp)), setting) for _ in range(n)]
    sample = np.cov(np.array([run.turn_rad for run in runs]).T)
    # Relative sd of a sample variance is sqrt(2 / n) = 0.032; four of them. The covariance's is no larger in units of
    # the variance.
    assert sample == pytest.approx(runs[0].covariance_rad2, abs=4 * np.sqrt(2 / n) * runs[0].covariance_rad2[0, 0])


def test_gyroscope_refuses_gaps_and_bad_settings():
    stamp, setting = timeline(1.0, 1.0, 2)
    rate = np.zeros(len(stamp))
    gap = ~((stamp > 1.2) & (stamp < 1.4))
    with pytest.raises(InputError, match=r"without gyroscope samples in the move to tilt setting 1"):
        gyro_turns(stamp[gap], rate[gap], setting[gap])
    with pytest.raises(InputError, match="two tilt settings or more, got 1"):
        gyro_turns(stamp, rate, np.where(setting == 1, -1, setting))
    with pytest.raises(InputError, match=r"in order .* got \[0, 50, 50\]"):
        gyro_turns(stamp, rate, np.where(setting >= 0, setting + 1, -1))
    with pytest.raises(InputError, match="must come in order"):
        gyro_turns(stamp, rate, np.where(setting >= 0, 1 - setting, -1))
    with pytest.raises(InputError, match="times that increase"):
        gyro_turns(stamp[::-1], rate, setting)


def sources(truth, rng, *, gravity_zero=0.02):
    """The three sources of the angles `truth` (T,), with their own noise; gravity with an unlevel base."""
    n = len(truth)
    step_sigma, gravity_sigma = np.deg2rad(0.015), np.deg2rad(0.2)
    turn_cov = np.deg2rad(0.05) ** 2 * (20 * np.eye(n - 1) + 5 * np.eye(n - 1, k=1) + 5 * np.eye(n - 1, k=-1))
    return {
        "steps": Tilts(truth + step_sigma * rng.standard_normal(n), step_sigma**2 * np.eye(n)),
        "gravity": Tilts(truth + gravity_zero + gravity_sigma * rng.standard_normal(n), gravity_sigma**2 * np.eye(n)),
        "gyro": Turns(np.diff(truth) + np.linalg.cholesky(turn_cov) @ rng.standard_normal(n - 1), turn_cov),
    }


@pytest.mark.parametrize(
    ("names", "n_dof"),
    [
        (("steps",), 0), (("gravity",), 0), (("gyro",), 0), (("steps", "gravity"), 3), (("steps", "gyro"), 3),
        (("gravity", "gyro"), 3), (("steps", "gravity", "gyro"), 6),
    ],
)  # fmt: skip
def test_fusion_against_monte_carlo(names, n_dof):
    truth, rng, n_runs = np.deg2rad([2.0, 12.1, 23.2, 50.0]), np.random.default_rng(8), 2000
    errors, chi2, fused = [], [], None
    for _ in range(n_runs):
        given = sources(truth, rng)
        fused = fuse_tilts(**{name: given[name] for name in names}).relative_to(0)
        errors.append(fused.angle_rad - (truth - truth[0]))
        chi2.append(fused.chi2)
    assert fused is not None
    assert fused.n_dof == n_dof
    # Sample variances have a relative sd of sqrt(2 / n), means an sd of sigma / sqrt(n); four of each.
    scale = fused.covariance_rad2.max()
    assert np.cov(np.array(errors).T) == pytest.approx(fused.covariance_rad2, abs=4 * np.sqrt(2 / n_runs) * scale)
    assert np.mean(errors, axis=0) == pytest.approx(np.zeros(4), abs=4 * np.sqrt(scale / n_runs))
    # chi2 has the variance 2 n_dof.
    assert np.mean(chi2) == pytest.approx(n_dof, abs=4 * np.sqrt(2 * n_dof / n_runs) + 1e-9)


def test_each_source_makes_the_fusion_better():
    given = sources(np.deg2rad([2.0, 12.1, 23.2]), np.random.default_rng(0))

    def sigma(*names):
        return fuse_tilts(**{name: given[name] for name in names}).relative_to(0).sigma_rad[-1]

    assert sigma("steps", "gravity", "gyro") < sigma("steps", "gyro") < sigma("steps")
    assert sigma("gravity", "gyro") < min(sigma("gravity"), sigma("gyro"))


def test_zero_is_that_of_the_finest_source():
    truth = np.deg2rad([2.0, 12.1, 23.2])
    given = sources(truth, np.random.default_rng(1), gravity_zero=np.deg2rad(3.0))
    # One degree is 60 sigma of the steps and 5 of gravity, far below gravity's zero of 3 degrees.
    assert fuse_tilts(steps=given["steps"], gravity=given["gravity"]).angle_rad == pytest.approx(truth, abs=0.017)
    assert fuse_tilts(gravity=given["gravity"]).angle_rad == pytest.approx(truth + np.deg2rad(3), abs=0.017)
    alone = fuse_tilts(gyro=given["gyro"])
    assert alone.angle_rad[0] == alone.sigma_rad[0] == 0


def test_lost_steps_are_seen_by_the_gyroscope():
    truth, rng = np.deg2rad([2.0, 12.1, 23.2]), np.random.default_rng(2)
    given = sources(truth, rng)
    assert fuse_tilts(**given).is_consistent
    # 40 positions of 0.0514 degrees: 2 degrees, nine sigma of a turn of 0.05 sqrt(20) = 0.22 degrees.
    lost = Tilts(given["steps"].angle_rad + np.deg2rad([0, 0, 2.06]), given["steps"].covariance_rad2)
    assert not fuse_tilts(steps=lost, gyro=given["gyro"]).is_consistent


def test_fusion_refuses_nothing_and_unequal_sources():
    with pytest.raises(InputError, match="no source"):
        fuse_tilts()
    with pytest.raises(InputError, match=r"one number of settings, got \[2, 3\]"):
        fuse_tilts(steps=step_tilts([0, 1]), gyro=Turns(np.zeros(2), np.eye(2)))
