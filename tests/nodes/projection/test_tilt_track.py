import numpy as np
import pytest

from lrf_stereo.tilt import ImuNoise
from nodes.bus import spotcal_pb2 as pb
from nodes.projection.errors import ErrorCode, ProjectionError
from nodes.projection.tilt_table import TiltTable
from nodes.projection.tilt_track import HAND_SIGMA_RAD, STEP_SIGMA_RAD, TiltTrack

START_NS = 1_700_000_000 * 10**9
RATE_HZ = 100.0
DEVICE_BEGAN_S = 5000.0
# The unit rests at A for 12 s, moves for 2 s, and rests at B.
A_RAD, B_RAD, LEAVES_S, ARRIVES_S = 0.2, 0.7, 12.0, 14.0


def ns(seconds):
    return START_NS + np.rint(1e9 * np.asarray(seconds)).astype(np.int64)


def sample(at_s, tilt_rad, setting=0, *, session="s", has_steps=True):
    header = pb.Header(node="n1", session=session, stamp_ns=int(ns(at_s)))
    return pb.TiltSample(header=header, lrf="L0", setting=setting, tilt_rad=tilt_rad, has_steps=has_steps)


def moving(at_s, *, node="n1"):
    return pb.NodeEvent(header=pb.Header(node=node, stamp_ns=int(ns(at_s))), text="moving")


def true_tilt_rad(time_s):
    """Half a cosine from A to B: as different from a straight line as a gentle unit moves."""
    share = np.clip((np.asarray(time_s) - LEAVES_S) / (ARRIVES_S - LEAVES_S), 0, 1)
    return A_RAD + (B_RAD - A_RAD) * (1 - np.cos(np.pi * share)) / 2


def imu_batches(until_s, *, rng=None, bias_rad_s=0.01, begin_s=0.0, boot=b"b", delay_s=0.0):
    """Samples of the move's rate about y, ten a batch; arrivals are late by up to 3 ms."""
    generator = rng or np.random.default_rng(1)
    times = np.arange(begin_s, until_s, 1 / RATE_HZ)
    rate = np.gradient(true_tilt_rad(times), 1 / RATE_HZ) + bias_rad_s
    if rng is not None:
        rate = rate + ImuNoise().gyro_rad_s_sqrt_hz * np.sqrt(RATE_HZ) * generator.standard_normal(len(times))
    late_s = generator.uniform(0, 3e-3, len(times)) + delay_s
    for k in range(0, len(times), 10):
        rows = slice(k, k + 10)
        yield pb.ImuBatch(
            header=pb.Header(node="n1", boot=boot),
            lrf="L0",
            device_s=times[rows] + DEVICE_BEGAN_S,
            arrival_ns=ns(times[rows] + late_s[rows]).tolist(),
            rate_rad_s=np.column_stack([np.full(len(times[rows]), 0.3), rate[rows], -rate[rows]]).ravel(),
        )


def track_of(*, imu_until_s=None, is_over=True, rng=None):
    track = TiltTrack()
    track.rest(sample(0.0, A_RAD))
    for batch in () if imu_until_s is None else imu_batches(imu_until_s, rng=rng):
        track.turn(batch)
    track.leave(int(ns(LEAVES_S)))
    if is_over:
        track.rest(sample(ARRIVES_S, B_RAD, 1))
    return track


def test_at_rest_the_tilt_is_what_the_unit_told():
    track = track_of()
    tilt_rad, sigma_rad = track.at(ns([0.0, 5.0, LEAVES_S, ARRIVES_S, 100.0]))
    assert tilt_rad.tolist() == [A_RAD, A_RAD, A_RAD, B_RAD, B_RAD]
    assert sigma_rad.tolist() == [STEP_SIGMA_RAD] * 5


def test_before_the_first_rest_nothing_is_known():
    tilt_rad, sigma_rad = track_of().at(ns([-1.0, 1.0]))
    assert np.isnan(tilt_rad).tolist() == np.isnan(sigma_rad).tolist() == [True, False]


def test_a_tilt_by_hand_is_less_certain_until_the_fused_angles_come():
    track = TiltTrack()
    track.rest(sample(0.0, A_RAD, 0, has_steps=False))
    assert track.at(ns(1.0))[1] == HAND_SIGMA_RAD
    settings = pb.TiltSettings(
        header=pb.Header(session="s"), lrf="L0", angle_rad=[0.25, 0.5], covariance_rad2=[1e-6, 0, 0, 4e-6]
    )
    track.settle(settings)
    assert [column[0] for column in track.at(ns(1.0))] == [0.25, pytest.approx(1e-3)]
    settings.header.session, settings.angle_rad[0] = "another", 0.9
    track.settle(settings)
    assert track.at(ns(1.0))[0] == 0.25


def test_while_it_moves_without_a_gyroscope_nothing_is_known():
    tilt_rad, _ = track_of(is_over=False).at(ns([LEAVES_S, LEAVES_S + 0.1]))
    assert np.isnan(tilt_rad).tolist() == [False, True]


def test_a_move_that_is_over_is_bridged_and_the_bridge_is_least_certain_in_its_middle():
    times = np.linspace(LEAVES_S, ARRIVES_S, 41)
    tilt_rad, sigma_rad = track_of().at(ns(times))
    assert np.allclose(tilt_rad, np.linspace(A_RAD, B_RAD, 41))
    assert sigma_rad.argmax() == 20
    # Known to lie between two values, it is within 1.73 sigma of their middle.
    assert (np.abs(tilt_rad - true_tilt_rad(times)) <= np.sqrt(3) * sigma_rad).all()


def test_each_beam_of_a_sweep_has_the_tilt_of_its_own_time():
    times = LEAVES_S + 1.0 + np.linspace(0, 0.025, 1081)
    tilt_rad, _ = track_of().at(ns(times))
    assert np.allclose(np.diff(tilt_rad), (B_RAD - A_RAD) / 2 * 0.025 / 1080, rtol=1e-3)


def test_a_rest_that_nobody_ended_is_sure_only_at_its_begin():
    track = TiltTrack()
    track.rest(sample(0.0, A_RAD))
    assert track.at(ns(10.0))[0] == A_RAD
    track.rest(sample(20.0, B_RAD, 1))
    tilt_rad, sigma_rad = track.at(ns(10.0))
    assert tilt_rad == pytest.approx((A_RAD + B_RAD) / 2)
    assert sigma_rad == pytest.approx((B_RAD - A_RAD) / np.sqrt(12), rel=1e-3)


def test_the_gyroscope_shows_the_way_while_it_moves_and_after():
    times = np.linspace(LEAVES_S, ARRIVES_S - 0.05, 50)
    for is_over in (False, True):
        track = track_of(imu_until_s=16.0, is_over=is_over)
        tilt_rad, sigma_rad = track.at(ns(times))
        # Stamps are wrong by the least delay of the arrivals, within 0.1 ms; the rate is 0.8 rad/s at most.
        assert np.abs(tilt_rad - true_tilt_rad(times)).max() < 5e-4
        assert (np.diff(sigma_rad[:-10]) > 0).all() or is_over
    assert sigma_rad.max() < 3e-3


def test_the_sigma_of_a_move_by_gyroscope_is_that_of_many_moves():
    at_s = np.array([LEAVES_S + 1.0, ARRIVES_S - 0.1])
    errors, told = [], []
    for seed in range(150):
        tilt_rad, sigma_rad = track_of(imu_until_s=16.0, is_over=False, rng=np.random.default_rng(seed)).at(ns(at_s))
        errors.append(tilt_rad - true_tilt_rad(at_s))
        told.append(np.sqrt(sigma_rad**2 - STEP_SIGMA_RAD**2))
    # 150 draws know their standard deviation to 1 / sqrt(300) = 6 %; four times that.
    assert np.allclose(np.std(errors, axis=0), np.mean(told, axis=0), rtol=0.24)


def test_beyond_the_last_sample_the_tilt_is_less_certain_and_then_not_known():
    track = track_of(imu_until_s=LEAVES_S + 1.0, is_over=False)
    times = LEAVES_S + 1.0 + np.array([-0.02, 0.05, 0.1, 0.5])
    tilt_rad, sigma_rad = track.at(ns(times))
    assert np.isfinite(tilt_rad).tolist() == [True, True, True, False]
    assert (np.abs(tilt_rad - true_tilt_rad(times))[:3] <= 2 * sigma_rad[:3]).all()
    assert sigma_rad[2] > 1.5 * sigma_rad[1] > 3 * sigma_rad[0]


def test_samples_that_are_missing_from_a_move_leave_it_to_the_straight_line():
    track = TiltTrack()
    track.rest(sample(0.0, A_RAD))
    for batch in (*imu_batches(12.5), *imu_batches(16.0, begin_s=13.0)):
        track.turn(batch)
    track.leave(int(ns(LEAVES_S)))
    assert np.isfinite(track.at(ns([12.4, 13.5]))[0]).tolist() == [True, False]
    track.rest(sample(ARRIVES_S, B_RAD, 1))
    assert track.at(ns(13.5))[0] == pytest.approx(A_RAD + 0.75 * (B_RAD - A_RAD))


def test_an_imu_that_was_started_again_begins_anew():
    track = track_of(imu_until_s=11.9, is_over=False)
    for batch in imu_batches(13.0, begin_s=12.0, boot=b"c"):
        track.turn(batch)
    # Of the rest before the move the new trace knows nothing, and so not its bias.
    assert np.isnan(track.at(ns(12.5))[0]).all()


def test_a_table_knows_lrfs_apart_and_tells_what_it_does_not_know():
    table = TiltTable()
    with pytest.raises(ProjectionError, match="its node has told none") as caught:
        table.at("L0", ns(1.0))
    assert caught.value.code is ErrorCode.NO_TILT
    table.take(sample(0.0, A_RAD))
    assert table.at("L0", ns(5.0))[0] == A_RAD
    table.take(moving(3.0, node="n2"))
    assert table.at("L0", ns(5.0))[0] == A_RAD
    table.take(moving(4.0))
    with pytest.raises(ProjectionError, match="it moved"):
        table.at("L0", ns(5.0))
    tilt_rad, _ = table.at("L0", ns([3.0, 5.0]))
    assert np.isnan(tilt_rad).tolist() == [False, True]


def test_a_long_recording_keeps_its_memory_and_its_rests_in_order():
    track = TiltTrack()
    for k in range(2000):
        track.rest(sample(10.0 * k, 1e-4 * k, k % 250))
        track.leave(int(ns(10.0 * k + 8)))
    assert track.at(ns(19_995.0 - 1))[0] == pytest.approx(1e-4 * 1999)
    assert np.isnan(track.at(ns(100.0))[0]).all()
    track.rest(sample(5.0, 1.0))
    assert np.isnan(track.at(ns(6.0))[0]).all()
