"""The IMU's driver against the emulated unit, in virtual time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lrf_stereo.tilt import ImuNoise
from network_calib.errors import InputError, SpotcalError
from nodes.devices.errors import DeviceError, LineLostError
from nodes.devices.mti import Mti, NullImu
from nodes.devices.mti_frames import FrameParser, Mid, encode
from nodes.simulated.line_faults import LineFaults
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from nodes.simulated.mti_device import MtiDevice, MtiModel
from tests.nodes.simulated.babbler import Babbler

QUIET = ImuNoise(gyro_rad_s_sqrt_hz=0.0, acceleration_m_s2_sqrt_hz=0.0)
FORCE = np.array([0.2, 0.0, 9.8])


def turning(now_s):
    return np.array([0.0, 0.1 * now_s, 0.0]), FORCE


def resting(now_s):
    del now_s
    return np.zeros(3), FORCE


def perfect(**changes):
    none = (0.0, 0.0, 0.0)
    return MtiModel(
        noise=QUIET, gyro_bias_rad_s=none, gyro_walk_rad_s_sqrt_s=0.0, acceleration_bias_m_s2=none, **changes
    )


def line_to(model, *, faults=None, motion=turning):
    clock = VirtualClock()
    device = MtiDevice(motion, rng=np.random.default_rng(5), model=model)
    return LoopbackTransport(device, clock, faults=faults), clock


def collect(imu, clock, duration_s):
    samples, end_s = [], clock() + duration_s
    while clock() < end_s:
        samples += imu.read(min(0.1, end_s - clock()))
    return samples


@pytest.mark.parametrize("is_successor", [False, True])
def test_samples_are_the_motion_at_the_device_times(is_successor):
    line, clock = line_to(perfect(is_successor=is_successor, clock_gain=1.0))
    imu = Mti(line, clock=clock)
    imu.start()
    samples = collect(imu, clock, 2.0)
    assert len(samples) in (199, 200)
    assert [sample.sequence for sample in samples] == list(range(len(samples)))
    rate = np.array([sample.rate_rad_s for sample in samples])
    device_s = np.array([sample.device_s for sample in samples])
    # The rate grows by 0.1 rad/s each second of the device; its floats have 24 bits, its clock 0.1 ms.
    np.testing.assert_allclose(rate[:, 1] - rate[0, 1], 0.1 * device_s, atol=1.1e-5)
    np.testing.assert_allclose(
        [sample.acceleration_m_s2 for sample in samples], np.tile(FORCE, (len(samples), 1)), rtol=1e-6
    )
    assert imu.counts.missed == imu.counts.bad_sums == imu.counts.refused == 0


def test_the_successors_way_is_tried_first_and_the_legacy_way_after_its_refusal():
    sent = []

    class Spy(LoopbackTransport):
        def write(self, data: bytes) -> None:
            sent.extend(message.mid for message in FrameParser().feed(data))
            super().write(data)

    clock = VirtualClock()
    imu = Mti(Spy(MtiDevice(turning, rng=np.random.default_rng(0)), clock), clock=clock)
    imu.start()
    configured = [mid for mid in sent if mid not in (Mid.GO_TO_CONFIG, Mid.WAKE_UP_ACKNOWLEDGE)]
    assert configured == [
        Mid.SET_OUTPUT_CONFIGURATION, Mid.SET_OUTPUT_MODE, Mid.SET_OUTPUT_SETTINGS, Mid.SET_PERIOD,
        Mid.SET_SKIP_FACTOR, Mid.GO_TO_MEASUREMENT,
    ]  # fmt: skip


def test_counter_wraps_without_a_gap():
    clock = VirtualClock()
    device = MtiDevice(turning, rng=np.random.default_rng(5), model=perfect())
    imu = Mti(LoopbackTransport(device, clock), clock=clock)
    imu.start()
    device._counter = 65500
    samples = collect(imu, clock, 1.0)
    assert np.diff([sample.sequence for sample in samples]).tolist() == [1] * (len(samples) - 1)
    assert imu.counts.missed == 0


def test_lost_and_damaged_samples_are_counted_and_time_goes_on():
    faults = LineFaults(np.random.default_rng(2), flips_per_byte=1e-3)
    line, clock = line_to(perfect(clock_gain=1.0), faults=faults)
    imu = Mti(line, clock=clock)
    imu.start()
    samples = collect(imu, clock, 60.0)
    counts = imu.counts
    assert counts.missed > 0
    assert samples[-1].sequence + 1 == len(samples) + counts.missed
    # Only the last samples can be lost without a successor that shows it.
    assert 6000 - (len(samples) + counts.missed) <= 5
    rate = np.array([sample.rate_rad_s[1] for sample in samples])
    device_s = np.array([sample.device_s for sample in samples])
    wrong = np.abs(rate - rate[0] - 0.1 * device_s) > 1e-4
    # The sum is 8 bits: one flipped bit is always seen, of two flips in a frame one in some dozens is not. Frames of
    # 31 bytes have two flips with probability (31e-3)^2 / 2, so 3 in 6000.
    assert wrong.sum() <= 1


def test_device_time_runs_at_the_devices_rate():
    line, clock = line_to(perfect(is_successor=True, clock_gain=1 + 1e-3))
    imu = Mti(line, clock=clock)
    imu.start()
    samples = collect(imu, clock, 20.0)
    gain = (samples[-1].device_s - samples[0].device_s) / (samples[-1].arrival_s - samples[0].arrival_s)
    # 0.1 ms of the device's clock in 20 s.
    assert gain == pytest.approx(1 + 1e-3, abs=1e-5)


def test_noise_and_bias_are_those_of_the_model():
    line, clock = line_to(MtiModel(gyro_walk_rad_s_sqrt_s=0.0), motion=resting)
    imu = Mti(line, clock=clock)
    imu.start()
    rate = np.array([sample.rate_rad_s for sample in collect(imu, clock, 60.0)])
    sigma = ImuNoise().gyro_rad_s_sqrt_hz * 10  # sqrt(100 Hz)
    # Five standard errors of a standard deviation and of a mean of n samples.
    n = len(rate)
    np.testing.assert_allclose(rate.std(axis=0), sigma, rtol=5 / np.sqrt(2 * n))
    np.testing.assert_allclose(rate.mean(axis=0), MtiModel().gyro_bias_rad_s, atol=5 * sigma / np.sqrt(n))


def test_unplugged_and_plugged_in_again():
    faults = LineFaults(np.random.default_rng(0), unplugs=[(2.0, 1.0)])
    device, clock = MtiDevice(turning, rng=np.random.default_rng(5), model=perfect()), VirtualClock()
    imu = Mti(LoopbackTransport(device, clock, faults=faults), clock=clock)
    imu.start()
    with pytest.raises(LineLostError):
        collect(imu, clock, 5.0)
    clock.sleep(1.5)
    again = Mti(LoopbackTransport(device, clock, faults=faults), clock=clock)
    again.start()
    assert len(collect(again, clock, 1.0)) in (99, 100)


def test_a_silent_line_and_a_refusal_are_said():
    class Silent(MtiDevice):
        def receive(self, data: bytes, now_s: float) -> None:
            del data, now_s

    clock = VirtualClock()
    silent = LoopbackTransport(Silent(turning, rng=np.random.default_rng(0)), clock)
    with pytest.raises(DeviceError, match="no answer from the IMU to command 30") as error:
        Mti(silent, clock=clock).start()
    assert "115200" in error.value.advice

    class Stubborn(MtiDevice):
        def _changed(self, mid: int, data: bytes):
            del mid, data

    stubborn = LoopbackTransport(Stubborn(turning, rng=np.random.default_rng(0)), clock)
    with pytest.raises(DeviceError, match="refuses command D0 with error 03"):
        Mti(stubborn, clock=clock).start()


@pytest.mark.parametrize("rate_hz", [0, -1, 1, 1000, 512.0001 * 2])
def test_rates_that_the_device_cannot_do_are_refused(rate_hz):
    line, _ = line_to(perfect())
    with pytest.raises(InputError, match="IMU rate"):
        Mti(line, rate_hz=rate_hz)


def test_no_imu_gives_nothing_at_once():
    imu = NullImu()
    imu.start()
    assert imu.read(10.0) == []


def test_emulated_unit_measures_by_itself_unless_it_is_answered():
    device = MtiDevice(turning, rng=np.random.default_rng(0))
    device.connect(0.0)
    woken = FrameParser().feed(device.send(0.1))
    assert [message.mid for message in woken] == [Mid.WAKE_UP]
    assert {message.mid for message in FrameParser().feed(device.send(1.0))} == {Mid.DATA}
    answered = MtiDevice(turning, rng=np.random.default_rng(0))
    answered.connect(0.0)
    answered.receive(encode(Mid.WAKE_UP_ACKNOWLEDGE), 0.2)
    assert [message.mid for message in FrameParser().feed(answered.send(5.0))] == [Mid.WAKE_UP]


def test_emulated_unit_tells_its_configuration_in_118_bytes():
    device = MtiDevice(turning, rng=np.random.default_rng(0))
    device.connect(0.0)
    device.receive(
        encode(Mid.GO_TO_CONFIG) + encode(Mid.REQUEST_CONFIGURATION) + encode(Mid.SET_PERIOD, b"\x00\x01"), 0.1
    )
    replies = {message.mid: message.data for message in FrameParser().feed(device.send(1.0))}
    assert len(replies[Mid.CONFIGURATION]) == 118
    assert replies[Mid.CONFIGURATION][:4] == bytes.fromhex("00500001")
    assert replies[Mid.CONFIGURATION][4:6] == bytes.fromhex("0480")
    assert replies[Mid.ERROR] == b"\x03"


@settings(max_examples=200)
@given(data=st.lists(st.one_of(st.binary(max_size=60), st.builds(encode, st.integers(0, 254), st.binary(max_size=12)))))
def test_any_bytes_harm_neither_the_emulator_nor_the_driver(data):
    device = MtiDevice(turning, rng=np.random.default_rng(0))
    device.connect(0.0)
    now_s = 0.0
    for piece in data:
        now_s += 0.01
        device.receive(piece, now_s)
        device.send(now_s)
        assert device.next_due_s() >= 0
    clock = VirtualClock()
    imu = Mti(LoopbackTransport(Babbler(data), clock), clock=clock)
    try:
        imu.start()
        collect(imu, clock, 1.0)
    except SpotcalError:
        pass
