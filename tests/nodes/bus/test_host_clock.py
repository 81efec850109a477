"""What the kernel says of its clock, in the words of the bus."""

import pytest

from nodes.bus import spotcal_pb2 as pb
from nodes.bus.host_clock import KernelClock, clock_quality
from nodes.bus.host_temperature import temperature_c

UNSYNC = 0x40


@pytest.mark.parametrize(
    ("kernel", "source", "sigma_s"),
    [
        (KernelClock(0, 0x2001, 120, 5000), pb.CLOCK_SOURCE_NTP, 120e-6),
        # A daemon that estimates no error still bounds it.
        (KernelClock(0, 0x2001, 0, 5000), pb.CLOCK_SOURCE_NTP, 5e-3),
        (KernelClock(5, 0, 16_000_000, 16_000_000), pb.CLOCK_SOURCE_FREE, 0.0),
        (KernelClock(0, UNSYNC, 16_000_000, 16_000_000), pb.CLOCK_SOURCE_FREE, 0.0),
        (KernelClock(-1, 0, 0, 0), pb.CLOCK_SOURCE_UNKNOWN, 0.0),
        (None, pb.CLOCK_SOURCE_UNKNOWN, 0.0),
    ],
)
def test_quality_of_a_clock(kernel, source, sigma_s):
    quality = clock_quality(lambda: kernel)
    assert quality.source == source
    assert quality.sigma_s == pytest.approx(sigma_s)


def test_this_machine_is_asked():
    quality = clock_quality()
    assert quality.source in pb.ClockSource.values()
    assert 0 <= quality.sigma_s < 1e9


def test_the_hottest_sensor_counts(tmp_path):
    assert temperature_c(tmp_path) is None
    for k, text in enumerate(["41500\n", "", "55000\n", "no number"]):
        (tmp_path / f"thermal_zone{k}").mkdir()
        (tmp_path / f"thermal_zone{k}" / "temp").write_text(text)
    assert temperature_c(tmp_path) == pytest.approx(55.0)
