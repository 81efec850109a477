"""Virtual time and line faults."""

import numpy as np
import pytest

from nodes.devices.errors import LineLostError
from nodes.simulated.line_faults import LineFaults
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from tests.nodes.simulated.echo import Echo


def test_reading_lets_time_run_to_the_reply_and_not_beyond():
    clock = VirtualClock()
    line = LoopbackTransport(Echo(0.5), clock)
    line.write(b"abc")
    assert line.read(2.0) == b"abc"
    assert clock() == 0.5


def test_reading_gives_nothing_after_the_timeout():
    clock = VirtualClock()
    line = LoopbackTransport(Echo(0.5), clock)
    line.write(b"abc")
    assert line.read(0.25) == b""
    assert clock() == 0.25
    assert line.read(0.0) == b""


def test_pulled_plug_is_told_when_it_is_pulled_and_the_emulator_knows():
    clock, echo = VirtualClock(), Echo(0.5)
    line = LoopbackTransport(echo, clock, faults=LineFaults(np.random.default_rng(0), unplugs=[(1.0, 2.0)]))
    with pytest.raises(LineLostError, match="gone"):
        line.read(5.0)
    assert clock() == 1.0
    assert (echo.n_connects, echo.n_disconnects) == (1, 1)
    with pytest.raises(LineLostError):
        line.write(b"x")


def test_stall_holds_bytes_back_and_loses_none():
    clock = VirtualClock()
    faults = LineFaults(np.random.default_rng(0), stalls=[(0.2, 1.0)])
    line = LoopbackTransport(Echo(0.5), clock, faults=faults)
    line.write(b"abc")
    assert line.read(0.9) == b""
    assert line.read(5.0) == b"abc"
    assert clock() == pytest.approx(1.2)


def test_damage_is_counted_truly_and_as_frequent_as_asked():
    faults = LineFaults(np.random.default_rng(1), flips_per_byte=0.01, drops_per_byte=0.02)
    sent = bytes(100_000)
    arrived = faults.carry(sent, 0.0)
    # Counts are binomial: five standard deviations.
    assert abs(faults.n_flipped - 1000) < 5 * np.sqrt(1000)
    assert abs(faults.n_dropped - 2000) < 5 * np.sqrt(2000)
    assert len(arrived) == len(sent) - faults.n_dropped
    flipped = np.frombuffer(arrived, dtype=np.uint8)
    assert (np.unpackbits(flipped[flipped != 0][:, None], axis=1).sum(axis=1) == 1).all()


def test_the_same_seed_damages_the_same_bytes():
    one, two = (LineFaults(np.random.default_rng(7), flips_per_byte=0.1) for _ in range(2))
    assert one.carry(b"hello" * 50, 0.0) == two.carry(b"hello" * 50, 0.0)
