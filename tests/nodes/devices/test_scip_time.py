"""The scanner's clock by its TM commands."""

import math

import numpy as np
import pytest

from nodes.devices.scip_line import ScipLine
from nodes.devices.scip_status import status_words
from nodes.devices.scip_time import MAX_EXCHANGES, SensorTime, TimeExchange, exchange_times, tick_of, time_bounds
from nodes.simulated.late_line import LateEmulator
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from nodes.simulated.scip_device import ScipDevice
from nodes.simulated.scip_model import URG_04LX, UST_10LX
from tests.nodes.simulated.echo import Echo


def exchanged(model, delay, seed=0):
    """Exchanges with a scanner, and the device."""
    rng, clock = np.random.default_rng(seed), VirtualClock()
    device = ScipDevice(lambda _: np.full(model.steps.n_measured, 1000), model=model)
    line = ScipLine(LoopbackTransport(LateEmulator(device, lambda: delay(rng)), clock), clock)
    line.quiet()
    line.to_scip2()
    sensor_time = SensorTime()
    return exchange_times(line, sensor_time, clock=clock, turn_s=model.steps.turn_s), device, line, clock


@pytest.mark.parametrize("model", [URG_04LX, UST_10LX])
@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_a_few_exchanges_bound_the_clock_to_milliseconds_however_late_they_are_heard(model, late_s):
    for seed in range(8):
        exchanges, device, _, _ = exchanged(model, lambda rng: rng.uniform(0, late_s), seed)
        assert len(exchanges) <= MAX_EXCHANGES
        bounds = np.array(time_bounds(exchanges, model.steps.turn_s))
        # On the emulator's time: 0 is the instant of the stamp, which is up to 1 ms after what is told.
        away = bounds[:, 1:] - (bounds[:, :1] / model.clock_gain + device._begin_s)
        assert (away[:, 0] <= 1e-3).all()
        assert (away[:, 1:] >= 0).all()
        # Seven halvings of a tick leave 0.8 ms; the cut of the stamp and the way of the command add 1 ms each.
        assert away[:, 1:].min() - away[:, 0].max() < 0.8e-3 + 2e-3 + 0.5e-3


def test_the_scanner_can_be_used_as_before_afterwards():
    _, _, line, _ = exchanged(URG_04LX, lambda _: 0.0)
    assert line.command("BM").status == "00"


def test_documented_answer_is_read_to_the_byte():
    class Recorded(Echo):
        """Answers as a UXM does."""

        def receive(self, data: bytes, now_s: float) -> None:
            super().receive({b"TM1\n": b"TM1\n00P\n<SfkP\n\n"}.get(data, data + b"00P\n\n"), now_s)

    clock = VirtualClock()
    line = ScipLine(LoopbackTransport(Recorded(0.01), clock), clock)
    exchanges = exchange_times(line, SensorTime(), clock=clock, turn_s=0.05)
    # '<Sfk' is 12, 35, 54, 59 in groups of six bits.
    assert {one.device_s for one in exchanges} == {(12 << 18 | 35 << 12 | 54 << 6 | 59) / 1e3}


def test_ticks_are_found_only_where_there_are_some():
    def at(*device_ms):
        return [TimeExchange(ms / 1e3, 0.0, 0.0, 0.0) for ms in device_ms]

    assert tick_of(at(801), 0.1) is None
    assert tick_of(at(801, 901, 1002, 1202), 0.1) == 0.1
    assert tick_of(at(801, 806, 826, 831), 0.1) == 5e-3
    assert tick_of(at(801, 809, 826, 833), 0.1) is None


def test_a_tick_that_contradicts_what_is_certain_is_not_believed():
    # Stamps on ticks, but answers a tick later than the first after asking.
    exchanges = [TimeExchange(0.1 * k, 0.1 * k - shift - 0.12, 0.1 * k - shift - 0.12, 0.1 * k) for k, shift in
                 enumerate([0.0, 0.05, -0.1])]  # fmt: skip
    assert tick_of(exchanges, 0.1) == 0.1
    assert all(math.isinf(bounds.latest_s) for bounds in time_bounds(exchanges, 0.1))


def test_stamps_are_unwrapped_both_ways():
    sensor_time = SensorTime()
    last = (1 << 24) - 1
    assert [sensor_time.seconds(ms) for ms in (last - 99, last, 100, last - 9)] == [
        (last - 99) / 1e3, last / 1e3, (last + 101) / 1e3, (last - 9) / 1e3
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("command", "status", "words"),
    [
        ("MD0044072500000", "05", "status 05: the last step is before the first"),
        ("GD0044072500", "10", "status 10: its laser is off"),
        ("SS038400", "04", "status 04: this model does not have this speed"),
        ("TM1", "04", "status 04: it is not adjusting its time"),
        ("MD0044072500000", "51", "status 51: hardware fault"),
        ("MD0044072500000", "21", "status 21: it stopped to look into an error"),
        ("HELLO", "0E", "status 0E: it does not know the command"),
        ("BM", "zz", "status zz"),
        ("BM", "\xb99", "status \xb99"),
    ],
)
def test_status_codes_are_told_in_words(command, status, words):
    assert status_words(command, status) == words
